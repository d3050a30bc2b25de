"""Sinkhorn against other libraries, closed forms, fifty-digit arithmetic, and the properties of transport plans."""

import math
from decimal import Decimal, localcontext

import numpy as np
import ot
import pytest
import torch
from conftest import assert_near, rand, scattered_mask
from literal_ot import cost_matrix, domains, leaves, one_by_one, weights  # noqa: F401
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from meshkit.ot import eps_schedule, sinkhorn, sinkhorn_from_cost

# POT


def problem(num_x: int = 12, num_y: int = 9) -> tuple[Tensor, Tensor, Tensor, Tensor, np.ndarray]:
    fx, fy = rand(1, num_x, 4), rand(1, num_y, 4, seed=1)
    a, b = weights(num_x, seed=2).detach(), weights(num_y, seed=3).detach()
    return fx, fy, a, b, cost_matrix(fx[0], fy[0]).numpy()


@domains
@pytest.mark.parametrize("method", ["sinkhorn", "sinkhorn_log"])
@pytest.mark.parametrize("n_iters", [1, 5, 40])
def test_pot_after_as_many_iterations(method, n_iters, domain):
    """POT starts from ones unless told otherwise; the paper, and we, from the row weights."""
    fx, fy, a, b, cost = problem()
    start = (a.log().numpy(), np.zeros(9))
    expected = ot.sinkhorn(
        a.numpy(), b.numpy(), cost, 0.1, method, numItermax=n_iters, stopThr=0, warn=False, warmstart=start
    )
    plan = sinkhorn(fx, fy, eps=0.1, n_iters=n_iters, a=a, b=b, domain=domain)
    assert_near(plan.dense()[0], torch.from_numpy(expected), 1e-12)


@pytest.mark.parametrize("method", ["sinkhorn", "sinkhorn_log"])
def test_pot_uniform_weights_from_its_own_start(method):
    fx, fy, _, _, cost = problem()
    expected = ot.sinkhorn([], [], cost, 0.03, method, numItermax=5, stopThr=0, warn=False)
    assert_near(sinkhorn(fx, fy).dense()[0], torch.from_numpy(expected), 1e-12)


@domains
@pytest.mark.filterwarnings("ignore:If reg_type")
@pytest.mark.parametrize("reach", [(0.5, 0.5), (0.3, 2.0), (0.3, None)])
@pytest.mark.parametrize("n_iters", [1, 5, 40])
def test_pot_unbalanced_after_as_many_iterations(reach, n_iters, domain):
    """POT updates its first marginal first, so it is given the transposed problem."""
    fx, fy, a, b, cost = problem()
    b = 1.7 * b
    penalties = tuple(math.inf if side is None else side for side in reversed(reach))
    expected = ot.unbalanced.sinkhorn_unbalanced(
        b.numpy(),
        a.numpy(),
        cost.T,
        0.2,
        penalties,
        reg_type="entropy",
        numItermax=n_iters,
        stopThr=0,
        warmstart=(np.zeros(9), a.log().numpy()),
    )
    plan = sinkhorn(fx, fy, eps=0.2, n_iters=n_iters, a=a, b=b, reach=reach, domain=domain)
    assert_near(plan.dense()[0], torch.from_numpy(expected.T), 1e-12)


@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
def test_small_eps_reaches_the_exact_transport_cost(cost):
    """The entropic plan costs at most eps log(N M) more than the exact one, and nearly all its mass is there."""
    fx, fy, a, b, _ = problem(25, 20)
    matrix = cost_matrix(fx[0], fy[0], cost).numpy()
    unit, best = float(matrix.std()), ot.emd(a.numpy(), b.numpy(), matrix)
    excess = []
    for eps in (0.3 * unit, 0.05 * unit, 0.01 * unit):
        plan = sinkhorn(fx, fy, cost=cost, eps=eps_schedule(unit, eps), n_iters=1500, tol=1e-6, a=a, b=b)
        excess.append(plan.cost().item() - (best * matrix).sum())
        slack = plan.residual.item() * abs(matrix).max()
        assert slack < 0.01 * unit and -slack < excess[-1] < eps * math.log(25 * 20) + slack
    assert excess[2] < excess[1] < excess[0]
    assert (plan.dense()[0] - torch.from_numpy(best)).abs().sum() < 0.2


