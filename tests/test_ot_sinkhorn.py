"""Sinkhorn's values and gradients against the paper's Algorithm 1 under autograd: every option, every reading."""

import warnings

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from literal_ot import (  # noqa: F401
    DOMAINS,
    algorithm_1,
    compare,
    cost_matrix,
    costs,
    domains,
    leaves,
    literal_batch,
    one_by_one,
    set_rows,
    weights,
)
from torch import Tensor

from meshkit.ot import eps_schedule, sinkhorn, sinkhorn_from_cost, sinkhorn_warp

stores = pytest.mark.parametrize("store", ["stream", "keep"])
blocks = pytest.mark.parametrize(("store", "rows"), [("stream", 64), ("stream", 5), ("keep", 4)])


def learned(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


# Plan and gradient


@domains
@pytest.mark.parametrize("eps", [0.03, 0.2])
@pytest.mark.parametrize("n_iters", [1, 2, 5])
@pytest.mark.parametrize(("num_x", "num_y"), [(12, 12), (13, 7), (6, 15), (1, 6), (6, 1), (1, 1)])
def test_plan_and_gradient_equal_algorithm_1(num_x, num_y, n_iters, eps, domain):
    fx, fy = leaves((2, num_x, 5), (2, num_y, 5))
    upstream = rand(2, num_x, num_y, seed=9)
    expected = torch.stack([algorithm_1(cost_matrix(x, y), eps, n_iters) for x, y in zip(fx, fy, strict=True)])
    plan = sinkhorn(fx, fy, eps=eps, n_iters=n_iters, domain=domain).dense()
    assert_near(plan, expected, 1e-12)
    gradients = torch.autograd.grad(plan, [fx, fy], upstream)
    for gradient, truth in zip(gradients, torch.autograd.grad(expected, [fx, fy], upstream), strict=True):
        assert_near(gradient, truth, 1e-10, scale=max(1.0, truth.abs().amax().item()))


def test_defaults_are_those_of_the_paper():
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)
    assert_near(sinkhorn(fx, fy).dense()[0], algorithm_1(cost_matrix(fx[0], fy[0]), eps=0.03, n_iters=5), 1e-12)


@costs
@domains
@blocks
def test_all_readings_and_gradients(cost, domain, store, rows, monkeypatch):
    """Features, values, marginals and eps, through one loss made of every reading; blocks that do not divide N."""
    set_rows(monkeypatch, rows)
    fx, fy, v, u = leaves((2, 13, 4), (2, 9, 4), (2, 9, 3), (2, 13, 2))
    a, b, eps = weights(2, 13, seed=5), weights(2, 9, seed=6), learned(0.7)
    plan = sinkhorn(fx, fy, cost=cost, eps=eps, n_iters=3, a=a, b=b, domain=domain, store=store)
    matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
    compare(plan, literal_batch(matrices, eps, 3, a=a, b=b), matrices, v, u, [fx, fy, v, u, a, b, eps])


@domains
@blocks
def test_given_cost_all_readings_and_gradients(domain, store, rows, monkeypatch):
    set_rows(monkeypatch, rows)
    matrices, v, u = leaves((2, 13, 9), (2, 9, 3), (2, 13, 2))
    a, b, eps = weights(2, 13, seed=5), weights(2, 9, seed=6), learned(0.7)
    plan = sinkhorn_from_cost(matrices, eps=eps, n_iters=3, a=a, b=b, domain=domain, store=store)
    compare(plan, literal_batch(matrices, eps, 3, a=a, b=b), matrices, v, u, [matrices, v, u, a, b, eps])


