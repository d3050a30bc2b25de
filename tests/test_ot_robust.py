"""Sinkhorn at the edges: tiny and huge eps, features that are zero, opposite, equal or not finite, and every error."""

import importlib
import itertools
import math
import re
import warnings

import numpy as np
import pytest
import torch
from conftest import assert_near, rand
from literal_ot import DOMAINS, READINGS, algorithm_1, cost_matrix, domains, leaves, one_by_one  # noqa: F401
from torch import Tensor

from meshkit.ot import (
    SinkhornCorrespondence,
    eps_schedule,
    sinkhorn,
    sinkhorn_divergence,
    sinkhorn_from_cost,
    sinkhorn_warp,
)
from meshkit.ot.iterations import conjugate_gradient

grads = pytest.mark.parametrize("grad", ["unroll", "last_step", "implicit"])


def log_algorithm(cost: Tensor, eps: float, n_iters: int, power: float = 1.0) -> Tensor:
    """Logarithm of the paper's plan by ``logsumexp``, for an eps at which the kernel underflows."""
    logits, mu, nu = -cost / eps, -math.log(len(cost)), -math.log(cost.shape[1])
    log_a = torch.full_like(cost[:, 0], mu)
    for _ in range(n_iters):
        log_b = power * (nu - torch.logsumexp(logits + log_a[:, None], 0))
        log_a = power * (mu - torch.logsumexp(logits + log_b, 1))
    return logits + log_a[:, None] + log_b


def clustered(num: int, eps: float, seed: int) -> Tensor:
    """Two opposite clusters ``(1, N, 4)``: costs differ by about eps within one, and by 2 across."""
    centres = torch.tensor([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]], dtype=torch.float64).repeat(num, 1)[:num]
    return (centres + min(eps, 0.5) ** 0.5 * rand(num, 4, seed=seed))[None]


# Regularisation

# Largest error in float32 of the plan and of the warp's gradient, relative to the largest entry, about three times what
# is reached: 9e-4 and 5e-4 at eps 1e-4. Logits of size 2 / eps carry rounding errors of about 1e-7 / eps.
EPS = [
    (1e-4, 3e-3, 2e-3),
    (1e-3, 2e-4, 5e-4),
    (1e-2, 2e-5, 5e-5),
    (0.1, 3e-6, 3e-6),
    (1.0, 3e-6, 3e-6),
    (10.0, 3e-6, 3e-6),
]


@pytest.mark.parametrize(("eps", "tol", "grad_tol"), EPS)
@pytest.mark.parametrize("store", ["keep", "stream"])
def test_single_precision_at_any_eps(eps, tol, grad_tol, store):
    """The domain is chosen; at 1e-4 the kernel spans 10^8600."""
    fx, fy = clustered(80, eps, 0).float(), clustered(71, eps, 1).float()
    x, y = (f.detach().requires_grad_() for f in (fx, fy))
    exact = [f.double().requires_grad_() for f in (fx, fy)]
    values, upstream = rand(1, 71, 3, seed=2), rand(1, 80, 3, seed=3)
    plan = sinkhorn(x, y, eps=eps, store=store)
    dense = log_algorithm(cost_matrix(exact[0][0], exact[1][0]), eps, 5).exp()[None]
    assert_near(plan.dense(), dense.float(), tol)
    warped = plan.barycentric(values.float())
    truths = torch.autograd.grad(dense @ values / dense.sum(2, keepdim=True), exact, upstream)
    for gradient, truth in zip(torch.autograd.grad(warped, [x, y], upstream.float()), truths, strict=True):
        assert_near(gradient, truth.float(), grad_tol)


@pytest.mark.parametrize("eps", [1e-4, 1e-3, 1e-2, 10.0])
@pytest.mark.parametrize("reading", READINGS)
def test_double_precision_at_any_eps(eps, reading):
    fx, fy = (clustered(n, eps, seed=n).requires_grad_() for n in (12, 9))
    v, u = rand(1, 9, 2), rand(1, 12, 2, seed=1)
    read, literal = READINGS[reading]
    value = read(sinkhorn(fx, fy, eps=eps), v, u)
    cost = cost_matrix(fx[0], fy[0])
    expected = literal(log_algorithm(cost, eps, 5).exp()[None], cost[None], v, u)
    assert_near(value, expected, 1e-12 / min(eps, 1))
    upstream = rand(*value.shape, seed=5)
    gradients = torch.autograd.grad(value, [fx, fy], upstream)
    truths = torch.autograd.grad(expected, [fx, fy], upstream)
    for gradient, truth in zip(gradients, truths, strict=True):
        # A few may all but vanish, as that of the row sums: of the size of the values per change of sqrt(eps) then.
        size = max(truth.abs().amax().item(), expected.detach().abs().amax().item() / min(eps, 1) ** 0.5)
        assert_near(gradient, truth, 1e-12 / min(eps, 1), scale=size)


