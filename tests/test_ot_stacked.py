"""Samples of one size solved together, as on a GPU, against the loop over samples."""

import literal_ot
import pytest
import torch
from conftest import assert_near, rand
from torch.autograd import gradcheck

from meshkit.losses import backward_correspondence_loss
from meshkit.ot import TransportPlan, sinkhorn, sinkhorn_from_cost, stacked
from meshkit.ot.sample import SamplePlan


@pytest.fixture
def together(monkeypatch):
    """Solve samples together on the CPU as well."""
    monkeypatch.setattr(stacked, "launch_bound", lambda x: True)


def weights(*shape: int) -> torch.Tensor:
    """What a reading's entries count; of a single number, 1."""
    return rand(*shape, seed=4) if shape else torch.ones((), dtype=torch.float64)


def is_stacked(plan: TransportPlan) -> bool:
    return isinstance(plan._given, SamplePlan)


READINGS = {
    "product": lambda plan, v, w: plan @ v,
    "transposed product": lambda plan, v, w: plan.T @ w,
    "barycentric": lambda plan, v, w: plan.barycentric(v),
    "transposed barycentric": lambda plan, v, w: plan.T.barycentric(w),
    "row sums": lambda plan, v, w: plan.row_sums(),
    "column sums": lambda plan, v, w: plan.T.row_sums(),
    "cost": lambda plan, v, w: plan.cost(),
    "entropy": lambda plan, v, w: plan.entropy(),
    "potentials": lambda plan, v, w: torch.cat(plan.potentials, 1),
    "topk": lambda plan, v, w: plan.topk(3)[0],
    "dense": lambda plan, v, w: plan.dense(),
    "residual": lambda plan, v, w: plan.residual,
    "loss": lambda plan, v, w: backward_correspondence_loss(plan, v, normalization="both"),
    "warp and loss": lambda plan, v, w: plan.barycentric(v).sum() + backward_correspondence_loss(plan, v),
}


@pytest.mark.parametrize("n_iters", [1, 5])
@pytest.mark.parametrize("sizes", [(9, 6), (5, 8)])
@pytest.mark.parametrize("name", READINGS)
def test_readings_and_gradients_equal_the_loop(name, sizes, n_iters, monkeypatch):
    rows, columns = sizes
    inputs = [rand(3, rows, 4), rand(3, columns, 4, seed=1), rand(3, columns, 3, seed=2), rand(3, rows, 2, seed=3)]
    results = []
    for bound in (True, False):
        monkeypatch.setattr(stacked, "launch_bound", lambda x, bound=bound: bound)
        monkeypatch.setattr(stacked, "SMALL", 0)
        fx, fy, v, w = (t.clone().requires_grad_() for t in inputs)
        plan = sinkhorn(fx, fy, eps=0.1, n_iters=n_iters)
        assert is_stacked(plan) == bound
        value = READINGS[name](plan, v, w)
        gradients = torch.autograd.grad(value, (fx, fy, v, w), weights(*value.shape), allow_unused=True)
        results.append([value, *(g for g in gradients if g is not None)])
    for got, expected in zip(*results, strict=True):
        assert_near(got, expected, 1e-11, scale=max(1e-3, expected.abs().amax().item()))  # row sums are constant


@pytest.mark.parametrize("name", [n for n in READINGS if n not in ("row sums", "column sums")])
@pytest.mark.parametrize("silent", [torch.no_grad, torch.inference_mode])
def test_a_reading_without_gradient_does_not_cut_the_graph(name, silent, together):
    gradients = []
    for early in (False, True):
        fx, fy = rand(2, 5, 4).requires_grad_(), rand(2, 6, 4, seed=1).requires_grad_()
        plan = sinkhorn(fx, fy, eps=0.2)
        if early:
            with silent():
                plan.argmax()
        value = READINGS[name](plan, rand(2, 6, 3, seed=2), rand(2, 5, 2, seed=3))
        gradients.append(torch.autograd.grad(value.sin().sum(), (fx, fy)))
    for got, expected in zip(*gradients, strict=True):
        assert_near(got, expected, 1e-12)


def test_equals_algorithm_1(together):
    fx, fy = rand(2, 7, 3), rand(2, 5, 3, seed=1)
    plan = sinkhorn(fx, fy)
    assert is_stacked(plan)
    expected = literal_ot.literal_batch([literal_ot.cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)], 0.03, 5)
    assert_near(plan.dense(), expected, 1e-12)


def test_gradcheck(together):
    fx, fy, v = rand(2, 4, 3).requires_grad_(), rand(2, 3, 3, seed=1).requires_grad_(), rand(2, 3, 2, seed=2)
    eps = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda x, y, e: sinkhorn(x, y, eps=e, n_iters=3).barycentric(v), (fx, fy, eps))