def test_small_eps_recovers_the_exact_assignment():
    """At eps -> 0 the plan is the optimal permutation, which nearest neighbours alone would miss."""
    fx, fy = rand(3, 20, 3, seed=3), rand(3, 20, 3, seed=4)
    plan = sinkhorn(fx, fy, eps=2e-3, n_iters=1000)
    cost = 1 - torch.cosine_similarity(fx[:, :, None], fy[:, None], dim=-1)
    for b in range(3):
        best = torch.from_numpy(linear_sum_assignment(cost[b].numpy())[1])
        assert not torch.equal(cost[b].argmin(1), best)
        assert torch.equal(plan.argmax()[b], best)
        assert torch.equal(plan.argmax(1)[b], best.argsort())
        assert torch.equal(plan.assign()[b], best)
    assert plan.mutual()[1].all()


# Fifty digits

COST = [[0.0, 0.3, 0.7], [0.5, 0.1, 0.9], [0.2, 0.8, 0.4]]


def exact_plan(cost: list[list[Decimal]], eps: Decimal, n_iters: int) -> list[list[Decimal]]:
    """Algorithm 1 on three points, in decimals of the context's precision."""
    three = range(3)
    u = [[(-c / eps).exp() for c in row] for row in cost]
    third = 1 / Decimal(3)
    a = [third] * 3
    for _ in range(n_iters):
        b = [third / sum(u[i][j] * a[i] for i in three) for j in three]
        a = [third / sum(u[i][j] * b[j] for j in three) for i in three]
    return [[a[i] * u[i][j] * b[j] for j in three] for i in three]


@domains
@pytest.mark.parametrize(("eps", "tol"), [(0.25, 1e-14), (0.01, 1e-12), (0.001, 1e-11)])
def test_three_points_in_fifty_digits(eps, tol, domain):
    """Entries from 1 to 10^-400, the logarithm of each, and the gradient by differences of 10^-20."""
    cost = torch.tensor(COST, dtype=torch.float64)[None].requires_grad_()
    plan = sinkhorn_from_cost(cost, eps=eps, n_iters=4, domain=domain)
    upstream = rand(3, 3, seed=1)
    with localcontext() as context:
        context.prec = 50
        exact = [[Decimal(c) for c in row] for row in COST]
        entries = exact_plan(exact, Decimal(eps), 4)
        logarithms = torch.tensor([[float(t.ln()) for t in row] for row in entries], dtype=torch.float64)[None]
        expected = torch.tensor([[float(t) for t in row] for row in entries], dtype=torch.float64)[None]

        def loss(matrix: list[list[Decimal]]) -> Decimal:
            result = exact_plan(matrix, Decimal(eps), 4)
            return sum(result[i][j] * Decimal(upstream[i, j].item()) for i in range(3) for j in range(3))

        step, gradient = Decimal("1e-20"), torch.zeros_like(expected)
        for i in range(3):
            for j in range(3):
                ahead, behind = ([row.copy() for row in exact] for _ in range(2))
                ahead[i][j] += step
                behind[i][j] -= step
                gradient[0, i, j] = float((loss(ahead) - loss(behind)) / (2 * step))
    assert_near(plan.dense(), expected, tol)
    assert_near(plan.log_dense(), logarithms, 1e-14)
    (got,) = torch.autograd.grad((plan.dense() * upstream).sum(), cost)
    assert_near(got, gradient, 100 * tol, scale=max(gradient.abs().amax().item(), 1.0))


# Closed forms


@domains
@pytest.mark.parametrize("eps", [0.03, 1.0])
@pytest.mark.parametrize("num", [2, 5])
def test_orthogonal_features(num, eps, domain):
    """K is 1 on the diagonal and k = exp(-1/eps) elsewhere: one scaling makes it doubly stochastic."""
    features = torch.eye(num, dtype=torch.float64)[None] * 3
    k = math.exp(-1 / eps)
    diagonal, other = (v / (num * (1 + (num - 1) * k)) for v in (1, k))
    expected = torch.eye(num, dtype=torch.float64) * (diagonal - other) + other
    for n_iters in (1, 4):
        plan = sinkhorn(features, features, eps=eps, n_iters=n_iters, domain=domain)
        assert_near(plan.dense()[0], expected, 1e-13)
        assert_near(plan.cost()[0], torch.tensor(num * (num - 1) * other, dtype=torch.float64), 1e-13, scale=1.0)
        entropy = -num * diagonal * math.log(diagonal) - num * (num - 1) * other * math.log(other)
        assert_near(plan.entropy()[0], torch.tensor(entropy, dtype=torch.float64), 1e-13)
        assert plan.residual.abs().amax() < 1e-13