@costs
@domains
def test_potentials_and_their_gradient(cost, domain):
    """exp((f + g - C) / eps) is the plan; f and g share a free constant, their outer sum does not."""
    fx, fy = leaves((2, 7, 4), (2, 5, 4))
    eps = learned(0.4)
    plan = sinkhorn(fx, fy, cost=cost, eps=eps, n_iters=3, domain=domain)
    f, g = plan.potentials
    matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
    expected = eps * literal_batch(matrices, eps, 3).log() + matrices
    total = f[:, :, None] + g[:, None]
    assert_near(total, expected, 1e-12)
    assert_near(plan.log_dense(), literal_batch(matrices, eps, 3).log(), 1e-12)
    assert all(torch.equal(one, other) for one, other in zip(plan.T.potentials, (g, f), strict=True))
    upstream = rand(2, 7, 5, seed=3)
    truths = torch.autograd.grad(expected, [fx, fy, eps], upstream)
    for gradient, truth in zip(torch.autograd.grad(total, [fx, fy, eps], upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-11)


@domains
def test_warp_is_the_barycentric_reading(domain):
    fx, fy, values = leaves((2, 11, 4), (2, 8, 4), (2, 8, 3))
    matrices = [cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)]
    dense = literal_batch(matrices, 0.1, 4)
    expected = dense @ values / dense.sum(2, keepdim=True)
    warped = sinkhorn_warp(fx, fy, values, eps=0.1, n_iters=4, domain=domain)
    assert_near(warped, expected, 1e-12)
    upstream, inputs = rand(2, 11, 3, seed=5), [fx, fy, values]
    truths = torch.autograd.grad(expected, inputs, upstream)
    for gradient, truth in zip(torch.autograd.grad(warped, inputs, upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-10)


def test_marginals_of_one_dimension_serve_every_sample():
    fx, fy = rand(2, 6, 3), rand(2, 5, 3, seed=1)
    a, b = weights(6, seed=2), weights(5, seed=3)
    plan = sinkhorn(fx, fy, a=a, b=b).dense()
    assert_near(plan, sinkhorn(fx, fy, a=a.expand(2, 6), b=b.expand(2, 5)).dense(), 1e-14)
    (gradient,) = torch.autograd.grad((plan * rand(2, 6, 5, seed=4)).sum(), a)
    both = a.detach().repeat(2, 1).requires_grad_()
    loss = (sinkhorn(fx, fy, a=both, b=b).dense() * rand(2, 6, 5, seed=4)).sum()
    assert_near(gradient, torch.autograd.grad(loss, both)[0].sum(0), 1e-12)


# Masks and weights of zero


@domains
@stores
def test_weights_of_zero_leave_rows_out(domain, store):
    fx, fy, v, u = leaves((2, 8, 4), (2, 6, 4), (2, 6, 3), (2, 8, 2))
    a, b = (w.detach().clone() for w in (weights(2, 8, seed=5), weights(2, 6, seed=6)))
    a[0, [1, 5]], b[0, 2], a[1, 7] = 0, 0, 0
    a, b = ((w / w.sum(1, keepdim=True)).requires_grad_() for w in (a, b))
    plan = sinkhorn(fx, fy, eps=0.3, n_iters=3, a=a, b=b, domain=domain, store=store)
    matrices = torch.stack([cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)])
    truth = literal_batch(matrices, 0.3, 3, a=a, b=b)
    assert (truth[0, 1] == 0).all() and (truth[0, :, 2] == 0).all()
    compare(plan, truth, matrices, v, u, [fx, fy, v, u, a, b])
    f, g = plan.potentials
    assert torch.equal(f == -torch.inf, a == 0) and torch.equal(g == -torch.inf, b == 0)
    assert torch.equal(plan.log_dense() == -torch.inf, (a == 0)[:, :, None] | (b == 0)[:, None])


@domains
@pytest.mark.parametrize("reach", [None, 0.5])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_padded_batch_equals_the_loop(garbage, reach, domain):
    sizes_x, sizes_y = [5, 8, 1], [9, 4, 3]
    xs = [rand(n, 4, seed=i).requires_grad_() for i, n in enumerate(sizes_x)]
    ys = [rand(n, 4, seed=i + 5).requires_grad_() for i, n in enumerate(sizes_y)]
    vs = [rand(n, 3, seed=i + 10) for i, n in enumerate(sizes_y)]
    mask_x, mask_y = scattered_mask(sizes_x, 10), scattered_mask(sizes_y, 12, seed=1)
    fx, fy = (scatter(s, m, garbage).requires_grad_() for s, m in ((xs, mask_x), (ys, mask_y)))
    options = {"eps": 0.1, "reach": reach, "domain": domain}
    plan = sinkhorn(fx, fy, mask_x=mask_x, mask_y=mask_y, **options)
    warped = plan.barycentric(scatter(vs, mask_y, garbage))
    upstream = rand(3, 10, 3, seed=20)
    dense, costs = plan.dense(), plan.cost()
    loss = (warped * upstream).sum() + costs.sum()
    expected_loss = torch.zeros(())
    for s, (x, y, v) in enumerate(zip(xs, ys, vs, strict=True)):
        single = sinkhorn(x[None], y[None], **options)
        real = mask_x[s][:, None] & mask_y[s]
        assert_near(dense[s][real].view(len(x), len(y)), single.dense()[0], 1e-12)
        assert (dense[s][~real] == 0).all()
        assert (warped[s][~mask_x[s]] == 0).all()
        for name in ("cost", "entropy"):
            assert_near(getattr(plan, name)()[s], getattr(single, name)()[0], 1e-12)
        assert_near(plan.residual[s], single.residual[0], 1e-12, scale=1.0)
        expected_loss = expected_loss + (single.barycentric(v[None])[0] * upstream[s][mask_x[s]]).sum()
        expected_loss = expected_loss + single.cost().sum()
    assert_near(loss, expected_loss, 1e-12)
    for padded, mask, samples in ((fx, mask_x, xs), (fy, mask_y, ys)):
        (gradient,) = torch.autograd.grad(loss, padded, retain_graph=True)
        truth = torch.cat(torch.autograd.grad(expected_loss, samples, retain_graph=True))
        assert_near(gradient[mask], truth, 1e-10)
        assert (gradient[~mask] == 0).all()
    rows, columns = plan.marginals()
    assert (rows[~mask_x] == 0).all() and (columns[~mask_y] == 0).all()
    assert mask_y.gather(1, plan.argmax())[mask_x].all() and mask_x.gather(1, plan.argmax(1))[mask_y].all()


