"""Chamfer loss: distance to the nearest point of the other set, with the exact gradient."""

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from meshkit._repr import settings
from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import Reduction, at_least_float32, check_reduction, reduce_samples
from meshkit.neighbors import distance_to_nearest

__all__ = ["ChamferLoss", "chamfer_loss"]

Direction = Literal["both", "forward", "backward"]


def chamfer_loss(
    pred: Tensor,
    target: Tensor,
    *,
    pred_mask: Tensor | None = None,
    target_mask: Tensor | None = None,
    squared: bool = True,
    direction: Direction = "both",
    reduction: Reduction = "mean",
) -> Tensor:
    r"""Distance from each point to the nearest point of the other set; no correspondence is needed.

    .. math::

        L = \frac{1}{|P|} \sum_{p \in P} \min_{q \in Q} \lVert p - q \rVert_2^2
          + \frac{1}{|Q|} \sum_{q \in Q} \min_{p \in P} \lVert q - p \rVert_2^2

    The two directions are summed, not halved. The nearest points are found without a gradient
    (:func:`meshkit.neighbors.knn`: a KD-tree on the CPU, tiles elsewhere and for small meshes) and without a large
    N x M matrix. Then the distances are taken again from their indices. That is the exact gradient wherever the
    nearest point is unique, and what is kept for it is O(N + M).

    Args:
        pred: P, ``(B, N, 3)``.
        target: Q, ``(B, M, 3)``; M need not be N.
        pred_mask: ``(B, N)`` bool, True = real vertex; None if all are real.
        target_mask: ``(B, M)`` bool.
        squared: squared distances; else distances, which pass the subgradient 0 where points coincide.
        direction: ``"both"``, or one sum alone: ``"forward"`` from each predicted point to the target, ``"backward"``
            from each target point to the prediction.
        reduction: ``"mean"`` over the points of each direction, then over samples; ``"sum"`` over the points, then the
            mean over samples; ``"none"`` for the mean of each sample, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``, in squared units of length, or units of length; at least float32. NaN if a point to start
        from is NaN; as a neighbour a NaN point is passed over.

    Raises:
        ValueError: if shapes or dtypes do not fit, an option is unknown, or a sample has no real vertex.

    Reference:
        Fan et al., "A Point Set Generation Network for 3D Object Reconstruction from a Single Image", section 3.

    Example:
        >>> p, q = torch.zeros(1, 1, 3), torch.tensor([[[2.0, 0, 0], [4, 0, 0]]])
        >>> chamfer_loss(p, q)  # 2² + (2² + 4²) / 2
        tensor(14.)
        >>> chamfer_loss(p, q, direction="backward", squared=False)  # (2 + 4) / 2
        tensor(3.)
    """
    check_reduction(reduction)
    _check_direction(direction)
    check_verts(pred, name="pred")
    check_verts(target, name="target")
    if len(pred) != len(target):
        raise ValueError(f"pred and target must have one batch size, got {tuple(pred.shape)} and {tuple(target.shape)}")
    check_mask(pred_mask, *pred.shape[:2], name="pred_mask", nonempty=True)
    check_mask(target_mask, *target.shape[:2], name="target_mask", nonempty=True)
    dtype = torch.promote_types(at_least_float32(pred).dtype, target.dtype)
    pred, target = pred.to(dtype), target.to(dtype)
    values = []
    if direction != "backward":
        values.append(_one_way(pred, pred_mask, target, target_mask, squared, reduction))
    if direction != "forward":
        values.append(_one_way(target, target_mask, pred, pred_mask, squared, reduction))
    return torch.stack(values).sum(0)


def _one_way(
    start: Tensor, start_mask: Tensor | None, to: Tensor, to_mask: Tensor | None, squared: bool, reduction: Reduction
) -> Tensor:
    distance = distance_to_nearest(start, to, start_mask, to_mask, squared=squared)
    count: Tensor | int = start.shape[1] if start_mask is None else start_mask.sum(1)
    return reduce_samples(distance.sum(1), count, reduction)


def _check_direction(direction: str) -> None:
    if direction not in get_args(Direction):
        raise ValueError(f"direction must be one of {get_args(Direction)}, got {direction!r}")


class ChamferLoss(nn.Module):
    """Module form of :func:`chamfer_loss`.

    Args:
        squared: squared distances, or distances.
        direction: ``"both"``, ``"forward"`` or ``"backward"``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if an option is unknown.

    Example:
        >>> points = torch.rand(2, 6, 3)
        >>> ChamferLoss()(points, points.flip(1))
        tensor(0.)
    """

    def __init__(self, *, squared: bool = True, direction: Direction = "both", reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction)
        _check_direction(direction)
        self.squared = squared
        self.direction: Direction = direction
        self.reduction: Reduction = reduction

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "squared", "direction", "reduction")

    def forward(
        self, pred: Tensor, target: Tensor, *, pred_mask: Tensor | None = None, target_mask: Tensor | None = None
    ) -> Tensor:
        """Return the loss, see :func:`chamfer_loss`."""
        return chamfer_loss(
            pred,
            target,
            pred_mask=pred_mask,
            target_mask=target_mask,
            squared=self.squared,
            direction=self.direction,
            reduction=self.reduction,
        )