@pytest.mark.parametrize(("factor", "expected"), [(0.999, "log"), (1.001, "kernel")])
def test_auto_takes_the_kernel_down_to_the_documented_limit(factor, expected):
    eps = factor * 2 / (math.log(torch.finfo(torch.float32).max) - math.log(30 * 20))
    fx, fy = rand(1, 30, 3, dtype=torch.float32), rand(1, 20, 3, seed=1, dtype=torch.float32)
    dense = {domain: sinkhorn(fx, fy, eps=eps, domain=domain).log_dense() for domain in ("auto", *DOMAINS)}
    assert not torch.equal(dense["kernel"], dense["log"])
    assert torch.equal(dense["auto"], dense[expected])


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("cost", ["sqeuclidean", "dot"])
def test_auto_looks_at_the_size_of_unbounded_costs(cost, scale):
    fx, fy = (scale * rand(1, 30, 3, seed=s, dtype=torch.float32) for s in (0, 1))
    plan = sinkhorn(fx, fy, cost=cost, eps=0.5)
    expected = log_algorithm(cost_matrix(fx[0].double(), fy[0].double(), cost), 0.5, 5)
    assert_near(plan.dense()[0], expected.exp().float(), 1e-5 * scale**2)
    given = sinkhorn_from_cost(cost_matrix(fx[0], fy[0], cost)[None], eps=0.5)
    assert_near(given.dense()[0], expected.exp().float(), 1e-5 * scale**2)


@pytest.mark.parametrize("num", [1, 2, 50])
def test_kernel_domain_holds_at_its_limit(num):
    """The worst cost, 2 everywhere, gives the uniform plan."""
    eps = 1.0001 * 2 / (math.log(torch.finfo(torch.float32).max) - math.log(num * num))
    features = torch.tensor([0.6, 0.8]).expand(1, num, 2)
    assert_near(sinkhorn(features, -features, eps=eps).dense(), torch.full((1, num, num), num**-2), 1e-4)


@pytest.mark.parametrize("reach", [None, 1e-3])
@pytest.mark.parametrize("store", ["keep", "stream"])
def test_column_that_every_row_shuns(store, reach):
    """In unbalanced transport nothing makes up for its cost: its mass underflows, and is summed again on its own."""
    fx = torch.tensor([[[1.0, 0.0], [0.9, 0.1], [0.8, -0.1]]])
    fy = torch.cat([fx, torch.tensor([[[-1.0, 0.05]]])], 1)
    leaf, exact = fx.clone().requires_grad_(), fx.double().requires_grad_()
    plan = sinkhorn(leaf, fy, eps=1e-3, n_iters=3, reach=reach, store=store)
    power = 1.0 if reach is None else reach / (reach + 1e-3)
    expected = log_algorithm(cost_matrix(exact[0], fy[0].double()), 1e-3, 3, power)
    assert_near(plan.log_dense()[0], expected.float(), 1e-5)
    upstream = rand(3, 4, seed=1)
    (truth,) = torch.autograd.grad((expected * upstream).sum(), exact)
    (gradient,) = torch.autograd.grad((plan.log_dense()[0] * upstream).sum(), leaf)
    assert_near(gradient, truth.float(), 1e-3)


# Features


@domains
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_features_have_cosine_zero_and_no_gradient(dtype, domain):
    fx, fy = rand(1, 6, 3, dtype=dtype), rand(1, 5, 3, seed=1, dtype=dtype)
    fx[0, 2], fy[0, 4] = 0, 0
    fx.requires_grad_(), fy.requires_grad_()
    plan = sinkhorn(fx, fy, eps=0.1, domain=domain).dense()
    # Oracle: the zero feature points along an axis of its own.
    wide_x, wide_y = (torch.cat([f.detach()[0], torch.zeros(f.shape[1], 2, dtype=dtype)], 1) for f in (fx, fy))
    wide_x[2, 3], wide_y[4, 4] = 1, 1
    wide_x.requires_grad_(), wide_y.requires_grad_()
    expected = algorithm_1(cost_matrix(wide_x, wide_y), 0.1, 5)
    tol, upstream = 1e-5 if dtype == torch.float32 else 1e-12, rand(6, 5, seed=3, dtype=dtype)
    assert_near(plan[0], expected, tol)
    got = torch.autograd.grad(plan[0], [fx, fy], upstream)
    truths = torch.autograd.grad(expected, [wide_x, wide_y], upstream)
    for gradient, truth, zero in zip(got, truths, (2, 4), strict=True):
        assert (gradient[0, zero] == 0).all()
        others = torch.arange(gradient.shape[1]) != zero
        assert_near(gradient[0, others], truth[others, :3], 10 * tol)


