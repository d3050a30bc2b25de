"""Earth mover's distance between two vertex sets: exact, or between two bounds."""

from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from meshkit._numerics import safe_sqrt
from meshkit.metrics._common import check_clouds, common_dtype

__all__ = ["EarthMoversBounds", "earth_movers_bounds", "earth_movers_distance"]

Method = Literal["exact", "sinkhorn"]


def earth_movers_distance(
    pred: Tensor,
    target: Tensor,
    *,
    pred_mask: Tensor | None = None,
    target_mask: Tensor | None = None,
    squared: bool = False,
    method: Method = "exact",
) -> Tensor:
    r"""Mean distance that points travel when one set is moved onto the other in the cheapest way.

    .. math:: \mathrm{EMD}(P, Q) = \min_{T \ge 0} \sum_{ij} T_{ij} \lVert p_i - q_j \rVert_2, \qquad
              \sum_j T_{ij} = \frac1{|P|}, \quad \sum_i T_{ij} = \frac1{|Q|}

    For sets of one size the best plan is an assignment, and the value :math:`\frac1N \sum_i \lVert p_i - q_{\sigma(i)}
    \rVert`. It is found on the distances less Sinkhorn potentials of a subset of the points, which changes the cost of
    all plans alike but leaves few conflicts to resolve: several times faster than on the distances themselves.

    Args:
        pred: P, ``(B, N, 3)``.
        target: Q, ``(B, M, 3)``.
        pred_mask: ``(B, N)`` bool, True = real vertex; None if all are real.
        target_mask: ``(B, M)`` bool.
        squared: squared distances (the square of the 2-Wasserstein distance), else distances (1-Wasserstein).
        method: ``"exact"``, by SciPy's ``linear_sum_assignment`` where a sample has as many real points on both sides,
            else by the network simplex of POT. It holds the N x M distances in float64: 380 MB for 6890 points.
            ``"sinkhorn"``, the middle of :func:`earth_movers_bounds`, without a matrix and without a gradient: for sets
            whose matrix does not fit. It saves memory and no time: 1 % off, it takes 3.5 times as long as the exact
            value at 1000 points and 1.5 times at 6890.

    Returns:
        ``(B,)``, in units of length, or squared units; at least float32. NaN if a real point is not finite. The exact
        value is differentiable, with the best plan held constant, which is the exact gradient where that is unique.

    Raises:
        ValueError: if shapes or dtypes do not fit, an option is unknown, or a sample has no real vertex.
        ImportError: the sets differ in size and POT is not installed.
        RuntimeError: POT gave up.

    Reference:
        Fan et al., "A Point Set Generation Network for 3D Object Reconstruction from a Single Image"; X-DualNet,
        section "Evaluation metrics".

    Deviations:
        X-DualNet reports EMD without a definition and its released code does not compute it. Fan et al. sum over the
        points and approximate; here it is the mean, not squared, and exact.

    Example:
        >>> p, q = torch.tensor([[[0.0, 0, 0], [1, 0, 0]]]), torch.tensor([[[1.0, 0, 0], [0, 3, 0]]])
        >>> earth_movers_distance(p, q)  # (3 + 0) / 2
        tensor([1.5000])
    """
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {get_args(Method)}, got {method!r}")
    if method == "sinkhorn":
        bounds = earth_movers_bounds(pred, target, pred_mask=pred_mask, target_mask=target_mask, squared=squared)
        return (bounds.lower + bounds.upper) / 2
    from meshkit.metrics._exact_transport import exact_plan

    check_clouds(pred, target, pred_mask, target_mask)
    dtype = common_dtype(pred, target)
    values = []
    for b in range(len(pred)):
        x, y = _real_points(pred, pred_mask, b, dtype), _real_points(target, target_mask, b, dtype)
        if _finite(x, y):
            rows, columns, mass = exact_plan(x.detach(), y.detach(), squared)
            distance = (x[rows] - y[columns]).square().sum(1)
            values.append((mass * (distance if squared else safe_sqrt(distance))).sum())
        else:
            values.append((x.sum() + y.sum()) * torch.nan)
    return torch.stack(values)


