"""Checks that several metrics share."""

import torch
from torch import Tensor

from meshkit.batching import check_mask, check_verts


def check_clouds(pred: Tensor, target: Tensor, pred_mask: Tensor | None, target_mask: Tensor | None) -> None:
    """Two batches of points that need not correspond."""
    check_verts(pred, name="pred")
    check_verts(target, name="target")
    if len(pred) != len(target):
        raise ValueError(f"pred and target must have the same batch size, got {len(pred)} and {len(target)}")
    check_mask(pred_mask, pred.shape[0], pred.shape[1], name="pred_mask", nonempty=True)
    check_mask(target_mask, target.shape[0], target.shape[1], name="target_mask", nonempty=True)


def check_pair(pred: Tensor, target: Tensor, mask: Tensor | None) -> None:
    """Two batches of corresponding vertices."""
    check_verts(pred, name="pred")
    check_verts(target, name="target")
    if pred.shape != target.shape:
        raise ValueError(f"pred and target must have the same shape, got {tuple(pred.shape)} and {tuple(target.shape)}")
    check_mask(mask, pred.shape[0], pred.shape[1], nonempty=True)


def common_dtype(first: Tensor, second: Tensor) -> torch.dtype:
    """At least float32: squares and sums of half precision coordinates over- and underflow."""
    return torch.promote_types(torch.promote_types(first.dtype, second.dtype), torch.float32)


def real_faces(faces: Tensor, mask: Tensor | None) -> Tensor:
    """Which faces are neither padding nor touch a padded vertex: ``(F,)``, or ``(B, F)`` if samples differ."""
    real = (faces >= 0).all(-1)
    if mask is None:
        return real
    index = faces.clamp_min(0).long().expand(len(mask), *faces.shape[-2:])
    return real & mask.gather(1, index.flatten(1)).view(index.shape).all(-1)