@grads
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
@domains
def test_all_features_zero(domain, cost, grad):
    """Nothing tells rows apart: the plan is uniform, its gradient finite."""
    fx, fy = (torch.zeros(1, n, 3, requires_grad=True) for n in (6, 5))
    plan = sinkhorn(fx, fy, cost=cost, grad=grad, domain=domain)
    assert_near(plan.dense(), torch.full((1, 6, 5), 1 / 30), 1e-6)
    for gradient in torch.autograd.grad((plan @ rand(1, 5, 2)).sum() + plan.entropy().sum(), [fx, fy]):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("domain", ["auto", *DOMAINS])
def test_opposite_features_in_float32(domain):
    """A column opposite to every row has scalings near exp(2 / eps) = 1e29, whose squares float32 does not hold."""
    fx = 0.1 * rand(1, 6, 3) + torch.tensor([1.0, 0, 0])
    fy = torch.cat([rand(1, 4, 3, seed=1), -fx[:, :2]], 1)
    upstream, results = rand(1, 6, 6, seed=2), {}
    for dtype in (torch.float32, torch.float64):
        x, y = (f.to(dtype).requires_grad_() for f in (fx, fy))
        plan = sinkhorn(x, y, domain=domain).dense()
        results[dtype] = [plan, *torch.autograd.grad(plan, [x, y], upstream.to(dtype))]
    for low, high in zip(*results.values(), strict=True):
        assert_near(low, high.float(), 2e-3)


@domains
@pytest.mark.parametrize("n_iters", [1, 5])
def test_equal_features_share_equally(domain, n_iters):
    """Doubling every row halves its mass, and changes nothing else."""
    fx, fy = leaves((1, 5, 3), (1, 4, 3))
    once = sinkhorn(fx, fy, eps=0.1, n_iters=n_iters, domain=domain).dense()
    twice = sinkhorn(fx.repeat(1, 2, 1), fy, eps=0.1, n_iters=n_iters, domain=domain).dense()
    assert_near(twice, once.repeat(1, 2, 1) / 2, 1e-13)
    upstream = rand(1, 5, 4, seed=3)
    expected = torch.autograd.grad(once, [fx, fy], upstream)
    got = torch.autograd.grad(twice, [fx, fy], upstream.repeat(1, 2, 1))
    for gradient, truth in zip(got, expected, strict=True):
        assert_near(gradient, truth, 1e-11)


@pytest.mark.parametrize(("dtype", "tol"), [(torch.float32, 1e-4), (torch.float64, 1e-12)])
def test_only_directions_of_features_count(dtype, tol):
    """Lengths from 1e-25 to 1e20, whose squares float32 does not hold."""
    fx, fy = (rand(1, n, 4, seed=n, dtype=dtype).requires_grad_() for n in (9, 7))
    lengths = torch.logspace(-25, 20, 9, dtype=dtype)[None, :, None]
    plan, expected = sinkhorn(fx * lengths, fy * 1e18).dense(), sinkhorn(fx, fy).dense()
    assert_near(plan, expected, tol)
    upstream = rand(1, 9, 7, dtype=dtype)
    truths = torch.autograd.grad(expected, [fx, fy], upstream)
    for gradient, truth in zip(torch.autograd.grad(plan, [fx, fy], upstream), truths, strict=True):
        assert_near(gradient, truth, 10 * tol)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
@pytest.mark.parametrize("size", [1.0, 300.0, 3e4])
def test_half_precision_features(size, cost, dtype):
    """Read in float32: squares beyond 65504 do not overflow, and plans are as exact as float32's."""
    fx, fy = ((size * rand(1, n, 4, seed=n).clamp(-2, 2)).to(dtype).requires_grad_() for n in (40, 30))
    eps = 0.1 if cost == "cosine" else 0.1 * size**2
    plan = sinkhorn(fx, fy, cost=cost, eps=eps)
    wide = [f.detach().double().requires_grad_() for f in (fx, fy)]
    expected = sinkhorn(*wide, cost=cost, eps=eps)
    assert plan.dtype == torch.float32
    assert_near(plan.dense(), expected.dense().float(), 1e-4)
    loss, truth = size * plan.entropy().sum(), size * expected.entropy().sum()
    for gradient, exact in zip(torch.autograd.grad(loss, [fx, fy]), torch.autograd.grad(truth, wide), strict=True):
        assert gradient.dtype == dtype
        assert_near(gradient.float(), exact.float(), 1e-2)