class EarthMoversBounds(NamedTuple):
    """Bounds ``(B,)`` that enclose the earth mover's distance, up to rounding."""

    lower: Tensor
    upper: Tensor


def earth_movers_bounds(
    pred: Tensor,
    target: Tensor,
    *,
    pred_mask: Tensor | None = None,
    target_mask: Tensor | None = None,
    squared: bool = False,
    eps: float | None = None,
    n_iters: int = 50,
    tol: float | None = 1e-3,
) -> EarthMoversBounds:
    r"""Two numbers between which the earth mover's distance lies, in O(N + M) memory, for sets too large to solve.

    Sinkhorn potentials made feasible give the lower bound, weak duality; the Sinkhorn plan rounded to the exact
    marginals gives the upper one, the cost of a plan that exists:

    .. math:: \frac1N \sum_i f_i + \frac1M \sum_j g_j \;\le\; \mathrm{EMD}(P, Q) \;\le\; \sum_{ij} T_{ij} C_{ij},
              \qquad f_i + g_j \le C_{ij}

    The entropic cost itself is neither. Distances are recomputed in blocks at every iteration.

    Args:
        pred: P, ``(B, N, 3)``.
        target: Q, ``(B, M, 3)``.
        pred_mask: ``(B, N)`` bool, True = real vertex; None if all are real.
        target_mask: ``(B, M)`` bool.
        squared: as in :func:`earth_movers_distance`.
        eps: regularisation in units of the cost, 0.3 % of the mean cost by default. Smaller closes the gap if more
            iterations are allowed.
        n_iters: largest number of iterations; those that lower eps to its value come first and are always done.
        tol: stop when the column sums are this close to uniform (sum of absolute differences).

    Returns:
        ``lower`` and ``upper``, each ``(B,)``, without a gradient. NaN if a real point is not finite.

    Raises:
        ValueError: if shapes or dtypes do not fit, a sample has no real vertex, or an option is out of range.

    Reference:
        Altschuler, Weed and Rigollet, "Near-linear time approximation algorithms for optimal transport via Sinkhorn
        iteration", Algorithm 2 (the rounding).

    Example:
        >>> p = torch.rand(1, 50, 3)
        >>> lower, upper = earth_movers_bounds(p, p + 1)
        >>> bool(lower <= 3**0.5 + 1e-5) and bool(3**0.5 - 1e-5 <= upper)
        True
    """
    from meshkit.metrics._transport_bounds import DistanceTiles, conjugates, potentials, rounded_cost, uniform

    check_clouds(pred, target, pred_mask, target_mask)
    if eps is not None and not 0 < eps < float("inf"):
        raise ValueError(f"eps must be None, or positive and finite, got {eps}")
    if n_iters < 1:
        raise ValueError(f"n_iters must be at least 1, got {n_iters}")
    if tol is not None and not tol >= 0:
        raise ValueError(f"tol must be None or at least 0, got {tol}")
    dtype = common_dtype(pred, target)
    bounds = []
    with torch.no_grad():
        for b in range(len(pred)):
            x, y = _real_points(pred, pred_mask, b, dtype), _real_points(target, target_mask, b, dtype)
            if not _finite(x, y):
                bounds.append(x.new_full((2,), torch.nan))
                continue
            tiles = DistanceTiles(x, y, squared, eps)
            mu, nu = uniform(x), uniform(y)
            f, g = potentials(tiles, mu, nu, n_iters=n_iters, tol=tol)
            best_f, best_g = conjugates(tiles, g)
            bounds.append(
                torch.stack(
                    [best_f.mean() + best_g.mean(), rounded_cost(tiles, f, g, mu, nu, levels=2, n_iters=n_iters)]
                )
            )
    lower, upper = torch.stack(bounds).unbind(1)
    return EarthMoversBounds(lower, upper)


def _real_points(points: Tensor, mask: Tensor | None, sample: int, dtype: torch.dtype) -> Tensor:
    chosen = points[sample] if mask is None else points[sample][mask[sample]]
    return chosen.to(dtype)


def _finite(x: Tensor, y: Tensor) -> bool:
    return bool(x.isfinite().all() & y.isfinite().all())
