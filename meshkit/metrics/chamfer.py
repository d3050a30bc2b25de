"""Chamfer distance between two vertex sets."""

from typing import Literal, NamedTuple, get_args, overload

from torch import Tensor

from meshkit.metrics._common import check_clouds, common_dtype
from meshkit.neighbors import distance_to_nearest

__all__ = ["ChamferDetails", "chamfer_distance"]

Direction = Literal["both", "forward", "backward"]
PointReduction = Literal["mean", "sum"]


class ChamferDetails(NamedTuple):
    """Chamfer distance and the distance of each point to the other set, squared if asked for; 0 at padded points.

    Args:
        value: ``(B,)``.
        forward: ``(B, N)``, of each predicted point; None if that direction was not asked for.
        backward: ``(B, M)``, of each target point; None likewise.
    """

    value: Tensor
    forward: Tensor | None
    backward: Tensor | None


@overload
def chamfer_distance(
    pred: Tensor,
    target: Tensor,
    *,
    pred_mask: Tensor | None = ...,
    target_mask: Tensor | None = ...,
    squared: bool = ...,
    point_reduction: PointReduction = ...,
    direction: Direction = ...,
    return_distances: Literal[False] = ...,
) -> Tensor: ...
@overload
def chamfer_distance(
    pred: Tensor,
    target: Tensor,
    *,
    pred_mask: Tensor | None = ...,
    target_mask: Tensor | None = ...,
    squared: bool = ...,
    point_reduction: PointReduction = ...,
    direction: Direction = ...,
    return_distances: Literal[True],
) -> ChamferDetails: ...
def chamfer_distance(
    pred: Tensor,
    target: Tensor,
    *,
    pred_mask: Tensor | None = None,
    target_mask: Tensor | None = None,
    squared: bool = True,
    point_reduction: PointReduction = "mean",
    direction: Direction = "both",
    return_distances: bool = False,
) -> Tensor | ChamferDetails:
    r"""Distance from each point to the nearest point of the other set; no correspondence is needed.

    .. math::

        \mathrm{CD}(P, Q) = \frac{1}{|P|} \sum_{p \in P} \min_{q \in Q} \lVert p - q \rVert_2^2
                          + \frac{1}{|Q|} \sum_{q \in Q} \min_{p \in P} \lVert q - p \rVert_2^2

    The two directions are summed, not halved. The nearest points are found without a gradient and without an N x M
    matrix, then the distances are taken again from their indices; so the result is differentiable, with the exact
    gradient wherever the nearest point is unique.

    Args:
        pred: P, ``(B, N, 3)``.
        target: Q, ``(B, M, 3)``.
        pred_mask: ``(B, N)`` bool, True = real vertex; None if all are real.
        target_mask: ``(B, M)`` bool.
        squared: squared distances; else distances, which pass the subgradient 0 where points coincide.
        point_reduction: ``"mean"`` or ``"sum"`` over the points of each direction.
        direction: ``"both"``, or one sum alone: ``"forward"`` from each predicted point to the target, ``"backward"``
            from each target point to the prediction.
        return_distances: return a :class:`ChamferDetails` with the distance of each point as well.

    Returns:
        ``(B,)``, in squared units of length, or units of length; at least float32. NaN if a point to start from is NaN;
        as a neighbour a NaN point is passed over.

    Raises:
        ValueError: if shapes or dtypes do not fit, an option is unknown, or a sample has no real vertex.

    Reference:
        Fan et al., "A Point Set Generation Network for 3D Object Reconstruction from a Single Image"; X-DualNet,
        section "Evaluation metrics".

    Deviations:
        X-DualNet reports CD without a definition and its released code does not compute it; this is the usual one.

    Example:
        >>> import torch
        >>> p, q = torch.zeros(1, 1, 3), torch.tensor([[[2.0, 0, 0], [4, 0, 0]]])
        >>> chamfer_distance(p, q)  # 2² + (2² + 4²) / 2
        tensor([14.])
        >>> chamfer_distance(p, q, squared=False, return_distances=True).backward
        tensor([[2., 4.]])
    """
    if direction not in get_args(Direction):
        raise ValueError(f"direction must be one of {get_args(Direction)}, got {direction!r}")
    if point_reduction not in get_args(PointReduction):
        raise ValueError(f"point_reduction must be one of {get_args(PointReduction)}, got {point_reduction!r}")
    check_clouds(pred, target, pred_mask, target_mask)
    dtype = common_dtype(pred, target)
    pred, target = pred.to(dtype), target.to(dtype)
    total, forward, backward = pred.new_zeros(len(pred)), None, None
    if direction != "backward":
        forward = distance_to_nearest(pred, target, pred_mask, target_mask, squared=squared)
        total = total + _reduce(forward, pred_mask, point_reduction)
    if direction != "forward":
        backward = distance_to_nearest(target, pred, target_mask, pred_mask, squared=squared)
        total = total + _reduce(backward, target_mask, point_reduction)
    return ChamferDetails(total, forward, backward) if return_distances else total


def _reduce(distance: Tensor, mask: Tensor | None, point_reduction: str) -> Tensor:
    if point_reduction == "sum":
        return distance.sum(1)
    return distance.sum(1) / (distance.shape[1] if mask is None else mask.sum(1))