@domains
def test_masks_and_weights_together(domain):
    """Weights of masked rows do not count; the others keep their values."""
    fx, fy = rand(2, 6, 3), rand(2, 5, 3, seed=1)
    mask_x = scattered_mask([4, 5], 6)
    a = rand(2, 6, seed=2).exp()
    a = torch.where(mask_x, a / (a * mask_x).sum(1, keepdim=True), 7.0).requires_grad_()
    plan = sinkhorn(fx, fy, a=a, mask_x=mask_x, eps=0.2, domain=domain).dense()
    matrices = [cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)]
    expected = literal_batch(matrices, 0.2, 5, a=torch.where(mask_x, a, 0.0))
    assert_near(plan, expected, 1e-12)
    upstream = rand(2, 6, 5, seed=3)
    truths = torch.autograd.grad(expected, a, upstream)
    assert_near(torch.autograd.grad(plan, a, upstream)[0], truths[0], 1e-11)


@domains
def test_full_masks_change_nothing(domain):
    fx, fy = rand(2, 6, 3), rand(2, 5, 3, seed=1)
    masks = {"mask_x": torch.ones(2, 6, dtype=torch.bool), "mask_y": torch.ones(2, 5, dtype=torch.bool)}
    torch.testing.assert_close(
        sinkhorn(fx, fy, domain=domain, **masks).dense(), sinkhorn(fx, fy, domain=domain).dense(), rtol=0, atol=0
    )


@domains
def test_given_cost_may_hold_anything_where_masked(domain):
    masks = {"mask_x": scattered_mask([4, 6], 6), "mask_y": scattered_mask([5, 3], 5)}
    real = masks["mask_x"][:, :, None] & masks["mask_y"][:, None]
    clean = rand(2, 6, 5)
    dirty = torch.where(real, clean, torch.nan).requires_grad_()
    plan = sinkhorn_from_cost(dirty, eps=0.3, domain=domain, **masks)
    assert_near(plan.dense(), sinkhorn_from_cost(clean, eps=0.3, domain=domain, **masks).dense(), 1e-14)
    (gradient,) = torch.autograd.grad((plan.dense() * rand(2, 6, 5, seed=1)).sum(), dirty)
    assert gradient.isfinite().all() and (gradient[~real] == 0).all() and (gradient[real] != 0).any()


# Stopping


@domains
@pytest.mark.parametrize("tol", [1e-2, 1e-4])
def test_each_sample_stops_at_the_tolerance(tol, domain):
    """A sample makes one more iteration than the first whose columns are close enough: it is needed to see that."""
    fx, fy = leaves((3, 9, 3), (3, 7, 3))
    plan = sinkhorn(fx, fy, eps=0.3, n_iters=300, tol=tol, domain=domain)
    expected = []
    for s in range(3):
        cost = cost_matrix(fx[s], fy[s]).detach()
        residuals = ((algorithm_1(cost, 0.3, t).sum(0) - 1 / 7).abs().sum() for t in range(1, 300))
        expected.append(next(t for t, r in enumerate(residuals, 1) if r < tol) + 1)
    assert plan.n_iters == expected and len(set(expected)) > 1
    assert (plan.residual < tol).all()
    truth = torch.stack([algorithm_1(cost_matrix(fx[s], fy[s]), 0.3, expected[s]) for s in range(3)])
    assert_near(plan.dense(), truth, 1e-12)
    upstream = rand(3, 9, 7, seed=5)
    truths = torch.autograd.grad(truth, [fx, fy], upstream)
    for gradient, t in zip(torch.autograd.grad(plan.dense(), [fx, fy], upstream), truths, strict=True):
        assert_near(gradient, t, 1e-10)