def test_indices_and_matchings(together):
    fx = rand(2, 6, 4)
    order = torch.tensor([3, 1, 0, 5, 2, 4])
    plan = sinkhorn(fx, fx[:, order], n_iters=20)
    assert is_stacked(plan) and plan.n_iters == [20, 20] and plan.shape == (2, 6, 6)
    for matches in (plan.argmax(), plan.assign(), plan.mutual()[0]):
        assert matches.tolist() == [order.argsort().tolist()] * 2
    assert plan.mutual()[1].all()
    assert "n_iters=[20, 20]" in repr(plan) and plan.dtype == torch.float64 and plan.device.type == "cpu"


def test_small_samples_are_solved_together_on_the_cpu_too():
    fx, fy = rand(3, 8, 4, dtype=torch.float32), rand(3, 7, 4, seed=1, dtype=torch.float32)
    assert is_stacked(sinkhorn(fx, fy))
    large = rand(1, 260, 4, dtype=torch.float32)
    assert is_stacked(sinkhorn(large[:, :252], large)) and not is_stacked(sinkhorn(large, large))


def test_samples_are_solved_together_up_to_a_size_in_the_dtype_of_the_plan(monkeypatch):
    """That of the wider features: float64 on either side doubles what is stored."""
    x, y = rand(2, 10, 3, dtype=torch.float32), rand(2, 10, 3, seed=1)
    for size, together in ((1599, False), (1600, True)):
        monkeypatch.setattr(stacked, "STACK_BYTES", size)
        for first, second in ((x, y), (y, x)):
            assert isinstance(sinkhorn(first, second, eps=0.3)._given, SamplePlan) == together


def test_detached_plan_is_a_constant_without_a_stored_kernel(monkeypatch):
    fx, fy, v = rand(2, 9, 4), rand(2, 6, 4, seed=1), rand(2, 6, 3, seed=2)
    for small in (stacked.SMALL, 0):
        monkeypatch.setattr(stacked, "SMALL", small)
        for options in ({}, {"domain": "log"}, {"eps": torch.tensor(0.1).double().requires_grad_()}):
            plan = sinkhorn(fx.clone().requires_grad_(), fy, **({"eps": 0.1} | options))
            constant = plan.detach()
            assert constant.shape == plan.shape and constant.n_iters == plan.n_iters
            for name, reading in READINGS.items():
                value = reading(constant, v, rand(2, 9, 2))
                assert not value.requires_grad, name
                assert_near(value, reading(plan, v, rand(2, 9, 2)).detach(), 1e-9)
            assert torch.equal(constant.T.argmax(), plan.T.detach().argmax())
            assert all(sample.kernel.tiles.stored is None for sample in constant._samples)
    cost = rand(1, 5, 4).requires_grad_()
    assert not sinkhorn_from_cost(cost).detach().dense().requires_grad


def test_no_gradient_when_none_is_wanted(together):
    plan = sinkhorn(rand(2, 4, 3).requires_grad_(), rand(2, 5, 3, seed=1), grad="none")
    assert is_stacked(plan) and not plan.row_sums().requires_grad


@pytest.mark.parametrize(
    "options",
    [
        {"cost": "sqeuclidean"},
        {"cost": "dot"},
        {"tol": 1e-3},
        {"grad": "implicit"},
        {"grad": "last_step"},
        {"eps": 1e-3},
        {"eps": [1.0, 0.1]},
        {"reach": 1.0},
        {"domain": "log"},
        {"store": "stream"},
        {"mask_x": torch.ones(2, 4, dtype=torch.bool)},
        {"a": torch.full((4,), 0.25)},
        {"check_finite": True},
    ],
    ids=lambda options: next(iter(options)),
)
def test_what_differs_between_samples_or_needs_care_goes_through_the_loop(options, together):
    plan = sinkhorn(rand(2, 4, 3, dtype=torch.float32), rand(2, 5, 3, seed=1, dtype=torch.float32), **options)
    assert not is_stacked(plan)


def test_float32_and_bfloat16_features(together):
    fx, fy = rand(2, 40, 8), rand(2, 30, 8, seed=1)
    exact = sinkhorn(fx, fy).barycentric(rand(2, 30, 3, seed=2))
    plan = sinkhorn(fx.float(), fy.float())
    assert is_stacked(plan) and plan.dtype == torch.float32
    assert_near(plan.barycentric(rand(2, 30, 3, seed=2).float()).double(), exact, 1e-4)
    assert sinkhorn(fx.bfloat16(), fy.bfloat16()).dtype == torch.float32
