"""Sinkhorn divergence, matching with a dustbin and the modules, each against its equation on stored matrices."""

import math
import warnings

import ot
import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from literal_ot import algorithm_1, cost_matrix, costs, leaves, literal_batch, one_by_one, weights  # noqa: F401
from torch import Tensor
from torch.autograd import gradcheck

from meshkit.data import load_humans
from meshkit.ot import (
    CorrespondenceWarp,
    SinkhornCorrespondence,
    TransportPlan,
    eps_schedule,
    log_optimal_transport,
    sinkhorn,
    sinkhorn_divergence,
    sinkhorn_from_cost,
)

# Sinkhorn divergence

CONVERGED = {"n_iters": 400, "tol": 1e-12}


def entropic_cost(x: Tensor, y: Tensor, cost: str, eps: float, mu: Tensor, nu: Tensor) -> Tensor:
    """``<T, C> + eps KL(T | mu nu)`` at the converged plan, with the gradient of all its iterations."""
    matrix = cost_matrix(x, y, cost)
    plan = algorithm_1(matrix, eps, 150, mu, nu)
    return (plan * matrix).sum() + eps * (plan * (plan / (mu[:, None] * nu)).log()).sum()


def literal_divergence(
    x: Tensor, y: Tensor, cost: str, eps: float, mu: Tensor, nu: Tensor, *, debias: bool = True
) -> Tensor:
    value = entropic_cost(x, y, cost, eps, mu, nu)
    if not debias:
        return value
    return value - (entropic_cost(x, x, cost, eps, mu, mu) + entropic_cost(y, y, cost, eps, nu, nu)) / 2