@domains
def test_tolerance_not_reached_runs_all_iterations(domain):
    fx, fy = rand(1, 9, 3), rand(1, 7, 3, seed=1)
    plan = sinkhorn(fx, fy, n_iters=4, tol=0.0, domain=domain)
    assert plan.n_iters == [4]
    assert_near(plan.dense(), sinkhorn(fx, fy, n_iters=4, domain=domain).dense(), 1e-14)


@domains
def test_unbalanced_iterations_stop_once_the_columns_hardly_change(domain):
    fx, fy = rand(1, 9, 3), rand(1, 7, 3, seed=1)
    options = {"eps": 0.3, "reach": 0.5, "domain": domain}
    plan = sinkhorn(fx, fy, n_iters=500, tol=1e-9, **options)
    assert plan.n_iters[0] < 100
    assert_near(plan.dense(), sinkhorn(fx, fy, n_iters=500, **options).dense(), 1e-7)


# Sequences of eps


@pytest.mark.parametrize(
    ("schedule", "cost", "store"),
    [
        ([1.0, 0.5, 0.3], "cosine", "stream"),
        ([1.0, 0.5, 0.3], "sqeuclidean", "keep"),
        ([0.4, 0.4, 0.9, 0.3, 0.3], "dot", "stream"),
        ([0.3], "cosine", "keep"),
    ],
)
def test_annealing_carries_the_potentials_over(schedule, cost, store):
    fx, fy, v, u = leaves((2, 7, 4), (2, 5, 4), (2, 5, 3), (2, 7, 2))
    a, b = weights(2, 7, seed=5), weights(2, 5, seed=6)
    plan = sinkhorn(fx, fy, cost=cost, eps=schedule, n_iters=5, a=a, b=b, store=store)
    matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
    compare(plan, literal_batch(matrices, schedule, 5, a=a, b=b), matrices, v, u, [fx, fy, v, u, a, b])


def test_annealing_a_given_cost():
    (matrices,) = leaves((2, 7, 5))
    schedule = eps_schedule(2.0, 0.3)
    assert schedule == [2.0, 1.0, 0.5, 0.3]
    plan = sinkhorn_from_cost(matrices, eps=schedule, n_iters=6).dense()
    expected = literal_batch(matrices, schedule, 6)
    assert_near(plan, expected, 1e-12)
    upstream = rand(2, 7, 5, seed=3)
    truths = torch.autograd.grad(expected, matrices, upstream)
    assert_near(torch.autograd.grad(plan, matrices, upstream)[0], truths[0], 1e-11)


def test_annealing_does_not_stop_before_the_last_eps():
    """Convergence at a larger eps is not convergence."""
    fx, fy = rand(1, 7, 4), rand(1, 5, 4, seed=1)
    schedule = [1.0] * 30 + [0.2] * 4
    plan = sinkhorn(fx, fy, eps=schedule, n_iters=60, tol=1e-3)
    assert plan.n_iters[0] > 30
    assert_near(plan.dense()[0], algorithm_1(cost_matrix(fx[0], fy[0]), schedule, plan.n_iters[0]), 1e-12)


def test_annealing_converges_to_the_plan_of_the_last_eps():
    fx, fy = rand(1, 7, 4), rand(1, 5, 4, seed=1)
    annealed = sinkhorn(fx, fy, eps=eps_schedule(1.0, 0.1), n_iters=300).dense()
    assert_near(annealed, sinkhorn(fx, fy, eps=0.1, n_iters=300).dense(), 1e-10)


# Unbalanced transport


