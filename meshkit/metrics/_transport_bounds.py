"""Bounds of the cost of optimal transport between point sets, from Sinkhorn potentials, in O(N + M) memory.

Any potentials give a lower bound: with f_i = min_j (C_ij - g_j) and g_j = min_i (C_ij - f_i), weak duality says
mean(f) + mean(g) <= OT. The entropic plan gives an upper one: scaled down to columns that are not too heavy, and
completed by an outer product, it has the right marginals, and no plan is cheaper than the best (Altschuler, Weed and
Rigollet 2017, Algorithm 2).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from meshkit.ot.kernel import GibbsKernel
from meshkit.ot.marginals import Sides
from meshkit.ot.options import read_options
from meshkit.ot.sinkhorn import eps_schedule, solve
from meshkit.ot.tiles import LOG2_E, Tiles

_SHARE = 0.003  # default eps over the mean cost
_SMALLEST = 1e-30  # eps of sets that coincide in one point


class DistanceTiles(Tiles):
    """Logits ``-C / eps`` for the cost C of the distance, or squared distance, between two sets of points.

    ``eps`` is a share of the mean cost by default.
    """

    def __init__(self, x: Tensor, y: Tensor, squared: bool, eps: float | None) -> None:
        self.x, self.y, self.squared = x, y, squared
        super().__init__((len(x), len(y)), x, "none")
        self.eps = max(_SHARE * self._mean(), _SMALLEST) if eps is None else eps

    def cost(self, rows: slice) -> Tensor:
        """A block of C, ``(R, M)``."""
        # Not by |x|² - 2xy + |y|²: a bound must not suffer from cancellation.
        block = torch.cdist(self.x[rows], self.y, compute_mode="donot_use_mm_for_euclid_dist")
        return block.square_() if self.squared else block

    def costs(self) -> Iterator[tuple[slice, Tensor]]:
        """All blocks of C with their rows."""
        for rows in self.blocks:
            yield rows, self.cost(rows)

    def _mean(self) -> float:
        return sum(float(cost.sum(dtype=torch.float64)) for _, cost in self.costs()) / (len(self.x) * len(self.y))

    def logits(self, rows: slice) -> Tensor:
        """A fresh block ``(R, M)``."""
        return self.cost(rows).mul_(-LOG2_E / self.eps)

    def transposed(self) -> Tiles:
        """Rows and columns exchanged."""
        return DistanceTiles(self.y, self.x, self.squared, self.eps)

    def pullback(self, factors: object) -> tuple[Tensor, ...]:
        """No gradient passes: potentials are constants in both bounds."""
        raise NotImplementedError


def potentials(
    tiles: DistanceTiles, mu: Tensor, nu: Tensor, *, n_iters: int, tol: float | None
) -> tuple[Tensor, Tensor]:
    """Sinkhorn potentials ``f (N,)`` and ``g (M,)`` for positive weights of sum 1; eps is halved down from the cost."""
    largest = max(float(block.amax()) for _, block in tiles.costs())
    schedule = eps_schedule(max(tiles.eps, largest), tiles.eps)
    options = read_options(schedule, max(n_iters, len(schedule)), tol, None, "none", "log", "stream")
    sides = Sides(mu, nu, None, None, math.inf)
    return solve(GibbsKernel(tiles, tiles.x, tiles.y), sides, options, "log", 0.0).potentials()


def uniform(points: Tensor) -> Tensor:
    """Equal weights of sum 1."""
    return points.new_full((len(points),), 1 / len(points))


def softmin(tiles: DistanceTiles, g: Tensor) -> Tensor:
    """``-eps log sum_j exp((g_j - C_ij) / eps)`` for each row: potentials ``f``, up to a constant, of any points."""
    return -tiles.eps / LOG2_E * tiles.log_sum_rows(g * (LOG2_E / tiles.eps))


def conjugates(tiles: DistanceTiles, g: Tensor) -> tuple[Tensor, Tensor]:
    """The best potentials below the cost, ``f_i + g_j <= C_ij``, that start from ``g``."""
    best_f, best_g = g.new_empty(tiles.shape[0]), torch.full_like(g, torch.inf)
    for rows, cost in tiles.costs():
        best_f[rows] = (cost - g).amin(1)
        torch.minimum(best_g, cost.sub_(best_f[rows, None]).amin(0), out=best_g)
    return best_f, best_g


def rounded_cost(
    tiles: DistanceTiles, f: Tensor, g: Tensor, mu: Tensor, nu: Tensor, *, levels: int, n_iters: int
) -> Tensor:
    """Cost of the plan ``exp((f + g - C) / eps)`` rounded to the marginals ``mu (N,)`` and ``nu (M,)``.

    What the columns lack is moved by a plan of its own at a larger eps, rounded likewise; only on the last level by an
    outer product, which goes everywhere and is dear.
    """
    sums = torch.zeros_like(nu)
    for rows, cost in tiles.costs():
        sums += _plan(tiles, cost, f[rows], g, mu[rows]).sum(0)
    shrink = (nu / sums).nan_to_num(1.0, 1.0, 1.0).clamp_max(1)
    missing_columns = (nu - shrink * sums).clamp_min(0)
    total, missing_rows, completion = g.new_zeros(()), torch.empty_like(f), torch.empty_like(f)
    for rows, cost in tiles.costs():
        plan = _plan(tiles, cost, f[rows], g, mu[rows]).mul_(shrink)
        missing_rows[rows] = (mu[rows] - plan.sum(1)).clamp_min(0)
        completion[rows] = torch.mv(cost, missing_columns)
        total += plan.mul_(cost).sum()
    missing_rows *= missing_columns.sum() / missing_rows.sum().clamp_min(torch.finfo(mu.dtype).tiny)
    missing, some_rows, some_columns = missing_columns.sum(), missing_rows > 0, missing_columns > 0
    if not bool(missing > 1e-6):
        return total + missing_rows @ completion
    if levels == 0:
        return total + missing_rows @ completion / missing
    rest = DistanceTiles(tiles.x[some_rows], tiles.y[some_columns], tiles.squared, 4 * tiles.eps)
    mu, nu = missing_rows[some_rows] / missing, missing_columns[some_columns] / missing
    f, g = potentials(rest, mu, nu, n_iters=n_iters, tol=1e-3)
    return total + missing * rounded_cost(rest, f, g, mu, nu, levels=levels - 1, n_iters=n_iters)


def _plan(tiles: DistanceTiles, cost: Tensor, f: Tensor, g: Tensor, mu: Tensor) -> Tensor:
    """Rows of the plan, scaled down where they are too heavy."""
    plan = torch.sub(f[:, None] + g, cost).mul_(LOG2_E / tiles.eps).exp2_()
    return plan.mul_((mu / plan.sum(1)).clamp_max(1)[:, None])