@costs
@pytest.mark.parametrize("debias", [True, False])
@pytest.mark.parametrize("anneal", [None, 0.5])
def test_divergence_and_its_gradient_equal_the_definition(cost, debias, anneal):
    """In points and in weights, the latter along changes that keep the total: potentials have a free constant."""
    x, y, logits_a, logits_b = leaves((2, 7, 3), (2, 6, 3), (2, 7), (2, 6))
    a, b, eps = logits_a.softmax(1), logits_b.softmax(1), {"sqeuclidean": 8.0, "dot": 2.0, "cosine": 1.0}[cost]
    value = sinkhorn_divergence(x, y, cost=cost, eps=eps, a=a, b=b, debias=debias, anneal=anneal, **CONVERGED)
    expected = torch.stack([literal_divergence(x[s], y[s], cost, eps, a[s], b[s], debias=debias) for s in range(2)])
    assert_near(value, expected, 1e-10)
    upstream, inputs = rand(2, seed=5), [x, y, logits_a, logits_b]
    truths = torch.autograd.grad(expected, inputs, upstream, retain_graph=True)
    for gradient, truth in zip(torch.autograd.grad(value, inputs, upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-7)


def test_entropic_cost_of_pot():
    x, y = rand(1, 8, 3), rand(1, 6, 3, seed=1)
    a, b = weights(8, seed=2).detach(), weights(6, seed=3).detach()
    matrix = cost_matrix(x[0], y[0], "sqeuclidean").numpy()
    solved = ot.solve(matrix, a.numpy(), b.numpy(), reg=1.0, reg_type="KL", max_iter=10_000, tol=1e-13)
    value = sinkhorn_divergence(x, y, eps=1.0, a=a, b=b, debias=False, **CONVERGED)
    assert value.item() == pytest.approx(solved.value, rel=1e-9)


@pytest.mark.parametrize("eps", [0.02, 0.5])
def test_divergence_of_a_shifted_set_is_the_squared_shift(eps):
    x, shift = 0.3 * rand(2, 9, 3), (0.3 * rand(2, 1, 3, seed=1)).requires_grad_()
    value = sinkhorn_divergence(x, x + shift, eps=eps, n_iters=2000, tol=1e-7)
    assert_near(value, shift.square().sum((1, 2)), 1e-6)
    (gradient,) = torch.autograd.grad(value.sum(), shift)
    assert_near(gradient, 2 * shift, 1e-3)


def test_divergence_vanishes_with_its_gradient_for_equal_sets_only():
    x, y = leaves((1, 8, 3), (1, 8, 3))
    order = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    value = sinkhorn_divergence(x, x.detach()[:, order], eps=1.0, **CONVERGED)
    assert value.abs() < 1e-9
    assert torch.autograd.grad(value.sum(), x)[0].abs().amax() < 1e-5
    assert sinkhorn_divergence(x, y, eps=0.1) > 0.1


def test_divergence_of_single_points_and_at_large_eps():
    """|x - y|² for points; for sets the squared distance of their means as eps grows."""
    x, y = rand(1, 1, 3), rand(1, 1, 3, seed=1)
    assert_near(sinkhorn_divergence(x, y), (x - y).square().sum((1, 2)), 1e-12)
    x, y = rand(1, 9, 3), rand(1, 7, 3, seed=1)
    expected = (x.mean(1) - y.mean(1)).square().sum(1)
    assert_near(sinkhorn_divergence(x, y, eps=1e5), expected, 1e-3)


def test_divergence_at_small_eps_is_the_exact_cost():
    x, y = rand(1, 15, 3), rand(1, 15, 3, seed=1)
    matrix = cost_matrix(x[0], y[0], "sqeuclidean").numpy()
    value = sinkhorn_divergence(x, y, eps=0.01, n_iters=500)
    assert value.item() == pytest.approx(ot.emd2([], [], matrix), rel=0.02)


def converged_plan(x: Tensor, y: Tensor, eps: float, n_iters: int) -> Tensor:
    """Of equal weights, by the plain iterations on the logarithm."""
    logits = -torch.cdist(x, y).square() / eps
    f, shape = torch.zeros(len(x), dtype=x.dtype), (math.log(len(x)), math.log(len(y)))
    for _ in range(n_iters):
        g = -torch.logsumexp(logits + f[:, None], 0) - shape[1]
        f = -torch.logsumexp(logits + g, 1) - shape[0]
    plan = (logits + f[:, None] + g).exp()
    assert (len(y) * plan.sum(0) - 1).abs().mean() < 1e-5
    return plan


def test_default_gradient_of_an_elongated_shape_is_converged():
    """Two bodies, whose plain iterations are slow: after 100 of each term the gradient would be 10 % off."""
    x, y = load_humans(1000)(torch.tensor([0, 1]), torch.tensor([0, 7]))[:, None, ::12].unbind()
    near = x.clone().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (gradient,) = torch.autograd.grad(sinkhorn_divergence(near, y).sum(), near)
    x, y = x[0].double(), y[0].double()
    # At the optimum the gradient of a term is that of <T, C> with T held; of the self term both sides move.
    across, within = (converged_plan(x, other, 0.01, 2500) for other in (y, x))
    expected = 2 * (across.sum(1, keepdim=True) * x - across @ y) - 2 * (within.sum(1, keepdim=True) * x - within @ x)
    assert_near(gradient[0].double(), expected, 1e-3)
    with pytest.warns(UserWarning, match="n_iters ended before tol was met"):
        sinkhorn_divergence(near, y[None].float(), n_iters=20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sinkhorn_divergence(near, y[None].float(), n_iters=20, tol=None)


@pytest.mark.parametrize(("eps", "most"), [(0.3, 60), (0.1, 140), (0.05, 200)])
def test_relaxed_iterations_end_soon_and_within_tol_on_clusters(eps, most, monkeypatch):
    """Clusters of unequal weight hardly converge at first; Algorithm 1 takes 75, 139, some 270 iterations to 1e-6."""
    from meshkit.ot import divergence

    plans, solve = [], divergence.solve_features
    monkeypatch.setattr(divergence, "solve_features", lambda *a, **o: plans.append(solve(*a, **o)) or plans[-1])
    torch.manual_seed(1)
    x, y = (0.1 * torch.rand(1, 80, 3, dtype=torch.float64) for _ in range(2))
    x[:, 40:] += 1.0
    y[:, 35:] += 1.0
    for tol in (1e-3, 1e-6):
        plans.clear()
        sinkhorn_divergence(x, y, eps=eps, tol=tol, debias=False)
        assert max(plans[0].n_iters) < most
        assert float(plans[0].read_samples(divergence._violation)) <= tol


@pytest.mark.parametrize("domain", ["auto", "kernel"])
def test_divergence_is_the_same_in_both_domains(domain):
    """With weights, masks, and sets so far apart that the relaxed potentials start far off."""
    x, y, a, b = rand(2, 20, 3), rand(2, 17, 3, seed=1) + 1.0, weights(2, 20), weights(2, 17, seed=1)
    options = {"eps": 1.0, "a": a, "b": b, "n_iters": 3000, "tol": 1e-11}
    expected = sinkhorn_divergence(x, y, anneal=None, domain="log", **options)
    assert_near(sinkhorn_divergence(x, y, domain=domain, **options), expected, 1e-9)


@pytest.mark.parametrize("garbage", GARBAGE)
def test_padded_divergence_equals_the_loop(garbage):
    sizes_x, sizes_y = [5, 8, 1], [9, 4, 3]
    xs = [rand(n, 3, seed=i).requires_grad_() for i, n in enumerate(sizes_x)]
    ys = [rand(n, 3, seed=i + 5) for i, n in enumerate(sizes_y)]
    mask_x, mask_y = scattered_mask(sizes_x, 10), scattered_mask(sizes_y, 12, seed=1)
    x, y = scatter(xs, mask_x, garbage).requires_grad_(), scatter(ys, mask_y, garbage)
    value = sinkhorn_divergence(x, y, eps=2.0, mask_x=mask_x, mask_y=mask_y, **CONVERGED)
    single = torch.cat(
        [sinkhorn_divergence(p[None], q[None], eps=2.0, **CONVERGED) for p, q in zip(xs, ys, strict=True)]
    )
    assert_near(value, single, 1e-9)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert_near(gradient[mask_x], torch.cat(torch.autograd.grad(single.sum(), xs)), 1e-6)
    assert (gradient[~mask_x] == 0).all()


@pytest.mark.parametrize("bad", [math.inf, math.nan, 1e30])
def test_divergence_of_points_that_are_not_finite_ends(bad):
    """1e30 has a square that float32 does not hold. The sample is spoilt, the other is not, and annealing stops."""
    x, y = rand(2, 6, 3, dtype=torch.float32), rand(2, 5, 3, seed=1, dtype=torch.float32)
    clean = sinkhorn_divergence(x, y, eps=0.5)
    x[1, 2, 0] = bad
    value = sinkhorn_divergence(x, y, eps=0.5)
    assert value[0] == pytest.approx(clean[0].item(), rel=1e-3) and not value[1].isfinite()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"eps": 0.0}, "eps must be positive"),
        ({"anneal": 1.0}, "anneal must be between 0 and 1, or None to start at eps, got 1.0"),
        ({"anneal": 1.5, "domain": "kernel"}, "anneal must be between 0 and 1"),
        ({"n_iters": 0}, "n_iters must be an integer of at least 1"),
        ({"cost": "l1"}, "cost must be one of"),
        ({"mask_x": torch.ones(1, 5, dtype=torch.bool)}, "mask_x must have shape"),
        ({"a": torch.ones(4)}, "a and b must have the same sum"),
    ],
)
def test_divergence_errors(options, message):
    with pytest.raises(ValueError, match=message):
        sinkhorn_divergence(rand(1, 4, 3), rand(1, 5, 3), **options)
    with pytest.raises(ValueError, match=r"features must be \(B, N, D\)"):
        sinkhorn_divergence(rand(4, 3), rand(5, 3))


