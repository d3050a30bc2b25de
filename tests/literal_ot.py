"""Sinkhorn's iterations as the paper writes them, on stored matrices under autograd."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from conftest import assert_near, rand
from torch import Tensor

from meshkit.ot import TransportPlan, stacked
from meshkit.ot.tiles import Tiles

DOMAINS = ["kernel", "log"]
domains = pytest.mark.parametrize("domain", DOMAINS)
costs = pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])


@pytest.fixture(autouse=True)
def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small samples go through the loop as large ones do; those solved together are compared with it elsewhere."""
    monkeypatch.setattr(stacked, "SMALL", 0)


def leaves(*shapes: tuple[int, ...], seed: int = 0) -> list[Tensor]:
    return [rand(*shape, seed=seed + i).requires_grad_() for i, shape in enumerate(shapes)]


def weights(*shape: int, seed: int = 0) -> Tensor:
    """Positive weights with sum 1 in the last dimension."""
    return rand(*shape, seed=seed).softmax(-1).requires_grad_()


def set_rows(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    """Blocks of ``rows`` rows."""
    create = Tiles.__init__

    def init(self: Tiles, shape: tuple[int, int], like: Tensor, store: str) -> None:
        create(self, shape, like, store)
        self.blocks = [slice(start, min(start + rows, shape[0])) for start in range(0, shape[0], rows)]

    monkeypatch.setattr(Tiles, "__init__", init)


def cost_matrix(x: Tensor, y: Tensor, cost: str = "cosine") -> Tensor:
    if cost == "dot":
        return -x @ y.T
    if cost == "sqeuclidean":
        return (x[:, None] - y).square().sum(2)
    return 1 - (x @ y.T) / (x.norm(dim=1)[:, None] * y.norm(dim=1))


def algorithm_1(
    cost: Tensor,
    eps: float | Tensor | Sequence[float],
    n_iters: int,
    mu: Tensor | None = None,
    nu: Tensor | None = None,
    *,
    powers: tuple[float, float] = (1.0, 1.0),
    last_step: bool = False,
) -> Tensor:
    """The paper's Algorithm 1, with marginals, powers (Chizat et al. 2018), and a new kernel wherever eps changes.

    ``last_step`` detaches the row scaling that enters the last iteration.
    """
    schedule = [*eps] if isinstance(eps, Sequence) else [eps]
    schedule += schedule[-1:] * (n_iters - len(schedule))
    mu = cost.new_ones(len(cost)) / len(cost) if mu is None else mu
    nu = cost.new_ones(cost.shape[1]) / cost.shape[1] if nu is None else nu
    a = mu
    for t, step_eps in enumerate(schedule):
        u = torch.exp(-cost / step_eps)
        if t:
            f = schedule[t - 1] * (a / mu).log()
            a = mu * (f / step_eps).exp()
            if last_step and t == n_iters - 1:
                a = a.detach()
        b = (nu / (u.T @ a)) ** powers[1]
        a = (mu / (u @ b)) ** powers[0]
    return torch.diag(a) @ u @ torch.diag(b)


def literal_batch(
    matrices: Sequence[Tensor],
    eps: float | Tensor | Sequence[float],
    n_iters: int,
    *,
    a: Tensor | None = None,
    b: Tensor | None = None,
    **options: object,
) -> Tensor:
    """:func:`algorithm_1` sample by sample, on the rows and columns of positive weight; zeros elsewhere."""
    plans = []
    for s, matrix in enumerate(matrices):
        mu, nu = None if a is None else a[s], None if b is None else b[s]
        rows = torch.arange(len(matrix)) if mu is None else (mu > 0).nonzero()[:, 0]
        columns = torch.arange(matrix.shape[1]) if nu is None else (nu > 0).nonzero()[:, 0]
        plan = algorithm_1(
            matrix[rows][:, columns],
            eps,
            n_iters,
            None if mu is None else mu[rows],
            None if nu is None else nu[columns],
            **options,  # type: ignore[arg-type]
        )
        wide = plan.new_zeros(len(rows), matrix.shape[1]).index_copy(1, columns, plan)
        plans.append(torch.zeros_like(matrix).index_copy(0, rows, wide))
    return torch.stack(plans)


# Each reading of a plan, and the same of the stored matrix T with cost C: values v (M, C) on columns, u (N, C) on rows.
Reading = tuple[Callable[[TransportPlan, Tensor, Tensor], Tensor], Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]]


def normalised(product: Tensor, mass: Tensor) -> Tensor:
    return torch.where(mass[..., None] > 0, product / torch.where(mass > 0, mass, 1.0)[..., None], 0.0)


READINGS: dict[str, Reading] = {
    "matmul": (lambda p, v, u: p @ v, lambda t, c, v, u: t @ v),
    "T-matmul": (lambda p, v, u: p.T @ u, lambda t, c, v, u: t.mT @ u),
    "barycentric": (lambda p, v, u: p.barycentric(v), lambda t, c, v, u: normalised(t @ v, t.sum(2))),
    "T-barycentric": (lambda p, v, u: p.T.barycentric(u), lambda t, c, v, u: normalised(t.mT @ u, t.sum(1))),
    "row_sums": (lambda p, v, u: p.row_sums(), lambda t, c, v, u: t.sum(2)),
    "column_sums": (lambda p, v, u: p.marginals()[1], lambda t, c, v, u: t.sum(1)),
    "T-marginals": (lambda p, v, u: p.T.marginals()[0], lambda t, c, v, u: t.sum(1)),
    "cost": (lambda p, v, u: p.cost(), lambda t, c, v, u: (t * c).sum((1, 2))),
    "entropy": (
        lambda p, v, u: p.entropy(),
        lambda t, c, v, u: -(t * torch.where(t > 0, t, 1.0).log()).sum((1, 2)),
    ),
    "dense": (lambda p, v, u: p.dense(), lambda t, c, v, u: t),
    "T-dense": (lambda p, v, u: p.T.dense(), lambda t, c, v, u: t.mT),
}
readings = pytest.mark.parametrize("reading", READINGS)


def compare(
    plan: TransportPlan,
    truth: Tensor,
    matrices: Tensor,
    v: Tensor,
    u: Tensor,
    inputs: Sequence[Tensor],
    *,
    tol: float = 1e-12,
    grad_tol: float = 1e-11,
) -> None:
    """Values of all readings of a plan, and the gradient of one loss made of all of them."""
    loss, expected_loss = torch.zeros(()), torch.zeros(())
    for seed, (read, literal) in enumerate(READINGS.values()):
        value, expected = read(plan, v, u), literal(truth, matrices, v, u)
        assert_near(value, expected, tol)
        upstream = rand(*expected.shape, seed=50 + seed) / expected.detach().abs().amax()
        loss, expected_loss = loss + (value * upstream).sum(), expected_loss + (expected * upstream).sum()
    gradients = torch.autograd.grad(loss, inputs)
    truths = torch.autograd.grad(expected_loss, inputs)
    for gradient, expected in zip(gradients, truths, strict=True):
        assert_near(gradient, expected, grad_tol)