@domains
@pytest.mark.parametrize(
    ("reach", "cost", "store"),
    [
        (0.5, "cosine", "stream"),
        ((0.5, 2.0), "sqeuclidean", "keep"),
        ((0.5, None), "dot", "stream"),
        ((None, 0.5), "cosine", "keep"),
        ((torch.inf, 0.7), "sqeuclidean", "stream"),
    ],
)
def test_unbalanced_all_readings_and_gradients(reach, cost, domain, store, monkeypatch):
    """Masses of the two sides may differ, and constant shifts of the cost matter."""
    set_rows(monkeypatch, 4)
    fx, fy, v, u = leaves((2, 7, 4), (2, 5, 4), (2, 5, 3), (2, 7, 2))
    a, b = weights(2, 7, seed=5), (1.5 * weights(2, 5, seed=6)).detach().requires_grad_()
    eps = 0.6
    plan = sinkhorn(fx, fy, cost=cost, eps=eps, n_iters=3, a=a, b=b, reach=reach, domain=domain, store=store)
    sides = reach if isinstance(reach, tuple) else (reach, reach)
    powers = tuple(1.0 if r in (None, torch.inf) else r / (r + eps) for r in sides)
    matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
    truth = literal_batch(matrices, eps, 3, a=a, b=b, powers=powers)
    compare(plan, truth, matrices, v, u, [fx, fy, v, u, a, b])
    f, g = plan.potentials
    assert_near(f[:, :, None] + g[:, None], eps * truth.log() + matrices, 1e-11)


@domains
def test_unbalanced_given_cost(domain):
    (matrices,) = leaves((2, 6, 5))
    plan = sinkhorn_from_cost(matrices, eps=0.4, n_iters=4, reach=0.8, domain=domain).dense()
    expected = literal_batch(matrices, 0.4, 4, powers=(2 / 3, 2 / 3))
    assert_near(plan, expected, 1e-12)
    upstream = rand(2, 6, 5, seed=3)
    truths = torch.autograd.grad(expected, matrices, upstream)
    assert_near(torch.autograd.grad(plan, matrices, upstream)[0], truths[0], 1e-11)


@domains
def test_large_reach_approaches_balanced_transport(domain):
    fx, fy = rand(1, 6, 3), rand(1, 5, 3, seed=1)
    balanced = sinkhorn(fx, fy, eps=0.2, n_iters=50).dense()
    errors = [
        (sinkhorn(fx, fy, eps=0.2, n_iters=50, reach=r, domain=domain).dense() - balanced).abs().amax()
        for r in (1.0, 1e2, 1e4)
    ]
    assert errors[1] < errors[0] / 10 and errors[2] < errors[1] / 10


# Gradient modes

MODES = {
    "cosine": {"cost": "cosine"},
    "sqeuclidean": {"cost": "sqeuclidean"},
    "unbalanced": {"reach": (0.5, 1.0)},
    "one-sided": {"reach": (None, 0.8)},
}
problems = pytest.mark.parametrize("problem", MODES)


def problem_options(problem: str, eps: float) -> tuple[dict, tuple[float, float]]:
    reach = MODES[problem].get("reach", (None, None))
    return MODES[problem], tuple(1.0 if r is None else r / (r + eps) for r in reach)


@problems
@domains
@pytest.mark.parametrize("n_iters", [1, 3])
def test_last_step_detaches_earlier_iterations(problem, domain, n_iters):
    fx, fy, v, u = leaves((2, 7, 4), (2, 5, 4), (2, 5, 3), (2, 7, 2))
    a, b, eps = weights(2, 7, seed=5), weights(2, 5, seed=6), 0.5
    options, powers = problem_options(problem, eps)
    plan = sinkhorn(fx, fy, eps=eps, n_iters=n_iters, a=a, b=b, grad="last_step", domain=domain, **options)
    cost = options.get("cost", "cosine")
    matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
    truth = literal_batch(matrices, eps, n_iters, a=a, b=b, powers=powers, last_step=True)
    compare(plan, truth, matrices, v, u, [fx, fy, v, u, a, b])


def test_last_step_of_an_annealed_run():
    fx, fy = leaves((1, 7, 4), (1, 5, 4))
    for schedule in ([1.0, 0.5, 0.3], [1.0, 0.3]):
        plan = sinkhorn(fx, fy, eps=schedule, n_iters=3, grad="last_step").dense()
        expected = algorithm_1(cost_matrix(fx[0], fy[0]), schedule, 3, last_step=True)[None]
        upstream = rand(1, 7, 5, seed=3)
        truths = torch.autograd.grad(expected, [fx, fy], upstream)
        for gradient, truth in zip(torch.autograd.grad(plan, [fx, fy], upstream), truths, strict=True):
            assert_near(gradient, truth, 1e-11)