# Dustbin


def superglue(scores: Tensor, bin_score: Tensor, n_iters: int) -> Tensor:
    """SuperGlue's matching layer on one matrix of scores, as the paper and its code describe it."""
    m, n = scores.shape
    couplings = torch.cat([scores, bin_score.expand(m, 1)], 1)
    couplings = torch.cat([couplings, bin_score.expand(1, n + 1)], 0)
    norm = -math.log(m + n)
    log_mu = scores.new_tensor([norm] * m + [math.log(n) + norm])
    log_nu = scores.new_tensor([norm] * n + [math.log(m) + norm])
    u, v = torch.zeros_like(log_mu), torch.zeros_like(log_nu)
    for _ in range(n_iters):
        u = log_mu - torch.logsumexp(couplings + v, 1)
        v = log_nu - torch.logsumexp(couplings + u[:, None], 0)
    return couplings + u[:, None] + v - norm


@pytest.mark.parametrize("n_iters", [1, 5, 50])
@pytest.mark.parametrize("scale", [1.0, 30.0])
@pytest.mark.parametrize(("rows", "columns"), [(6, 4), (3, 7), (1, 1)])
def test_dustbin_equals_superglue(rows, columns, scale, n_iters):
    scores = (scale * rand(2, rows, columns)).requires_grad_()
    bin_score = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    value = log_optimal_transport(scores, bin_score, n_iters=n_iters)
    expected = torch.stack([superglue(s, bin_score, n_iters) for s in scores])
    assert_near(value, expected, 1e-12)
    upstream = rand(2, rows + 1, columns + 1, seed=3)
    truths = torch.autograd.grad(expected, [scores, bin_score], upstream)
    for gradient, truth in zip(torch.autograd.grad(value, [scores, bin_score], upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-10, scale=max(1.0, truth.abs().amax().item()))


def test_dustbin_masses():
    plan = log_optimal_transport(rand(2, 6, 4), 0.3, n_iters=200).exp()
    ones = torch.ones(2, 6, dtype=torch.float64)
    assert_near(plan.sum(2), torch.cat([ones, 4 * ones[:, :1]], 1), 1e-9)
    assert_near(plan.sum(1), torch.cat([ones[:, :4], 6 * ones[:, :1]], 1), 1e-12)


def test_dustbin_gradcheck():
    masks = {"mask_x": torch.tensor([[True, True, False, True]]), "mask_y": torch.tensor([[True, True, False]])}
    bin_score = torch.tensor([0.2], dtype=torch.float64, requires_grad=True)

    def function(scores: Tensor, bin_score: Tensor) -> Tensor:
        return log_optimal_transport(scores, bin_score, n_iters=4, **masks).nan_to_num(neginf=0.0)

    assert gradcheck(function, [*leaves((1, 4, 3)), bin_score])


@pytest.mark.parametrize("garbage", [*GARBAGE, -math.inf])
def test_dustbin_of_padded_scores_equals_the_loop(garbage):
    mask_x, mask_y = scattered_mask([5, 2], 6), scattered_mask([3, 4], 5, seed=1)
    real = mask_x[:, :, None] & mask_y[:, None]
    scores = torch.where(real, rand(2, 6, 5), garbage).requires_grad_()
    value = log_optimal_transport(scores, 0.5, n_iters=7, mask_x=mask_x, mask_y=mask_y)
    upstream, truth = rand(2, 7, 6, seed=3), torch.zeros(2, 6, 5, dtype=torch.float64)
    rows, columns = (torch.cat([m, torch.ones(2, 1, dtype=torch.bool)], 1) for m in (mask_x, mask_y))
    kept = rows[:, :, None] & columns[:, None]
    assert torch.equal(value == -math.inf, ~kept)
    for s in range(2):
        inner = scores[s][mask_x[s]][:, mask_y[s]].detach().requires_grad_()
        expected = superglue(inner, inner.new_tensor(0.5), 7)
        assert_near(value[s][kept[s]].view(expected.shape), expected, 1e-12)
        (gradient,) = torch.autograd.grad(expected, inner, upstream[s][kept[s]].view(expected.shape))
        truth[s][real[s]] = gradient.flatten()
    (gradient,) = torch.autograd.grad(value[kept], scores, upstream[kept])
    assert_near(gradient, truth, 1e-11)


def test_dustbin_takes_what_has_no_match():
    """A far better score beats the bin, a far worse one loses to it."""
    scores = torch.tensor([[[20.0, 0.0], [0.0, -20.0]]])
    assert log_optimal_transport(scores, 5.0).argmax(2)[0, :2].tolist() == [0, 2]
    assert log_optimal_transport(scores.bfloat16(), 5.0).dtype == torch.float32


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((4, 3), {}, r"scores must be \(B, N, M\) .* got \(4, 3\)"),
        ((1, 0, 3), {}, r"scores must be .* got \(1, 0, 3\)"),
        ((1, 4, 3), {"n_iters": 0}, "n_iters must be an integer of at least 1"),
        ((1, 4, 3), {"mask_x": torch.ones(1, 3, dtype=torch.bool)}, "mask_x must have shape"),
        ((1, 4, 3), {"mask_y": torch.ones(1, 4, dtype=torch.bool)}, "mask_y must have shape"),
        ((1, 4, 3), {"mask_x": torch.zeros(1, 4, dtype=torch.bool)}, "at least one real row and one real column"),
        ((1, 4, 3), {"mask_y": torch.zeros(1, 3, dtype=torch.bool)}, "at least one real row and one real column"),
    ],
)
def test_dustbin_errors(shape, options, message):
    with pytest.raises(ValueError, match=message):
        log_optimal_transport(torch.zeros(shape), 1.0, **options)