@domains
def test_two_points_in_closed_form(domain):
    """The odds ratio of a plan is that of its kernel; with the marginals this is a quadratic equation."""
    cost = torch.tensor([[0.1, 0.9], [0.6, 0.2]], dtype=torch.float64)
    p, q, eps = 0.3, 0.6, 0.4
    ratio = math.exp(-(cost[0, 0] + cost[1, 1] - cost[0, 1] - cost[1, 0]).item() / eps)
    # t (1 - p - q + t) = ratio (p - t) (q - t)
    quadratic, linear, constant = 1 - ratio, 1 - p - q + ratio * (p + q), -ratio * p * q
    t = (-linear + math.sqrt(linear**2 - 4 * quadratic * constant)) / (2 * quadratic)
    expected = torch.tensor([[t, p - t], [q - t, 1 - p - q + t]], dtype=torch.float64)
    assert (expected > 0).all()
    a, b = torch.tensor([p, 1 - p], dtype=torch.float64), torch.tensor([q, 1 - q], dtype=torch.float64)
    plan = sinkhorn_from_cost(cost[None], eps=eps, n_iters=300, a=a, b=b, domain=domain)
    assert_near(plan.dense()[0], expected, 1e-13)


@domains
def test_permuted_features_give_the_permutation(domain):
    features = torch.eye(8, dtype=torch.float64)[None]
    order = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    plan = sinkhorn(features, features[:, order], domain=domain)
    expected = torch.zeros(8, 8, dtype=torch.float64)
    expected[order, torch.arange(8)] = 1 / 8
    assert_near(plan.dense()[0], expected, 1e-13)
    assert torch.equal(plan.argmax()[0], order.argsort()) and torch.equal(plan.assign()[0], order.argsort())
    index, mutual = plan.mutual()
    assert torch.equal(index[0], order.argsort()) and mutual.all()


@domains
@pytest.mark.parametrize("n_iters", [1, 3])
def test_a_single_atom_spreads_over_its_targets(n_iters, domain):
    """With one row the plan is the other marginal, whatever the cost."""
    fx, fy, b = rand(1, 1, 3), rand(1, 6, 3, seed=1), weights(6, seed=2).detach()
    plan = sinkhorn(fx, fy, b=b, n_iters=n_iters, domain=domain)
    assert_near(plan.dense()[0, 0], b, 1e-13)
    assert_near(plan.cost()[0], (b * cost_matrix(fx[0], fy[0])[0]).sum(), 1e-13)
    assert_near(plan.entropy()[0], -(b * b.log()).sum(), 1e-13)
    values = rand(1, 6, 2, seed=3)
    assert_near(plan.barycentric(values)[0, 0], b @ values[0], 1e-13)


@domains
def test_single_pair_unbalanced(domain):
    """One row and one column: the mass m minimises m C + eps m log m - eps m + rho-weighted Kullback-Leibler terms."""
    eps, rho, p, q = 0.4, 0.7, 1.3, 0.6
    cost = torch.tensor([[[0.9]]], dtype=torch.float64)
    a, b = torch.tensor([p], dtype=torch.float64), torch.tensor([q], dtype=torch.float64)
    plan = sinkhorn_from_cost(cost, eps=eps, n_iters=200, a=a, b=b, reach=rho, domain=domain)
    # Derivative: C + eps log m + rho log(m / p) + rho log(m / q) = 0.
    mass = math.exp((rho * math.log(p * q) - 0.9) / (eps + 2 * rho))
    assert_near(plan.dense(), torch.full((1, 1, 1), mass, dtype=torch.float64), 1e-13)


# Properties


@domains
@pytest.mark.parametrize("eps", [0.03, 0.2])
def test_row_marginals_are_exact_and_columns_converge(eps, domain):
    fx, fy = rand(2, 15, 4), rand(2, 11, 4, seed=1)
    residuals = []
    for n_iters in (1, 2, 3, 5, 10, 30, 300):
        plan = sinkhorn(fx, fy, eps=eps, n_iters=n_iters, domain=domain)
        rows, columns = plan.marginals()
        assert_near(rows, torch.full_like(rows, 1 / 15), 1e-13)
        residuals.append((columns - 1 / 11).abs().sum(1))
        assert_near(plan.residual, residuals[-1], 1e-10, scale=1.0)
    steps = torch.stack(residuals)
    assert (steps[1:] < steps[:-1]).all()
    assert (steps[5] < steps[0] / 10).all() and steps[-1].amax() < 1e-10


