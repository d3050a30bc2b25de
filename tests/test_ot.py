"""Sinkhorn against the paper's Algorithm 1 under autograd, closed forms, and SciPy's exact assignment."""

import math

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.autograd import gradcheck

from meshkit.ot import TransportPlan, sinkhorn

DOMAINS = ["kernel", "log"]
domains = pytest.mark.parametrize("domain", DOMAINS)


def algorithm_1(fx: Tensor, fy: Tensor, eps: float, n_iters: int) -> Tensor:
    """The paper's Algorithm 1 as printed, on one pair of feature sets (N, D) and (M, D)."""
    n_id, n_pose = len(fx), len(fy)
    cosine = (fx @ fy.T) / (fx.norm(dim=1)[:, None] * fy.norm(dim=1)[None, :])
    u = torch.exp(-(1 - cosine) / eps)
    a = torch.ones(n_id, dtype=fx.dtype) / n_id
    for _ in range(n_iters):
        b = (torch.ones(n_pose, dtype=fx.dtype) / n_pose) / (u.T @ a)
        a = (torch.ones(n_id, dtype=fx.dtype) / n_id) / (u @ b)
    return torch.diag(a) @ u @ torch.diag(b)


def leaves(*shapes: tuple[int, ...], seed: int = 0) -> list[Tensor]:
    return [rand(*shape, seed=seed + i).requires_grad_() for i, shape in enumerate(shapes)]


# The algorithm and its gradient


@domains
@pytest.mark.parametrize("eps", [0.03, 0.2])
@pytest.mark.parametrize("n_iters", [1, 2, 5])
@pytest.mark.parametrize(("num_x", "num_y"), [(12, 12), (13, 7), (6, 15), (1, 6), (6, 1), (1, 1)])
def test_plan_and_gradient_equal_algorithm_1(num_x, num_y, n_iters, eps, domain):
    fx, fy = leaves((2, num_x, 5), (2, num_y, 5))
    upstream = rand(2, num_x, num_y, seed=9)
    expected = torch.stack([algorithm_1(x, y, eps, n_iters) for x, y in zip(fx, fy, strict=True)])
    plan = sinkhorn(fx, fy, eps=eps, n_iters=n_iters, domain=domain).dense()
    assert_near(plan, expected, 1e-12)
    gradients = torch.autograd.grad(plan, [fx, fy], upstream)
    for gradient, truth in zip(gradients, torch.autograd.grad(expected, [fx, fy], upstream), strict=True):
        assert_near(gradient, truth, 1e-10, scale=max(1.0, truth.abs().amax().item()))


@domains
def test_gradient_of_the_warp_equals_algorithm_1(domain):
    """Through the row-normalised warp, where the row scaling drops out of the value but not out of the iterations."""
    fx, fy, values = leaves((1, 11, 4), (1, 8, 4), (1, 8, 3))
    dense = algorithm_1(fx[0], fy[0], 0.03, 5)
    expected = dense @ values[0] / dense.sum(1, keepdim=True)
    warped = sinkhorn(fx, fy, domain=domain).barycentric(values)[0]
    assert_near(warped, expected, 1e-12)
    upstream, inputs = rand(11, 3, seed=5), [fx, fy, values]
    truths = torch.autograd.grad(expected, inputs, upstream)
    for gradient, truth in zip(torch.autograd.grad(warped, inputs, upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-10)


def test_defaults_are_those_of_the_paper():
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)
    assert_near(sinkhorn(fx, fy).dense()[0], algorithm_1(fx[0], fy[0], eps=0.03, n_iters=5), 1e-12)


