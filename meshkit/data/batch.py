"""What a training step receives: a batch of (identity mesh, pose mesh, ground truth)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

__all__ = ["PairBatch"]


@dataclass(frozen=True)
class PairBatch:
    """A batch of (identity mesh, pose mesh, ground truth).

    Args:
        identity: ``(B, N, 3)`` mesh that gives the body.
        identity_faces: ``(B, F, 3)``, padded with -1.
        pose: ``(B, M, 3)`` mesh that gives the pose.
        pose_faces: ``(B, G, 3)``, padded with -1.
        ground_truth: ``(B, N, 3)`` body of the one in the pose of the other, in the identity's vertex order; ``(B, 0,
            3)`` if it was left out or is not known.
        correspondence: ``(B, N)`` vertex of the pose mesh that is the same point of the body; -1 where that is not
            known, and in the padding.
        identity_index: ``(B,)`` identity of the body.
        pose_index: ``(B,)`` pose of the ground truth.
        identity_descriptors: ``(B, N, D)`` or ``None``.
        pose_descriptors: ``(B, M, D)`` or ``None``.
        identity_mask: ``(B, N)`` bool, True at real vertices; ``None`` if all are real, that is if the meshes of the
            batch have equally many vertices.
        pose_mask: ``(B, M)`` likewise.
    """

    identity: Tensor
    identity_faces: Tensor
    pose: Tensor
    pose_faces: Tensor
    ground_truth: Tensor
    correspondence: Tensor
    identity_index: Tensor
    pose_index: Tensor
    identity_descriptors: Tensor | None = None
    pose_descriptors: Tensor | None = None
    identity_mask: Tensor | None = None
    pose_mask: Tensor | None = None

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> PairBatch:
        """The batch on another device; ``non_blocking`` overlaps the copy with work if the batch is pinned."""
        return self._map(lambda value: value.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> PairBatch:
        """The batch in page-locked memory, from where a GPU copies without waiting; a loader calls this."""
        return self._map(Tensor.pin_memory)

    def _map(self, function: Callable[[Tensor], Tensor]) -> PairBatch:
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        mapped: dict[str, Any] = {k: None if v is None else function(v) for k, v in values.items()}
        return PairBatch(**mapped)

    def __len__(self) -> int:
        return len(self.identity)
