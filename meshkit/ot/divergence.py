"""Sinkhorn divergence between weighted point sets."""

from __future__ import annotations

import math
import warnings
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from meshkit._compile import uncompiled
from meshkit.batching import check_mask
from meshkit.ot.costs import logit_features, number
from meshkit.ot.options import Cost, Domain, Options, Store, check_choice, plain, read_options
from meshkit.ot.sample import SamplePlan
from meshkit.ot.sinkhorn import check_features, eps_schedule, solve_features

__all__ = ["sinkhorn_divergence"]

_UNCONVERGED = (
    "sinkhorn_divergence: n_iters ended before tol was met, and the gradient's error is of first order in what is "
    "missing; raise n_iters or eps, or take tol=None for a fixed number of iterations"
)


@uncompiled
def sinkhorn_divergence(
    x: Tensor,
    y: Tensor,
    *,
    cost: Cost = "sqeuclidean",
    eps: float = 0.01,
    n_iters: int = 500,
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
    \varepsilon (\sum T - 1)`, whose gradient holds the potentials constant. What is missing to convergence enters the
    value in second order, the gradient in first: iterate to ``tol``, and mind the warning if ``n_iters`` ends before.
    Between the exact transport cost (eps to 0) and an energy distance (eps to infinity).

    Being constants, the potentials need not come from Algorithm 1: between the sets its steps are over-relaxed, within
    a set they are averaged, which takes some 20 iterations at any eps.

    Args:
        x: ``(B, N, D)`` points.
        y: ``(B, M, D)`` points.
        cost: ``"sqeuclidean"``, ``"cosine"`` or ``"dot"``, see :func:`~meshkit.ot.sinkhorn`.
        eps: regularisation in units of the cost, for ``"sqeuclidean"`` the square of a length. GeomLoss's
            cost is half the squared distance, so its ``blur`` is ``eps = 2 * blur ** 2`` here and values are twice its.
        n_iters: largest number of iterations, those of annealing included. The smaller eps is in units of the largest
            cost, the more are needed.
        tol: stop when the column sums are this close to their weights, as a share of their total; ``None`` runs all
            iterations, none of them over-relaxed.
        anneal: start at the largest cost of the batch and lower eps by this factor per iteration; ``None``, and
            ``domain="kernel"``, start at ``eps``.
        a: ``(B, N)`` or ``(N,)`` weights of x, uniform with sum 1 by default.
        b: weights of y.
        mask_x: ``(B, N)`` bool, True = real point.
        mask_y: ``(B, M)`` bool.
        debias: subtract the two self-transport terms; without, the value is :math:`\mathrm{OT}_\varepsilon`.
        domain: see :func:`~meshkit.ot.sinkhorn`; ``"kernel"`` iterates between the sets as printed there.
        store: see :func:`~meshkit.ot.sinkhorn`.

    Returns:
        ``(B,)`` in units of the cost, differentiable in points and weights; 0 for a sample without any real point on
        one side, not finite for one with a real point that is not.

    Raises:
        ValueError: as :func:`~meshkit.ot.sinkhorn`, and if ``anneal`` is not between 0 and 1.

    Reference:
        Feydy et al. 2019, "Interpolating between optimal transport and MMD using Sinkhorn divergences".

    Example:
        >>> import torch
        >>> x = torch.rand(1, 5, 3)
        >>> bool(sinkhorn_divergence(x, x).abs() < 1e-6)
        True
        >>> shifted = sinkhorn_divergence(x, x + torch.tensor([3.0, 0.0, 0.0]))
        >>> round(shifted.item(), 3)
        9.0
    """
    options = read_divergence_options(eps, n_iters, tol, anneal, domain, store)
    eps, n_iters = number(options.eps), options.settings.n_iters

    def transport(first: Side, second: Side, dual: Literal["between", "within"]) -> Tensor:
        own = options._replace(dual=dual)
        if anneal is not None and domain != "kernel":
            start = _largest_cost(first, second, cost)
            schedule = eps_schedule(max(eps, start if start < math.inf else eps), eps, factor=anneal)[-n_iters:]
            own = own.through(schedule) if len(schedule) > 1 else own
        weights: dict[str, Any] = {"a": first.weights, "b": second.weights, "mask_x": first.mask, "mask_y": second.mask}
        plan = solve_features(first.points, second.points, cost, own, **weights)
        if tol is not None and max(plan.n_iters) == n_iters:
            with torch.no_grad():
                if bool((plan.read_samples(_violation) > tol).any()):
                    warnings.warn(_UNCONVERGED, stacklevel=4)
        return plan.read_samples(_dual_value)

    check_features(x, y)
    check_choice("cost", cost, Cost)
    check_mask(mask_x, *x.shape[:2], name="mask_x")
    check_mask(mask_y, *y.shape[:2], name="mask_y")
    mu, nu = Side(x, a, mask_x), Side(y, b, mask_y)
    value = transport(mu, nu, "between")
    if debias:
        value = value - (transport(mu, mu, "within") + transport(nu, nu, "within")) / 2
    return torch.where(mu.alive() & nu.alive(), value, 0.0)


def read_divergence_options(
    eps: float, n_iters: int, tol: float | None, anneal: float | None, domain: Domain, store: Store
) -> Options:
    """Check the options that do not depend on the points."""
    eps = plain(eps)
    if not isinstance(eps, int | float):
        raise ValueError(f"eps must be a number, got {type(eps).__name__}; use anneal to lower it in steps")
    if anneal is not None and not 0 < anneal < 1:
        raise ValueError(f"anneal must be between 0 and 1, or None to start at eps, got {anneal}")
    return read_options(eps, n_iters, tol, None, "unroll", domain, store)


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


def _violation(sample: SamplePlan) -> Tensor:
    """How far the column sums are from their weights, as a share of the total."""
    return (sample.column_mass() - sample.nu).abs().sum() / sample.nu.sum()


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