@domains
@pytest.mark.parametrize(
    "read",
    [
        lambda plan, v, u: plan.barycentric(v),
        lambda plan, v, u: plan @ v,
        lambda plan, v, u: plan.T @ u,
        lambda plan, v, u: plan.T.barycentric(u),
        lambda plan, v, u: plan.row_sums(),
        lambda plan, v, u: plan.marginals()[1],
        lambda plan, v, u: plan.dense(),
    ],
    ids=["barycentric", "matmul", "T-matmul", "T-barycentric", "row_sums", "column_sums", "dense"],
)
def test_gradcheck(read, domain):
    fx, fy, v, u = leaves((2, 4, 3), (2, 3, 3), (2, 3, 2), (2, 4, 2))
    masks = {"mask_x": torch.tensor([[True] * 4, [True, False, True, True]]), "mask_y": None}

    def function(fx: Tensor, fy: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return read(sinkhorn(fx, fy, eps=0.2, n_iters=3, domain=domain, **masks), v, u)

    assert gradcheck(function, [fx, fy, v, u])


@domains
def test_second_derivative_is_right_or_refused(domain):
    """A gradient penalty must not train on a silently wrong number."""
    fx, fy = leaves((1, 5, 3), (1, 4, 3))
    seconds = []
    for plan in (algorithm_1(fx[0], fy[0], 0.2, 3), sinkhorn(fx, fy, eps=0.2, n_iters=3, domain=domain).dense()[0]):
        try:
            (first,) = torch.autograd.grad((plan * rand(5, 4, seed=7)).sum(), fx, create_graph=True)
            seconds.append(torch.autograd.grad(first.square().sum(), [fx, fy]))
        except RuntimeError:
            return
    for value, expected in zip(seconds[1], seconds[0], strict=True):
        assert_near(value, expected, 1e-9)


# Closed forms


@domains
@pytest.mark.parametrize("eps", [0.03, 1.0])
@pytest.mark.parametrize("num", [2, 5])
def test_orthogonal_features(num, eps, domain):
    """K is 1 on the diagonal and k = exp(-1/eps) elsewhere: one scaling makes it doubly stochastic."""
    features = torch.eye(num, dtype=torch.float64)[None] * 3
    k = math.exp(-1 / eps)
    expected = (torch.eye(num, dtype=torch.float64) * (1 - k) + k) / (num * (1 + (num - 1) * k))
    for n_iters in (1, 4):
        assert_near(sinkhorn(features, features, eps=eps, n_iters=n_iters, domain=domain).dense()[0], expected, 1e-13)


@domains
def test_single_rows_and_columns_have_uniform_plans_and_no_gradient(domain):
    for num_x, num_y in ((1, 6), (6, 1), (1, 1)):
        fx, fy = leaves((1, num_x, 3), (1, num_y, 3))
        plan = sinkhorn(fx, fy, domain=domain).dense()
        assert_near(plan, torch.full_like(plan, 1 / (num_x * num_y)), 1e-13)
        for gradient in torch.autograd.grad(plan, [fx, fy], rand(1, num_x, num_y)):
            assert gradient.abs().amax() < 1e-12


def test_small_eps_recovers_the_exact_assignment():
    """At eps -> 0 the plan is the optimal permutation, which nearest neighbours alone would miss."""
    fx, fy = rand(3, 20, 3, seed=3), rand(3, 20, 3, seed=4)
    plan = sinkhorn(fx, fy, eps=1e-3, n_iters=4000)
    cost = 1 - torch.cosine_similarity(fx[:, :, None], fy[:, None], dim=-1)
    for b in range(3):
        best = torch.from_numpy(linear_sum_assignment(cost[b].numpy())[1])
        assert not torch.equal(cost[b].argmin(1), best)
        assert torch.equal(plan.argmax()[b], best)
        assert torch.equal(plan.argmax(1)[b], best.argsort())


# Properties


@domains
@pytest.mark.parametrize("eps", [0.03, 0.2])
def test_row_marginals_are_exact_and_columns_converge(eps, domain):
    fx, fy = rand(2, 15, 4), rand(2, 11, 4, seed=1)
    residuals = []
    for n_iters in (1, 2, 3, 5, 10, 30, 300):
        rows, columns = sinkhorn(fx, fy, eps=eps, n_iters=n_iters, domain=domain).marginals()
        assert_near(rows, torch.full_like(rows, 1 / 15), 1e-13)
        residuals.append((columns - 1 / 11).abs().sum(1))
    steps = torch.stack(residuals)
    assert (steps[1:] < steps[:-1]).all()
    assert (steps[5] < steps[0] / 10).all() and steps[-1].amax() < 1e-10


@domains
def test_permutation_equivariance(domain):
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)
    p, q = torch.randperm(9), torch.randperm(7)
    plan = sinkhorn(fx, fy, domain=domain).dense()
    assert_near(sinkhorn(fx[:, p], fy[:, q], domain=domain).dense(), plan[:, p][:, :, q], 1e-13)