# Modules


def test_correspondence_passes_its_options_on():
    fx, fy = rand(2, 6, 3), rand(2, 5, 3, seed=1)
    a, b = weights(2, 6, seed=2).detach(), weights(2, 5, seed=3).detach()
    masks = {"mask_x": scattered_mask([6, 4], 6)}
    for options in (
        {"cost": "sqeuclidean", "eps": 0.5, "n_iters": 3, "domain": "log", "store": "stream"},
        {"reach": (0.5, None), "n_iters": 2, "eps": 0.2, "domain": "kernel"},
        {"tol": 1e-3, "n_iters": 100, "eps": 0.3},
        {"eps": [0.5, 0.2], "cost": "dot"},
    ):
        plan, expected = SinkhornCorrespondence(**options)(fx, fy, **masks), sinkhorn(fx, fy, **options, **masks)
        assert isinstance(plan, TransportPlan) and plan.n_iters == expected.n_iters
        assert torch.equal(plan.dense(), expected.dense())
    plan = SinkhornCorrespondence()(fx, fy, a=a, b=b)
    assert_near(plan.dense(), sinkhorn(fx, fy, a=a, b=b).dense(), 1e-14)
    leaf = fx.clone().requires_grad_()
    assert not SinkhornCorrespondence(grad="none")(leaf, fy).dense().requires_grad


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float32])
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
def test_eps_of_low_precision_is_taken_at_its_value(cost, dtype):
    """As in a module cast to half precision: the plan is that of the rounded eps, and of no other."""
    x, y, eps = rand(2, 6, 3), rand(2, 5, 3, seed=1), torch.tensor(0.3).to(dtype)
    kinds = [sinkhorn(x, y, cost=cost, eps=e) for e in (eps, float(eps))]
    kinds += [sinkhorn_from_cost(torch.cdist(x, y), eps=e) for e in (eps, float(eps))]
    for given, plain in (kinds[:2], kinds[2:]):
        assert_near(given.log_dense(), plain.log_dense(), 1e-12)
        assert_near(given.cost(), plain.cost(), 1e-12)