@domains
def test_permutation_equivariance(domain):
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)
    generator = torch.Generator().manual_seed(0)
    p, q = torch.randperm(9, generator=generator), torch.randperm(7, generator=generator)
    plan = sinkhorn(fx, fy, domain=domain).dense()
    assert_near(sinkhorn(fx[:, p], fy[:, q], domain=domain).dense(), plan[:, p][:, :, q], 1e-13)


@domains
def test_swapping_the_sets_transposes_the_converged_plan(domain):
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)
    forth, back = (sinkhorn(x, y, eps=0.2, n_iters=300, domain=domain) for x, y in ((fx, fy), (fy, fx)))
    assert_near(forth.dense(), back.T.dense(), 1e-11)
    # After one iteration the last update was that of the rows, so the two differ.
    forth, back = (sinkhorn(x, y, eps=0.2, n_iters=1, domain=domain) for x, y in ((fx, fy), (fy, fx)))
    assert (forth.dense() - back.T.dense()).abs().amax() > 1e-4


@domains
@pytest.mark.parametrize("shift", [5.0, -3.0])
def test_a_constant_added_to_the_cost_moves_the_cost_alone(shift, domain):
    (cost,) = leaves((2, 9, 7))
    plan, moved = (sinkhorn_from_cost(c, eps=0.3, domain=domain) for c in (cost, cost + shift))
    assert_near(moved.dense(), plan.dense(), 1e-13)
    assert_near(moved.cost(), plan.cost() + shift, 1e-13)
    assert_near(moved.entropy(), plan.entropy(), 1e-13)
    upstream = rand(2, 9, 7, seed=1)
    gradients = [torch.autograd.grad((p.dense() * upstream).sum() + p.cost().sum(), cost)[0] for p in (plan, moved)]
    assert_near(gradients[1], gradients[0], 1e-11)


@domains
def test_adding_to_rows_and_columns_of_the_cost_changes_no_plan(domain):
    """It is taken up by the potentials once converged."""
    cost, f, g = rand(1, 9, 7), rand(1, 9, 1, seed=1), rand(1, 1, 7, seed=2)
    plan, moved = (sinkhorn_from_cost(c, eps=0.5, n_iters=300, domain=domain) for c in (cost, cost + f + g))
    assert_near(moved.dense(), plan.dense(), 1e-10)


@domains
def test_cost_and_eps_scale_together(domain):
    cost = rand(1, 9, 7)
    plan, scaled = (sinkhorn_from_cost(s * cost, eps=s * 0.3, domain=domain) for s in (1.0, 7.0))
    assert_near(scaled.dense(), plan.dense(), 1e-13)
    assert_near(scaled.cost(), 7 * plan.cost(), 1e-12)


@domains
def test_features_and_their_cost_matrix_agree(domain):
    fx, fy = rand(2, 9, 4), rand(2, 7, 4, seed=1)
    masks = {"mask_x": scattered_mask([9, 6], 9), "mask_y": scattered_mask([5, 7], 7)}
    for cost in ("cosine", "sqeuclidean", "dot"):
        for reach in (None, 0.5):
            options = {"eps": 0.5, "n_iters": 4, "reach": reach, "domain": domain, **masks}
            matrices = torch.stack([cost_matrix(x, y, cost) for x, y in zip(fx, fy, strict=True)])
            one, other = sinkhorn(fx, fy, cost=cost, **options), sinkhorn_from_cost(matrices, **options)
            assert_near(one.dense(), other.dense(), 1e-12)
            assert_near(one.cost(), other.cost(), 1e-12)


@domains
def test_the_converged_plan_is_optimal(domain):
    """No other plan with the same marginals has a lower regularised cost; the dual has the same value."""
    fx, fy, a, b, matrix = problem(7, 6)
    eps = 0.2
    plan = sinkhorn(fx, fy, eps=eps, n_iters=500, a=a, b=b, domain=domain)
    primal = (plan.cost() - eps * plan.entropy()).item()
    f, g = plan.potentials
    assert primal == pytest.approx((f[0] @ a + g[0] @ b).item(), abs=1e-12)
    cost, dense = torch.from_numpy(matrix), plan.dense()[0]
    for seed in range(5):
        change = rand(7, 6, seed=seed)
        change = change - change.mean(0) - change.mean(1, keepdim=True) + change.mean()
        other = dense + 0.3 * dense.amin() / change.abs().amax() * change
        assert (cost * other).sum() + eps * (other * other.log()).sum() > primal