def test_dtype_is_the_wider_of_the_inputs():
    x, y = rand(1, 3, 2), rand(1, 4, 2, dtype=torch.float32)
    assert sinkhorn(x, y).dense().dtype == torch.float64
    assert sinkhorn(x.half(), y.half()).dense().dtype == torch.float32
    assert sinkhorn_from_cost(x.half()).dense().dtype == torch.float32


@grads
@domains
def test_single_rows_and_columns_have_uniform_plans_and_no_gradient(domain, grad):
    for num_x, num_y in ((1, 6), (6, 1), (1, 1)):
        fx, fy = leaves((1, num_x, 3), (1, num_y, 3))
        plan = sinkhorn(fx, fy, grad=grad, domain=domain)
        dense = plan.dense()
        assert_near(dense, torch.full_like(dense, 1 / (num_x * num_y)), 1e-13)
        assert plan.mutual()[1].sum() == 1 and (plan.assign() >= 0).sum() == 1
        for gradient in torch.autograd.grad(dense, [fx, fy], rand(1, num_x, num_y)):
            assert gradient.abs().amax() < 1e-12


# Numbers that are not finite


@domains
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
@pytest.mark.parametrize("side", [0, 1])
def test_a_number_that_is_not_finite_spoils_its_own_sample_alone(side, cost, bad, domain):
    """Not silently: its sample is NaN. The others keep value and gradient."""
    clean = [rand(3, 6, 4), rand(3, 5, 4, seed=1)]
    spoilt = [f.clone() for f in clean]
    spoilt[side][1, 2, 0] = bad
    results = []
    for features in (clean, spoilt):
        inputs = [f.clone().requires_grad_() for f in features]
        plan = sinkhorn(*inputs, cost=cost, eps=0.5, domain=domain)
        warped = plan.barycentric(rand(3, 5, 2, seed=2))
        assert plan.argmax().shape == (3, 6) and plan.topk(2)[1].shape == (3, 6, 2)
        results.append((warped, plan.cost(), *torch.autograd.grad(warped.square().sum(), inputs)))
    others = [0, 2]
    for truth, value in zip(*results, strict=True):
        assert torch.equal(value[others], truth[others])
    assert results[1][0][1].isnan().any() and not results[1][1][1].isfinite()