def test_learned_eps():
    """eps = min_eps + exp(p) starts where it is told, and learns by the chain rule."""
    fx, fy = rand(1, 6, 3), rand(1, 5, 3, seed=1)
    match = SinkhornCorrespondence(eps=0.3, learn_eps=True, min_eps=0.1).double()
    assert match.eps.item() == pytest.approx(0.3)
    assert [name for name, _ in match.named_parameters()] == ["log_eps"]
    eps = (0.1 + match.log_eps.exp()).requires_grad_()
    upstream = rand(1, 6, 5, seed=2)
    expected = literal_batch([cost_matrix(fx[0], fy[0])], eps, 5)
    (truth,) = torch.autograd.grad(expected, match.log_eps, upstream)
    (match(fx, fy).dense() * upstream).sum().backward()
    assert_near(match.log_eps.grad, truth, 1e-11)
    again = SinkhornCorrespondence(eps=0.5, learn_eps=True, min_eps=0.1).double()
    again.load_state_dict(match.state_dict())
    assert again.eps.item() == match.eps.item()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"eps": -1.0}, "eps must be positive"),
        ({"cost": "l1"}, "cost must be one of"),
        ({"grad": "exact"}, "grad must be one of"),
        ({"learn_eps": True, "eps": [0.5, 0.1]}, "learn_eps needs one number eps > min_eps > 0 and no reach"),
        ({"learn_eps": True, "reach": 1.0}, "learn_eps needs one number"),
        ({"learn_eps": True, "eps": 1e-4}, r"learn_eps needs .* got eps 0\.0001, min_eps 0\.001"),
        ({"learn_eps": True, "min_eps": 0.0}, "learn_eps needs"),
    ],
)
def test_correspondence_errors(options, message):
    with pytest.raises(ValueError, match=message):
        SinkhornCorrespondence(**options)


