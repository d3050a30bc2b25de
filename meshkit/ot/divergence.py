"""Sinkhorn divergence between weighted point sets."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from meshkit.batching import check_mask
from meshkit.ot.costs import logit_features
from meshkit.ot.options import Cost, Domain, Store
from meshkit.ot.sample import SamplePlan
from meshkit.ot.sinkhorn import check_features, eps_schedule, sinkhorn

__all__ = ["sinkhorn_divergence"]


def sinkhorn_divergence(
    x: Tensor,
    y: Tensor,
    *,
    cost: Cost = "sqeuclidean",
    eps: float = 0.01,
    n_iters: int = 100,
    tol: float | None = 1e-4,
    anneal: float | None = 0.5,
    a: Tensor | None = None,
    b: Tensor | None = None,
    mask_x: Tensor | None = None,
    mask_y: Tensor | None = None,
    debias: bool = True,
    domain: Domain = "auto",
    store: Store = "auto",
) -> Tensor:
    r"""Entropic transport cost between two point sets, made zero for equal sets.

    .. math::
        \mathrm{OT}_\varepsilon(\mu, \nu) = \min_T \langle T, C \rangle + \varepsilon\, \mathrm{KL}(T \,|\,
        \mu \otimes \nu), \qquad
        S = \mathrm{OT}_\varepsilon(\mu, \nu) - \tfrac12 \mathrm{OT}_\varepsilon(\mu, \mu)
        - \tfrac12 \mathrm{OT}_\varepsilon(\nu, \nu)

    Values are those of the dual at the potentials reached, :math:`\langle \mu, f \rangle + \langle \nu, g \rangle -
    \varepsilon (\sum T - 1)`, whose gradient holds the potentials constant: both errors are of second order in what
    is missing to convergence. Between the exact transport cost (eps to 0) and an energy distance (eps to infinity).

    Args:
        x: ``(B, N, D)`` points.
        y: ``(B, M, D)`` points.
        cost: ``"sqeuclidean"``, ``"cosine"`` or ``"dot"``, see :func:`~meshkit.ot.sinkhorn`.
        eps: regularisation in units of the cost, for ``"sqeuclidean"`` the square of a length. GeomLoss's
            cost is half the squared distance, so its ``blur`` is ``eps = 2 * blur ** 2`` here and values are twice its.
        n_iters: largest number of iterations, those of annealing included.
        tol: stop when the column sums are this close to their weights, as a share of their total.
        anneal: start at the largest cost of the batch and lower eps by this factor per iteration; ``None``, and
            ``domain="kernel"``, start at ``eps``.
        a: ``(B, N)`` or ``(N,)`` weights of x, uniform with sum 1 by default.
        b: weights of y.
        mask_x: ``(B, N)`` bool, True = real point.
        mask_y: ``(B, M)`` bool.
        debias: subtract the two self-transport terms; without, the value is :math:`\mathrm{OT}_\varepsilon`.
        domain: see :func:`~meshkit.ot.sinkhorn`.
        store: see :func:`~meshkit.ot.sinkhorn`.

    Returns:
        ``(B,)`` in units of the cost, differentiable in points and weights; 0 for a sample without any real point on
        one side.

    Raises:
        ValueError: as :func:`~meshkit.ot.sinkhorn`.

    Reference:
        Feydy et al. 2019, "Interpolating between optimal transport and MMD using Sinkhorn divergences".

    Example:
        >>> import torch
        >>> x = torch.rand(1, 5, 3)
        >>> sinkhorn_divergence(x, x)
        tensor([0.])
        >>> shifted = sinkhorn_divergence(x, x + torch.tensor([3.0, 0.0, 0.0]))
        >>> round(shifted.item(), 3)
        9.0
    """

    if not isinstance(eps, int | float):
        raise ValueError(f"eps must be a number, got {type(eps).__name__}; use anneal to lower it in steps")

    def transport(first: Side, second: Side) -> Tensor:
        schedule: float | list[float] = eps
        if anneal is not None and domain != "kernel" and eps > 0:
            start = _largest_cost(first, second, cost)
            schedule = eps_schedule(max(eps, start if start < math.inf else eps), eps, factor=anneal)[-n_iters:]
        plan = sinkhorn(
            first.points,
            second.points,
            cost=cost,
            eps=schedule if isinstance(schedule, list) and len(schedule) > 1 else eps,
            n_iters=n_iters,
            tol=tol,
            a=first.weights,
            b=second.weights,
            mask_x=first.mask,
            mask_y=second.mask,
            domain=domain,
            store=store,
        )
        return plan.read_samples(_dual_value)

    check_features(x, y)
    check_mask(mask_x, *x.shape[:2], name="mask_x")
    check_mask(mask_y, *y.shape[:2], name="mask_y")
    mu, nu = Side(x, a, mask_x), Side(y, b, mask_y)
    value = transport(mu, nu)
    if debias:
        value = value - (transport(mu, mu) + transport(nu, nu)) / 2
    return torch.where(mu.alive() & nu.alive(), value, 0.0)


class Side(NamedTuple):
    """Weighted points."""

    points: Tensor
    weights: Tensor | None
    mask: Tensor | None

    def alive(self) -> Tensor:
        """Samples with any mass, ``(B,)``."""
        alive = torch.ones(self.points.shape[:2], dtype=torch.bool, device=self.points.device)
        for weights in (self.weights, self.mask):
            alive = alive if weights is None else alive & (weights > 0)
        return alive.any(1)


def _dual_value(sample: SamplePlan) -> Tensor:
    """Dual objective at constant potentials, as a function of kernel and weights."""
    mu, nu, eps = sample.mu, sample.nu, float(sample.eps)
    log_a, log_b = (t.detach() for t in sample.logarithms())
    a, b = sample.a.detach() * mu / mu.detach(), sample.b.detach() * nu / nu.detach()
    mass = (a * sample.kernel.apply(b[:, None], sample.reference)[:, 0]).sum()
    f = eps * (log_a - mu.detach().log()) + sample.shift
    g = eps * (log_b - nu.detach().log())
    return (mu * f).sum() + (nu * g).sum() - eps * (mass - mu.sum() * nu.sum())


def _largest_cost(first: Side, second: Side, cost: str) -> float:
    """A bound over all samples; what is masked counts as zero."""
    x, y = (side.points.detach().float() for side in (first, second))
    if first.mask is not None:
        x = x.where(first.mask[..., None], 0)
    if second.mask is not None:
        y = y.where(second.mask[..., None], 0)
    return max(logit_features(p, q, cost, 1.0, constant=False)[2] for p, q in zip(x, y, strict=True))