@pytest.mark.parametrize("side", ["x", "y"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_check_finite_names_the_sample_and_ignores_masked_vertices(bad, side):
    fx, fy = rand(2, 6, 4), rand(2, 5, 4, seed=1)
    spoilt = fx if side == "x" else fy
    clean = spoilt.clone()
    spoilt[1, 2, 0] = bad
    with pytest.raises(ValueError, match="sample 1 has features that are not finite; mask those vertices or mend them"):
        sinkhorn(fx, fy, check_finite=True)
    mask = torch.ones(spoilt.shape[:2], dtype=torch.bool)
    mask[1, 2] = False
    masked = sinkhorn(fx, fy, check_finite=True, **{f"mask_{side}": mask}).dense()
    spoilt.copy_(clean)
    assert torch.equal(masked, sinkhorn(fx, fy, **{f"mask_{side}": mask}).dense())


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
@domains
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
def test_masked_rows_may_hold_anything(bad, domain, cost):
    fx, fy = rand(2, 6, 4, dtype=torch.float32), rand(2, 5, 4, seed=1, dtype=torch.float32)
    mask_x, mask_y = torch.ones(2, 6, dtype=torch.bool), torch.ones(2, 5, dtype=torch.bool)
    mask_x[0, 1], mask_x[1, 4:], mask_y[1, 0] = False, False, False
    results = []
    for fill in (0.0, bad):
        x = torch.where(mask_x[..., None], fx, fill).requires_grad_()
        y = torch.where(mask_y[..., None], fy, fill).requires_grad_()
        v = torch.where(mask_y[..., None], rand(2, 5, 3, dtype=torch.float32), fill).requires_grad_()
        plan = sinkhorn(x, y, cost=cost, eps=0.5, mask_x=mask_x, mask_y=mask_y, domain=domain)
        loss = plan.barycentric(v).square().sum() + plan.cost().sum() + (plan @ v).sum()
        results.append([loss, plan.dense(), plan.residual, *torch.autograd.grad(loss, [x, y, v])])
    for value, truth in zip(*results, strict=True):
        assert truth.isfinite().all() and torch.equal(value, truth)


# Samples without mass


@grads
@domains
@pytest.mark.parametrize("empty", ["x", "y", "both"])
@pytest.mark.parametrize("reach", [None, 0.5])
def test_a_sample_without_real_vertices_carries_no_mass_and_no_nan(reach, empty, domain, grad):
    fx, fy, v, u = leaves((2, 4, 3), (2, 5, 3), (2, 5, 2), (2, 4, 2))
    mask_x, mask_y = torch.ones(2, 4, dtype=torch.bool), torch.ones(2, 5, dtype=torch.bool)
    mask_x[1], mask_y[1] = empty == "y", empty == "x"
    options = {"eps": 0.3, "n_iters": 30, "reach": reach, "grad": grad, "domain": domain}
    plan = sinkhorn(fx, fy, mask_x=mask_x, mask_y=mask_y, **options)
    single = sinkhorn(fx[:1], fy[:1], **options)
    total = torch.zeros(())
    for read, _ in READINGS.values():
        value = read(plan, v, u)
        assert_near(value[:1], read(single, v[:1], u[:1]), 1e-12)
        assert (value[1] == 0).all()
        total = total + (value * rand(*value.shape)).sum()
    assert plan.residual[1] == 0 and all((p[1] == -torch.inf).all() for p in plan.potentials)
    assert not plan.mutual()[1][1].any() and (plan.assign()[1] == -1).all()
    masses, index = plan.topk(3)
    assert (masses[1] == 0).all() and (index[1] == 0).all() and (plan.argmax(1)[1] == 0).all()
    for gradient in torch.autograd.grad(total, [fx, fy]):
        assert gradient.isfinite().all() and (gradient[1] == 0).all()


def test_weights_that_are_all_zero_carry_no_mass():
    fx, fy = leaves((2, 4, 3), (2, 5, 3))
    a = torch.full((2, 4), 0.25, dtype=torch.float64)
    a[1] = 0
    dense = sinkhorn(fx, fy, a=a).dense()
    assert (dense[1] == 0).all() and dense[0].sum() > 0.99
    assert (torch.autograd.grad(dense.square().sum(), fx)[0][1] == 0).all()


def test_given_cost_of_a_fully_masked_sample():
    cost = rand(2, 4, 3).requires_grad_()
    mask = torch.tensor([[True] * 4, [False] * 4])
    for reach in (None, 0.5):
        dense = sinkhorn_from_cost(cost, mask_x=mask, reach=reach).dense()
        assert (dense[1] == 0).all() and (dense[0] > 0).all()
        assert (torch.autograd.grad(dense.square().sum(), cost)[0][1] == 0).all()


# Errors

X, Y = torch.ones(1, 4, 3), torch.ones(1, 5, 3)


def features(x: tuple[int, ...], y: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    return torch.ones(x), torch.ones(y)


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        ((4, 3), (1, 5, 3), r"\(B, N, D\) and \(B, M, D\), got \(4, 3\) and \(1, 5, 3\)$"),
        ((4, 3), (5, 3), r"got \(4, 3\) and \(5, 3\); add a batch dimension with \[None\]"),
        ((1, 4, 3), (5, 3), r"got \(1, 4, 3\) and \(5, 3\)"),
        ((2, 4, 3), (1, 5, 3), "features must be"),
        ((1, 4, 3), (1, 5, 2), "features must be"),
        ((1, 0, 3), (1, 5, 3), r"a set is empty: got features \(1, 0, 3\) and \(1, 5, 3\)"),
        ((1, 4, 3), (1, 0, 3), r"a set is empty: got features \(1, 4, 3\) and \(1, 0, 3\)"),
        ((0, 4, 3), (0, 5, 3), "a set is empty"),
        ((1, 4, 0), (1, 5, 0), "a set is empty"),
    ],
)
def test_feature_errors(x, y, message):
    with pytest.raises(ValueError, match=message):
        sinkhorn(*features(x, y))
    with pytest.raises(ValueError, match=message):
        sinkhorn_warp(*features(x, y), torch.ones(1, 5, 2))


@pytest.mark.parametrize("shape", [(4, 5), (1, 0, 5), (1, 4, 0), (1, 1, 4, 5)])
def test_cost_errors(shape):
    with pytest.raises(ValueError, match=rf"cost must be \(B, N, M\) .* got {re.escape(str(shape))}"):
        sinkhorn_from_cost(torch.ones(shape))


OPTION_ERRORS = [
    ({"eps": 0.0}, "eps must be positive and finite, got 0$"),
    ({"eps": -0.1}, r"eps must be positive and finite, got -0\.1"),
    ({"eps": math.nan}, "eps must be positive and finite, got nan"),
    ({"eps": math.inf}, "eps must be positive and finite, got inf"),
    ({"eps": torch.zeros(())}, "eps must be positive"),
    ({"eps": torch.ones(2)}, r"eps as a tensor must hold one value, got shape \(2,\)"),
    ({"eps": []}, "a sequence of eps needs at least one value"),
    ({"eps": "0.1"}, "eps must be a number, a scalar tensor or a sequence of numbers, got str"),
    ({"n_iters": 2.5}, "n_iters must be an integer of at least 1, got 2.5"),
    ({"reach": [1.0, 2.0, 3.0]}, "reach must be None, a number, or a pair"),
    ({"eps": [1.0, 0.0, 0.5]}, r"every eps must be positive, got \[1\.0, 0\.0, 0\.5\]"),
    ({"eps": [1.0, -0.5]}, "every eps must be positive"),
    ({"eps": [-1.0, 0.5]}, "every eps must be positive"),
    ({"eps": [1.0, torch.tensor(0.5)]}, "must hold numbers: it receives no gradient"),
    ({"eps": [1.0, 0.5], "domain": "kernel"}, 'a sequence of eps needs domain="log" or "auto"'),
    ({"eps": [1.0, 0.5], "reach": 1.0}, "reach cannot be combined with a sequence of eps"),
    ({"eps": torch.ones((), requires_grad=True), "reach": 1.0}, "reach cannot be combined with a learned eps"),
    ({"n_iters": 0}, "n_iters must be an integer of at least 1, got 0"),
    ({"tol": -1e-3}, r"tol must be None or at least 0, got -0\.001"),
    ({"tol": math.nan}, "tol must be None or at least 0, got nan"),
    ({"reach": 0.0}, r"reach must be positive, or None for an exact marginal, got 0\.0"),
    ({"reach": (1.0, -2.0)}, r"reach must be positive, .* got \(1\.0, -2\.0\)"),
    ({"reach": math.nan}, "reach must be positive"),
    ({"grad": "exact"}, "grad must be one of .*'unroll'.* got 'exact'"),
    ({"domain": "dual"}, "domain must be one of .*'kernel', 'log'.* got 'dual'"),
    ({"store": "yes"}, "store must be one of .*'stream', 'keep'.* got 'yes'"),
    ({"mask_x": torch.ones(1, 5, dtype=torch.bool)}, r"mask_x must have shape \(1, 4\) .* got \(1, 5\)"),
    ({"mask_y": torch.ones(1, 4, dtype=torch.bool)}, r"mask_y must have shape \(1, 5\) .* got \(1, 4\)"),
    ({"mask_x": torch.ones(1, 4)}, "mask_x must be .*bool.* got torch.float32"),
    ({"a": torch.ones(1, 5)}, r"a must have shape \(1, 4\) or \(4,\), got \(1, 5\)"),
    ({"b": torch.ones(4)}, r"b must have shape \(1, 5\) or \(5,\), got \(4,\)"),
    ({"a": torch.tensor([0.5, 0.6, 0.1, -0.2])}, "a must be finite and at least 0"),
    ({"b": torch.tensor([0.5, 0.1, 0.1, 0.1, math.nan])}, "b must be finite and at least 0"),
    ({"b": torch.tensor([0.5, 0.1, 0.1, 0.1, math.inf])}, "b must be finite and at least 0"),
    ({"a": torch.ones(4)}, r"a and b must have the same sum in every sample, got \[4\.0\] and \[1\.0\]; normalise"),
    ({"a": torch.ones(4), "b": torch.ones(5)}, r"got \[4\.0\] and \[5\.0\]; .* or give reach"),
]


@pytest.mark.parametrize(("options", "message"), OPTION_ERRORS)
def test_option_errors(options, message):
    with pytest.raises(ValueError, match=message):
        sinkhorn(X, Y, **options)
    with pytest.raises(ValueError, match=message):
        sinkhorn_from_cost(torch.ones(1, 4, 5), **options)


def test_unknown_cost():
    with pytest.raises(ValueError, match=r"cost must be one of .*'cosine'.* got 'l1'"):
        sinkhorn(X, Y, cost="l1")


def test_reach_lets_totals_differ():
    assert sinkhorn(X, Y, a=torch.ones(4), reach=1.0).dense().isfinite().all()
    assert sinkhorn(X, Y, a=torch.ones(4), b=torch.full((5,), 0.8)).dense().isfinite().all()


@pytest.mark.parametrize(
    "arguments",
    [
        (0.1, 0.2, 0.5),
        (1.0, 0.0, 0.5),
        (1.0, 0.1, 1.0),
        (1.0, 0.1, 0.0),
        (1, 0.1, -1),
        (math.inf, 0.1, 0.5),
        (math.nan, 0.1, 0.5),
    ],
)
def test_schedule_errors(arguments):
    start, final, factor = arguments
    with pytest.raises(ValueError, match="need finite start >= final > 0 and 0 < factor < 1, got"):
        eps_schedule(start, final, factor=factor)


def test_schedule_is_geometric_and_ends_exactly():
    values = eps_schedule(1.0, 0.03, factor=0.8)
    assert values[0] == 1.0 and values[-1] == 0.03
    assert all(later == pytest.approx(0.8 * value) for value, later in itertools.pairwise(values[:-1]))
    assert 0.8 * values[-2] <= 0.03 < values[-2]
    assert eps_schedule(0.5, 0.5) == [0.5]


def test_no_warnings_in_ordinary_use():
    fx, fy = leaves((1, 6, 3), (1, 5, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for grad in ("unroll", "last_step", "implicit"):
            sinkhorn(fx, fy, eps=0.2, n_iters=50, grad=grad).cost().sum().backward()


@domains
def test_implicit_gradient_of_one_potential_leaves_its_free_constant_out(domain):
    """Balanced transport fixes potentials up to a constant, along which the implicit system is singular."""
    fx, fy = leaves((1, 6, 3), (1, 5, 3))
    upstream = rand(1, 5, seed=2)
    gradients = []
    for direction in (upstream, upstream - upstream.mean()):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            potential = sinkhorn(fx, fy, eps=0.3, n_iters=200, grad="implicit", domain=domain).potentials[1]
            gradients.append(torch.autograd.grad((potential * direction).sum(), [fx, fy]))
    potential = sinkhorn(fx, fy, eps=0.3, n_iters=200, domain=domain).potentials[1]
    truths = torch.autograd.grad((potential * (upstream - upstream.mean())).sum(), [fx, fy])
    for gradient, centred, truth in zip(*gradients, truths, strict=True):
        assert_near(centred, truth, 1e-9)
        assert_near(gradient, truth, 1e-9)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_implicit_gradient_of_the_free_constant_is_zero(seed, dtype):
    """The sum of the column potentials is that constant: what is left of it after projection is rounding noise."""
    fx, fy = (t.detach().to(dtype).requires_grad_() for t in leaves((1, 12, 3), (1, 9, 3), seed=seed))
    options = {"eps": 0.3, "n_iters": 1000, "tol": 1e-14}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        g = sinkhorn(fx, fy, grad="implicit", **options).potentials[1]
        gradients = torch.autograd.grad(g.sum(), [fx, fy])
    g = sinkhorn(fx, fy, **options).potentials[1]
    scale = max(t.abs().amax().item() for t in torch.autograd.grad(g.sum(), [fx, fy], retain_graph=True))
    truths = torch.autograd.grad((g - g.mean()).sum(), [fx, fy])
    for gradient, truth in zip(gradients, truths, strict=True):
        assert_near(gradient, truth, 1e-5 if dtype == torch.float32 else 1e-12, scale=scale)


def test_implicit_system_is_solved_relative_to_what_was_projected():
    """Noise of the size that projecting leaves is answered with 0, and no step is taken along no curvature."""
    noise = 1e-9 * rand(5, dtype=torch.float32)
    assert not conjugate_gradient(lambda z: 0 * z, noise, torch.tensor(1.0)).any()
    assert not conjugate_gradient(lambda z: 0 * z, noise, noise.norm()).any()


@domains
def test_implicit_potentials_are_given_and_differentiated_in_one_gauge(domain):
    """Those of the columns have mean 0 under their weights, and so do their changes."""
    fx, fy, logits = leaves((1, 7, 3), (1, 5, 3), (1, 5))
    readings, b = [], logits.softmax(1)
    for grad in ("implicit", "unroll"):
        f, g = sinkhorn(fx, fy, b=b, eps=0.5, n_iters=300, tol=1e-13, grad=grad, domain=domain).potentials
        mean = (b * g).sum()
        if grad == "implicit":
            assert abs(mean) < 1e-12
            mean = torch.zeros_like(mean)
        readings.append(((f + mean).square().sum() + (g - mean).pow(3).sum(), [fx, fy, logits]))
    gradients, truths = (torch.autograd.grad(value, inputs, retain_graph=True) for value, inputs in readings)
    assert_near(readings[0][0], readings[1][0].detach(), 1e-10)
    for gradient, truth in zip(gradients, truths, strict=True):
        assert_near(gradient, truth, 1e-8)


def test_numpy_numbers_are_numbers():
    options = {"n_iters": np.int64(30), "eps": np.float32(0.5), "reach": np.float64(2.0), "tol": np.float32(1e-3)}
    plan = sinkhorn(X, X, **options)
    assert torch.equal(
        plan.dense(), sinkhorn(X, X, n_iters=30, eps=0.5, reach=2.0, tol=float(np.float32(1e-3))).dense()
    )
    falling = np.linspace(1.0, 0.5, 6)
    assert torch.equal(sinkhorn(X, X, eps=falling).dense(), sinkhorn(X, X, eps=falling.tolist()).dense())
    assert sinkhorn_divergence(X, X + 1, eps=np.float32(0.5), n_iters=np.int64(50)).isfinite().all()
    assert SinkhornCorrespondence(eps=np.float32(0.5), reach=(np.float32(1.0), None))(X, X).n_iters == [5] * len(X)
    with pytest.raises(ValueError, match=r"n_iters must be an integer of at least 1, got '5'"):
        sinkhorn(X, X, n_iters="5")


def test_features_must_be_floating_point_tensors():
    for features in (X.long(), X.numpy()):
        with pytest.raises(ValueError, match=r"features must be floating-point tensors, got .*torch\.as_tensor"):
            sinkhorn(features, Y)


@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
def test_mixed_precision_inputs_are_promoted(cost):
    plan = sinkhorn(X.float(), Y.double(), cost=cost, eps=1.0)
    assert plan.dtype == torch.float64
    assert_near(plan.dense(), sinkhorn(X.float().double(), Y.double(), cost=cost, eps=1.0).dense(), 1e-12)


def test_a_schedule_longer_than_n_iters_is_run_to_its_end():
    schedule = eps_schedule(1.0, 0.05)
    plan = sinkhorn(X.double(), Y.double(), eps=schedule)
    assert plan.n_iters == [len(schedule)] and len(schedule) > 5


def test_auto_domain_does_not_depend_on_the_scale_of_the_weights():
    fx, fy = torch.zeros(1, 1, 1), torch.full((1, 1, 1), 110.0**0.5)
    plan = sinkhorn(fx, fy, cost="sqeuclidean", eps=1.0, a=torch.full((1,), 1e6), b=torch.full((1,), 1e6))
    assert_near(plan.dense(), torch.full((1, 1, 1), 1e6), 1e-5)


def test_tolerance_is_a_share_of_the_total():
    fx, fy = rand(1, 8, 3), rand(1, 9, 3, seed=1)
    mu, nu = torch.full((8,), 1 / 8, dtype=torch.float64), torch.full((9,), 1 / 9, dtype=torch.float64)
    counts = [sinkhorn(fx, fy, eps=0.1, n_iters=500, tol=1e-6, a=s * mu, b=s * nu).n_iters for s in (1, 3e5)]
    assert counts[0] == counts[1] and 5 < counts[0][0] < 500


def test_nearest_entries_under_autocast_are_those_of_float32():
    fx, fy = rand(1, 50, 16).float(), rand(1, 40, 16, seed=1).float()
    fx = fx[:, :1] + 1e-2 * fx  # close neighbours, which bfloat16 cannot tell apart
    fy = fx[:, :40] + 1e-3 * fy
    expected = sinkhorn(fx, fy, eps=0.01)
    with torch.autocast("cpu", torch.bfloat16):
        plan = sinkhorn(fx, fy, eps=0.01)
        assert torch.equal(plan.argmax(), expected.argmax()) and torch.equal(plan.argmax(1), expected.argmax(1))
        assert all(torch.equal(a, b) for a, b in zip(plan.mutual(), expected.mutual(), strict=True))
        assert torch.equal(plan.topk(3)[1], expected.topk(3)[1])


def test_plans_say_what_they_are_and_take_negative_dimensions():
    plan = sinkhorn(X, Y)
    assert "shape=(1, 4, 5)" in repr(plan) and "eps=0.03" in repr(plan)
    assert torch.equal(plan.argmax(-1), plan.argmax(2)) and torch.equal(plan.argmax(-2), plan.argmax(1))


def test_pages_of_passes_that_do_not_reach_the_kernel_do_not_pile_up():
    fx, values = rand(1, 4, 3).requires_grad_(), rand(1, 5, 2).requires_grad_()
    plan = sinkhorn(fx, rand(1, 5, 3, seed=1))
    out = plan.barycentric(values).sum()
    expected = torch.autograd.grad(out, fx, retain_graph=True)[0]
    for _ in range(5):
        torch.autograd.grad(out, values, retain_graph=True)
    assert len(plan._samples[0].kernel.ledger._pages) <= 2
    assert_near(torch.autograd.grad(out, fx)[0], expected, 1e-13)


def test_a_divergence_reads_its_options_once(monkeypatch):
    module = importlib.import_module("meshkit.ot.divergence")
    calls, read = [], module.read_options
    monkeypatch.setattr(module, "read_options", lambda *options: calls.append(options) or read(*options))
    assert sinkhorn_divergence(X, Y, eps=0.5).isfinite().all() and len(calls) == 1