@pytest.mark.parametrize("normalize", [True, False])
def test_warp_module(normalize):
    fx, fy, values = leaves((2, 6, 3), (2, 5, 3), (2, 5, 2))
    masks = {"mask_x": scattered_mask([6, 4], 6), "mask_y": scattered_mask([3, 5], 5)}
    warped, plan = CorrespondenceWarp(SinkhornCorrespondence(eps=0.2), normalize=normalize)(fx, fy, values, **masks)
    dense = sinkhorn(fx, fy, eps=0.2, **masks).dense()
    expected = dense @ values
    if normalize:
        expected = expected / dense.sum(2, keepdim=True).where(masks["mask_x"][..., None], 1.0)
    assert_near(warped, expected, 1e-12)
    assert_near(plan.dense(), dense, 1e-14)
    assert CorrespondenceWarp().correspondence.eps == 0.03
    assert "cosine" in repr(CorrespondenceWarp())


def test_schedule_of_the_divergence_fits_its_iterations():
    """Fewer iterations than annealing steps: the last ones are made, at eps itself last."""
    x, y = rand(1, 6, 3), rand(1, 5, 3, seed=1)
    assert len(eps_schedule(100.0, 0.01)) > 3
    short = sinkhorn_divergence(x, y, eps=0.01, n_iters=3)
    assert short.isfinite().all() and abs(short - sinkhorn_divergence(x, y, eps=0.01, n_iters=500)) < 0.5 * short.abs()


def test_divergence_of_a_sample_without_points_is_zero():
    x, y = rand(2, 6, 3).requires_grad_(), rand(2, 5, 3, seed=1)
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[1] = False
    value = sinkhorn_divergence(x, y, mask_x=mask)
    assert value[0] > 0 and value[1] == 0
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert gradient[0].abs().sum() > 0 and not gradient[1].any()


def test_divergence_needs_a_number_for_eps():
    with pytest.raises(ValueError, match="eps must be a number, got list"):
        sinkhorn_divergence(rand(1, 4, 3), rand(1, 5, 3), eps=[0.1, 0.01])