def test_swapping_the_sets_transposes_the_converged_plan():
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)
    forth, back = (sinkhorn(x, y, eps=0.2, n_iters=300) for x, y in ((fx, fy), (fy, fx)))
    assert_near(forth.dense(), back.T.dense(), 1e-11)
    # After one iteration the last update was that of the rows, so the two differ.
    forth, back = (sinkhorn(x, y, eps=0.2, n_iters=1) for x, y in ((fx, fy), (fy, fx)))
    assert (forth.dense() - back.T.dense()).abs().amax() > 1e-4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_only_directions_of_features_count(dtype):
    fx, fy = rand(1, 9, 4, dtype=dtype), rand(1, 7, 4, seed=1, dtype=dtype)
    lengths = torch.logspace(-12, 12, 9, dtype=dtype)[None, :, None]
    tol = 1e-4 if dtype == torch.float32 else 1e-12
    assert_near(sinkhorn(fx * lengths, fy * 1e8).dense(), sinkhorn(fx, fy).dense(), tol)


# Masks


@domains
@pytest.mark.parametrize("garbage", GARBAGE)
def test_padded_batch_equals_the_loop(garbage, domain):
    sizes_x, sizes_y = [5, 8, 1], [9, 4, 3]
    xs = [rand(n, 4, seed=i).requires_grad_() for i, n in enumerate(sizes_x)]
    ys = [rand(n, 4, seed=i + 5).requires_grad_() for i, n in enumerate(sizes_y)]
    vs = [rand(n, 3, seed=i + 10) for i, n in enumerate(sizes_y)]
    mask_x, mask_y = scattered_mask(sizes_x, 10), scattered_mask(sizes_y, 12, seed=1)
    fx, fy = (scatter(s, m, garbage).requires_grad_() for s, m in ((xs, mask_x), (ys, mask_y)))
    plan = sinkhorn(fx, fy, mask_x=mask_x, mask_y=mask_y, domain=domain)
    warped = plan.barycentric(scatter(vs, mask_y, 0.0))
    upstream = rand(3, 10, 3, seed=20)
    loss, dense = (warped * upstream).sum(), plan.dense()
    expected_loss = torch.zeros(())
    for b, (x, y, v) in enumerate(zip(xs, ys, vs, strict=True)):
        single = sinkhorn(x[None], y[None], domain=domain)
        real = mask_x[b][:, None] & mask_y[b]
        assert_near(dense[b][real].view(len(x), len(y)), single.dense()[0], 1e-12)
        assert (dense[b][~real] == 0).all()
        assert (warped[b][~mask_x[b]] == 0).all()
        expected_loss = expected_loss + (single.barycentric(v[None])[0] * upstream[b][mask_x[b]]).sum()
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
def test_full_masks_change_nothing(domain):
    fx, fy = rand(2, 6, 3), rand(2, 5, 3, seed=1)
    masks = {"mask_x": torch.ones(2, 6, dtype=torch.bool), "mask_y": torch.ones(2, 5, dtype=torch.bool)}
    torch.testing.assert_close(
        sinkhorn(fx, fy, domain=domain, **masks).dense(), sinkhorn(fx, fy, domain=domain).dense(), rtol=0, atol=0
    )


@domains
@pytest.mark.parametrize("empty", ["x", "y", "both"])
def test_a_sample_without_real_vertices_carries_no_mass_and_no_nan(empty, domain):
    fx, fy = leaves((2, 4, 3), (2, 5, 3))
    mask_x, mask_y = torch.ones(2, 4, dtype=torch.bool), torch.ones(2, 5, dtype=torch.bool)
    mask_x[1], mask_y[1] = empty == "y", empty == "x"
    plan = sinkhorn(fx, fy, mask_x=mask_x, mask_y=mask_y, domain=domain)
    dense = plan.dense()
    assert_near(dense[:1], sinkhorn(fx[:1], fy[:1], domain=domain).dense(), 1e-13)
    assert (dense[1] == 0).all()
    for gradient in torch.autograd.grad((dense * rand(2, 4, 5)).sum(), [fx, fy]):
        assert gradient.isfinite().all() and (gradient[1] == 0).all()