@problems
@pytest.mark.parametrize(("domain", "store"), [("kernel", "stream"), ("log", "keep")])
def test_implicit_is_the_limit_of_unrolling(problem, domain, store, monkeypatch):
    set_rows(monkeypatch, 3)
    fx, fy, v, u = leaves((2, 7, 4), (2, 5, 4), (2, 5, 3), (2, 7, 2))
    a, b, eps = weights(2, 7, seed=5), weights(2, 5, seed=6), 8.0 if problem == "sqeuclidean" else 1.5
    options, powers = problem_options(problem, eps)
    masks = {"mask_x": scattered_mask([5, 7], 7)}
    a = torch.where(masks["mask_x"], a, 0.0)
    a = (a / a.sum(1, keepdim=True)).detach().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan = sinkhorn(
            fx, fy, eps=eps, n_iters=100, a=a, b=b, grad="implicit", domain=domain, store=store, **masks, **options
        )
        cost = options.get("cost", "cosine")
        matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
        truth = literal_batch(matrices, eps, 100, a=a, b=b, powers=powers)
        compare(plan, truth, matrices, v, u, [fx, fy, v, u, b], tol=1e-11, grad_tol=1e-9)


@domains
def test_implicit_gradient_of_marginals_and_eps(domain):
    """Weights are free up to their common sum, so their gradient is compared along changes that keep it."""
    fx, fy = leaves((1, 7, 4), (1, 5, 4))
    logits_a, logits_b = leaves((1, 7), (1, 5), seed=5)
    eps, upstream = learned(0.6), rand(1, 7, 5, seed=9)
    results = []
    for grad in ("implicit", "unroll"):
        plan = sinkhorn(
            fx, fy, eps=eps, n_iters=120, a=logits_a.softmax(1), b=logits_b.softmax(1), grad=grad, domain=domain
        )
        results.append(torch.autograd.grad(plan.dense(), [fx, fy, logits_a, logits_b, eps], upstream))
    for gradient, truth in zip(*results, strict=True):
        assert_near(gradient, truth, 1e-9)


def test_implicit_gradient_warns_if_it_did_not_converge():
    """Points on a line at an eps below their spacing: mass moves slowly along it, so the system is ill-conditioned."""
    line = torch.linspace(0, 1, 700, dtype=torch.float64)[None, :, None].requires_grad_()
    plan = sinkhorn(line, line, cost="sqeuclidean", eps=4e-7, n_iters=2, grad="implicit", domain="kernel", store="keep")
    with pytest.warns(UserWarning, match=r"implicit gradient of sinkhorn stopped after 500 steps at relative residual"):
        (plan.dense() * rand(1, 700, 700)).sum().backward()


@domains
@pytest.mark.parametrize("reach", [None, 0.5])
def test_constant_plan(domain, reach):
    """grad="none": values still receive their gradient, and everything else none."""
    fx, fy, values = leaves((2, 7, 4), (2, 5, 4), (2, 5, 3))
    a = weights(2, 7, seed=5)
    eps = 0.3 if reach else learned(0.3)
    options = {"eps": eps, "n_iters": 3, "a": a, "domain": domain, "reach": reach}
    plan, unrolled = sinkhorn(fx, fy, grad="none", **options), sinkhorn(fx, fy, **options)
    assert_near(plan.dense(), unrolled.dense(), 1e-14)
    for read in (plan.dense(), plan.cost(), plan.entropy(), plan.row_sums(), plan.residual, *plan.potentials):
        assert not read.requires_grad
    for product in (plan @ values, plan.barycentric(values)):
        (gradient,) = torch.autograd.grad(product.square().sum(), values)
        assert gradient.abs().amax() > 0
    matrix = plan.dense()
    (gradient,) = torch.autograd.grad((plan @ values).sum(), values)
    assert_near(gradient, matrix.sum(1)[..., None].expand(2, 5, 3), 1e-13)


def test_constant_plan_from_a_given_cost():
    (cost,) = leaves((1, 4, 3))
    assert not sinkhorn_from_cost(cost, grad="none").dense().requires_grad


@pytest.mark.parametrize("domain", DOMAINS)
def test_modes_agree_in_value_and_differ_in_gradient(domain):
    fx, fy = leaves((1, 9, 4), (1, 7, 4))
    upstream, gradients = rand(1, 9, 7, seed=3), []
    for grad in ("unroll", "last_step", "implicit"):
        dense = sinkhorn(fx, fy, eps=0.1, n_iters=3, grad=grad, domain=domain).dense()
        assert_near(dense, sinkhorn(fx, fy, eps=0.1, n_iters=3).dense(), 1e-13)
        gradients.append(torch.autograd.grad(dense, fx, upstream)[0])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert (gradients[i] - gradients[j]).norm() > 1e-3 * gradients[0].norm()
