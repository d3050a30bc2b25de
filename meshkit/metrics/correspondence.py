"""Correspondence error: how far matched vertices lie from the true ones."""

import torch
from torch import Tensor

from meshkit.batching import check_mask, check_verts, masked_mean
from meshkit.neighbors import gather_vertices

__all__ = ["correspondence_error"]


def correspondence_error(matches: Tensor, target_verts: Tensor, truth: Tensor, *, mask: Tensor | None = None) -> Tensor:
    r"""Mean Euclidean distance, on the target mesh, between the matched and the true vertex.

    .. math:: E_b = \frac{1}{N_b} \sum_n \lVert q_{b, m_{bn}} - q_{b, t_{bn}} \rVert_2

    Args:
        matches: m, ``(B, N)`` integer: the target vertex that each source vertex is matched to, e.g. the row-wise
            argmax of a plan.
        target_verts: q, ``(B, M, 3)``, in pose transfer the pose mesh.
        truth: t, ``(B, N)`` integer: the true target vertex.
        mask: ``(B, N)`` bool, True = real source vertex with a known truth; None if that holds for all. Elsewhere the
            indices are ignored and may be -1.

    Returns:
        ``(B,)``, in units of length; at least float32.

    Raises:
        ValueError: if shapes or dtypes do not fit, an index is out of range, or a sample has no real vertex.

    Example:
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]])
        >>> correspondence_error(torch.tensor([[0, 1, 1]]), line, torch.tensor([[0, 1, 2]]))  # (0 + 0 + 4) / 3
        tensor([1.3333])
    """
    check_verts(target_verts, name="target_verts")
    batch, num = target_verts.shape[:2]
    if matches.ndim != 2 or len(matches) != batch or matches.shape != truth.shape or matches.shape[1] == 0:
        raise ValueError(
            f"matches and truth must have the same shape (B, N) with B = {batch} and N > 0, got "
            f"{tuple(matches.shape)} and {tuple(truth.shape)}"
        )
    check_mask(mask, batch, matches.shape[1], nonempty=True)
    verts = target_verts.to(torch.promote_types(target_verts.dtype, torch.float32))
    matched, true = (
        gather_vertices(verts, _checked_indices(index, num, mask, name))
        for index, name in ((matches, "matches"), (truth, "truth"))
    )
    return masked_mean((matched - true).norm(dim=2), mask)


def _checked_indices(index: Tensor, num: int, mask: Tensor | None, name: str) -> Tensor:
    if index.is_floating_point() or index.is_complex() or index.dtype == torch.bool:
        raise ValueError(f"{name} must hold integer indices, got {index.dtype}; convert with .long()")
    if mask is not None:
        index = torch.where(mask, index, 0)
    low, high = (int(bound) for bound in torch.aminmax(index))
    if low < 0 or high >= num:
        raise ValueError(f"{name} must lie in [0, {num}), got a range of [{low}, {high}]; mask what has no match")
    return index.long()