# Degenerate features


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
    expected = algorithm_1(wide_x, wide_y, 0.1, 5)
    tol, upstream = 1e-5 if dtype == torch.float32 else 1e-12, rand(6, 5, seed=3, dtype=dtype)
    assert_near(plan[0], expected, tol)
    got = torch.autograd.grad(plan[0], [fx, fy], upstream)
    truths = torch.autograd.grad(expected, [wide_x, wide_y], upstream)
    for gradient, truth, zero in zip(got, truths, (2, 4), strict=True):
        assert (gradient[0, zero] == 0).all()
        others = torch.arange(gradient.shape[1]) != zero
        assert_near(gradient[0, others], truth[others, :3], 10 * tol)


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


# Precision and domain


def test_log_domain_serves_small_eps_in_float32():
    fx, fy = rand(1, 20, 3, dtype=torch.float32), rand(1, 16, 3, seed=1, dtype=torch.float32)
    for eps in (0.02, 0.005, 1e-3):  # exp(-2 / eps) underflows: "auto" must leave the kernel
        plan = sinkhorn(fx, fy, eps=eps).dense()
        expected = sinkhorn(fx.double(), fy.double(), eps=eps, domain="log").dense()
        assert_near(plan, expected.float(), 5e-6 / eps)


@pytest.mark.parametrize(("factor", "expected"), [(0.999, "log"), (1.001, "kernel")])
def test_auto_takes_the_kernel_down_to_the_documented_limit(factor, expected):
    eps = factor * 2 / (math.log(torch.finfo(torch.float32).max) - math.log(30 * 20))
    fx, fy = rand(1, 30, 3, dtype=torch.float32), rand(1, 20, 3, seed=1, dtype=torch.float32)
    # The domains differ in where they keep the scalings.
    scalings = {domain: sinkhorn(fx, fy, eps=eps, domain=domain).a for domain in ("auto", *DOMAINS)}
    assert not torch.equal(scalings["kernel"], scalings["log"])
    assert torch.equal(scalings["auto"], scalings[expected])


@pytest.mark.parametrize("num", [1, 2, 50])
def test_kernel_domain_holds_at_its_limit(num):
    """The worst cost, 2 everywhere, gives the uniform plan."""
    eps = 1.0001 * 2 / (math.log(torch.finfo(torch.float32).max) - math.log(num * num))
    features = torch.tensor([0.6, 0.8]).expand(1, num, 2)
    assert_near(sinkhorn(features, -features, eps=eps).dense(), torch.full((1, num, num), num**-2), 1e-4)


@domains
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_autocast_keeps_float32(domain, dtype):
    fx, fy = (f.to(dtype).requires_grad_() for f in (rand(1, 30, 8), rand(1, 20, 8, seed=1)))
    with torch.autocast("cpu", torch.bfloat16):
        plan = sinkhorn(fx, fy, domain=domain)
        dense = plan.dense()
    assert {plan.kernel.dtype, plan.a.dtype, plan.b.dtype, dense.dtype} == {torch.float32}
    # bfloat16 inside would move the logits by 2^-9 / eps: 7 %.
    assert_near(dense, sinkhorn(fx.double(), fy.double(), domain=domain).dense().float(), 1e-4)
    gradients = torch.autograd.grad(dense.square().sum(), [fx, fy])
    assert all(g.dtype == dtype and g.isfinite().all() for g in gradients)


def test_dtype_is_the_wider_of_the_inputs():
    x, y = rand(1, 3, 2), rand(1, 4, 2, dtype=torch.float32)
    assert sinkhorn(x, y).dense().dtype == torch.float64
    assert sinkhorn(x.half(), y.half()).dense().dtype == torch.float32


# The plan object


@pytest.fixture
def plan() -> TransportPlan:
    return TransportPlan(rand(2, 4, 6).exp(), rand(2, 4, seed=1).exp(), rand(2, 6, seed=2).exp())


def test_plan_methods_equal_the_dense_matrix(plan):
    dense = torch.stack(
        [torch.diag(a) @ k @ torch.diag(b) for k, a, b in zip(plan.kernel, plan.a, plan.b, strict=True)]
    )
    values, sources = rand(2, 6, 3, seed=3), rand(2, 4, 3, seed=4)
    assert plan.shape == (2, 4, 6) and plan.T.shape == (2, 6, 4)
    for value, expected in [
        (plan.dense(), dense),
        (plan @ values, dense @ values),
        (plan.barycentric(values), dense @ values / dense.sum(2, keepdim=True)),
        (plan.row_sums(), dense.sum(2)),
        (plan.marginals()[0], dense.sum(2)),
        (plan.marginals()[1], dense.sum(1)),
        (plan.T.dense(), dense.mT),
        (plan.T.T.dense(), dense),
        (plan.T @ sources, dense.mT @ sources),
        (plan.T.barycentric(sources), dense.mT @ sources / dense.sum(1)[..., None]),
    ]:
        assert_near(value, expected, 1e-13)


def test_argmax_equals_that_of_the_dense_matrix():
    for seed in range(5):
        plan = TransportPlan(rand(2, 30, 20, seed=seed).exp(), rand(2, 30, seed=9).exp(), rand(2, 20, seed=8).exp())
        assert torch.equal(plan.argmax(), plan.dense().argmax(2))
        assert torch.equal(plan.argmax(2), plan.T.argmax(1))
        assert torch.equal(plan.argmax(1), plan.dense().argmax(1))


def test_barycentric_is_a_convex_combination_and_reproduces_constants():
    plan = sinkhorn(rand(1, 9, 3), rand(1, 7, 3, seed=1))
    values = rand(1, 7, 2, seed=2)
    warped = plan.barycentric(values)
    assert (warped <= values.amax(1, keepdim=True)).all() and (warped >= values.amin(1, keepdim=True)).all()
    assert_near(plan.barycentric(torch.full_like(values, 3)), torch.full((1, 9, 2), 3.0), 1e-14)


# Errors


@pytest.mark.parametrize(
    ("x", "y", "options", "message"),
    [
        ((4, 3), (1, 5, 3), {}, r"\(B, N, D\) and \(B, M, D\), got \(4, 3\)"),
        ((1, 4, 3), (5, 3), {}, r"got \(1, 4, 3\) and \(5, 3\)"),
        ((2, 4, 3), (1, 5, 3), {}, "features must be"),
        ((1, 4, 3), (1, 5, 2), {}, "features must be"),
        ((1, 0, 3), (1, 5, 3), {}, "a set is empty: got 0 rows and 5 columns"),
        ((1, 4, 3), (1, 0, 3), {}, "a set is empty: got 4 rows and 0 columns"),
        (
            (1, 4, 3),
            (1, 5, 3),
            {"mask_x": torch.ones(1, 5, dtype=torch.bool)},
            r"mask_x must be bool of shape \(1, 4\)",
        ),
        (
            (1, 4, 3),
            (1, 5, 3),
            {"mask_y": torch.ones(1, 4, dtype=torch.bool)},
            r"mask_y must be bool of shape \(1, 5\)",
        ),
        ((1, 4, 3), (1, 5, 3), {"mask_x": torch.ones(1, 4)}, "mask_x must be bool .* got torch.float32"),
        ((1, 4, 3), (1, 5, 3), {"eps": 0.0}, "eps must be positive, got 0.0"),
        ((1, 4, 3), (1, 5, 3), {"eps": math.nan}, "eps must be positive, got nan"),
        ((1, 4, 3), (1, 5, 3), {"n_iters": 0}, "n_iters must be at least 1, got 0"),
        ((1, 4, 3), (1, 5, 3), {"domain": "dual"}, "domain must be .* got 'dual'"),
    ],
)
def test_sinkhorn_errors(x, y, options, message):
    with pytest.raises(ValueError, match=message):
        sinkhorn(torch.ones(x), torch.ones(y), **options)


@pytest.mark.parametrize("shape", [(6, 3), (2, 4, 3), (1, 6, 3)])
def test_plan_errors_name_the_shape(plan, shape):
    for method in (plan.barycentric, plan.__matmul__):
        with pytest.raises(ValueError, match=r"\(B, M\) = \(2, 6\), got"):
            method(torch.ones(shape, dtype=torch.float64))


def test_argmax_error(plan):
    with pytest.raises(ValueError, match=r"dim must be 1 .* or 2 .* got 0"):
        plan.argmax(0)
