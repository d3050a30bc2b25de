"""Ragged batches of meshes: padding, masks and the statistics that must not see the padding.

A batch of meshes with different vertex counts is one ``(B, N, C)`` tensor and a ``(B, N)`` bool mask, True at the
real vertices. ``mask=None`` always means that every vertex is real.
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

__all__ = [
    "bounding_box_center",
    "center",
    "check_mask",
    "check_verts",
    "masked_mean",
    "pad",
    "pad_faces",
    "unpad",
]


def check_verts(verts: Tensor, *, name: str = "verts") -> None:
    """Check that a tensor is a batch of vertex positions, ``(B, N, 3)``, floating point and not empty.

    Args:
        verts: the tensor to check.
        name: what the message calls it.

    Raises:
        ValueError: if it is not.

    Example:
        >>> check_verts(torch.zeros(2, 5, 3))
    """
    if verts.ndim != 3 or verts.shape[-1] != 3:
        raise ValueError(f"{name} must have shape (B, N, 3), got {tuple(verts.shape)}; add the batch dimension")
    if verts.numel() == 0:
        raise ValueError(f"{name} must hold at least one sample and one vertex, got shape {tuple(verts.shape)}")
    if not verts.is_floating_point():
        raise ValueError(f"{name} must be floating point, got {verts.dtype}; convert it, e.g. with .float()")


def check_mask(mask: Tensor | None, batch: int, num: int, *, name: str = "mask", nonempty: bool = False) -> None:
    """Check that a mask fits a padded batch.

    Args:
        mask: ``(batch, num)`` bool, True at the real vertices, or None (all real), which always passes.
        batch: number of samples B.
        num: padded number of vertices N.
        name: what the message calls it.
        nonempty: also require a real vertex in every sample. This reads the mask's values, hence waits for the
            device, so it is left to code outside the training step.

    Raises:
        ValueError: if the mask has another shape or dtype, or a sample without real vertices under ``nonempty``.
        TypeError: if it is no tensor.

    Example:
        >>> check_mask(torch.tensor([[True, False]]), 1, 2, nonempty=True)
    """
    if mask is None:
        return
    if not isinstance(mask, Tensor):
        raise TypeError(f"{name} must be a bool tensor {(batch, num)} or None, got {type(mask).__name__}")
    if mask.dtype != torch.bool:
        raise ValueError(f"{name} must be bool (True = real vertex), got {mask.dtype}; convert it with .bool()")
    if mask.shape != (batch, num):
        raise ValueError(f"{name} must have shape {(batch, num)} to match the vertices, got {tuple(mask.shape)}")
    if nonempty and not bool(mask.any(1).all()):
        empty = (~mask.any(1)).nonzero()[:, 0].tolist()
        raise ValueError(f"{name} marks no real vertex in samples {empty}; drop these samples")


def pad(tensors: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Stack per-vertex tensors of different lengths into one zero-padded batch.

    Args:
        tensors: B tensors ``(N_i, C)`` that share C, dtype and device.

    Returns:
        The batch ``(B, N, C)`` with ``N = max N_i``, and its mask ``(B, N)``, True at the real vertices.

    Raises:
        ValueError: for an empty list, a tensor without vertices, or tensors that do not fit together.

    Example:
        >>> padded, mask = pad([torch.ones(2, 3), torch.ones(1, 3)])
        >>> padded.shape, mask.tolist()
        (torch.Size([2, 2, 3]), [[True, True], [True, False]])
    """
    _check_stackable(tensors, "(N_i, C)")
    lengths = torch.tensor([len(tensor) for tensor in tensors], device=tensors[0].device)
    padded = pad_sequence(list(tensors), batch_first=True)
    return padded, torch.arange(padded.shape[1], device=padded.device) < lengths[:, None]


def unpad(padded: Tensor, mask: Tensor | None = None) -> list[Tensor]:
    """Take a padded batch apart: the inverse of :func:`pad`.

    Args:
        padded: ``(B, N, C)``, or ``(B, N)``.
        mask: ``(B, N)`` bool, True = real vertex, at any places; None if all are real.

    Returns:
        B tensors ``(N_i, C)``, or ``(N_i,)``.

    Raises:
        ValueError: for a tensor of fewer than two dimensions, a mask that does not fit, or an empty sample.

    Example:
        >>> [len(verts) for verts in unpad(torch.ones(2, 2, 3), torch.tensor([[True, True], [False, True]]))]
        [2, 1]
    """
    if padded.ndim < 2:
        raise ValueError(f"padded must have shape (B, N, C) or (B, N), got {tuple(padded.shape)}")
    check_mask(mask, padded.shape[0], padded.shape[1], nonempty=True)
    if mask is None:
        return list(padded.unbind(0))
    return [sample[real] for sample, real in zip(padded, mask, strict=True)]


def pad_faces(faces: Sequence[Tensor]) -> Tensor:
    """Stack face lists of different lengths into one batch padded with -1.

    Args:
        faces: B tensors ``(F_i, 3)`` int64 of vertex indices.

    Returns:
        ``(B, F, 3)`` int64 with ``F = max F_i``; the rows beyond ``F_i`` are -1.

    Raises:
        ValueError: for an empty list, a mesh without faces, another shape or dtype, or a negative index.

    Example:
        >>> pad_faces([torch.tensor([[0, 1, 2], [2, 1, 3]]), torch.tensor([[0, 1, 2]])])[1].tolist()
        [[0, 1, 2], [-1, -1, -1]]
    """
    _check_stackable(faces, "(F_i, 3)")
    if faces[0].shape[1] != 3 or faces[0].dtype != torch.int64:
        raise ValueError(
            f"faces must be (F_i, 3) int64, got shape {tuple(faces[0].shape)} and {faces[0].dtype}; triangulate the "
            "mesh, convert with .long()"
        )
    for index, sample in enumerate(faces):
        if bool((sample < 0).any()):
            raise ValueError(f"faces[{index}] has a negative vertex index; pass face lists that are not padded yet")
    return pad_sequence(list(faces), batch_first=True, padding_value=-1)


def masked_mean(x: Tensor, mask: Tensor | None = None, dim: int = 1) -> Tensor:
    r"""Mean over the real vertices of each sample.

    .. math:: \bar x_b = \frac{1}{N_b} \sum_{n:\, m_{bn}} x_{bn}

    The sum runs in at least float32. Padded entries, NaN included, change neither the value nor the gradient.

    Args:
        x: floating point, batch first, with the N vertices along ``dim``, e.g. ``(B, N, C)``.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real.
        dim: the vertex dimension of ``x``, any but the first.

    Returns:
        ``x`` without ``dim``, in its dtype. A sample without real vertices has mean 0.

    Raises:
        ValueError: if ``x`` is not floating point, ``dim`` is the batch dimension or out of range, there are no
            vertices, or the mask does not fit.

    Example:
        >>> masked_mean(torch.tensor([[[1.0], [3.0], [9.0]]]), torch.tensor([[True, True, False]]))
        tensor([[2.]])
    """
    if not x.is_floating_point():
        raise ValueError(f"x must be floating point, got {x.dtype}; convert it, e.g. with .float()")
    if not -x.ndim < dim < x.ndim or dim == 0:
        raise ValueError(f"dim must be a dimension of x {tuple(x.shape)} other than the batch (0), got {dim}")
    if x.shape[dim] == 0:
        raise ValueError(f"x must hold at least one vertex along dim {dim}, got shape {tuple(x.shape)}")
    check_mask(mask, x.shape[0], x.shape[dim])
    accumulate = torch.promote_types(x.dtype, torch.float32)
    if mask is None:
        return x.mean(dim, dtype=accumulate).to(x.dtype)
    shape = [1] * x.ndim
    shape[0], shape[dim] = mask.shape
    mask = mask.view(shape)
    total = torch.where(mask, x, 0).sum(dim, dtype=accumulate)
    return (total / mask.sum(dim).clamp_min(1)).to(x.dtype)


def bounding_box_center(verts: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Midpoint of the axis-aligned bounding box of each sample.

    .. math:: c_b = \tfrac12 \left( \min_n v_{bn} + \max_n v_{bn} \right)

    Args:
        verts: ``(B, N, 3)`` positions.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real.

    Returns:
        ``(B, 1, 3)``, in the units of ``verts``. A sample without real vertices has centre 0.

    Raises:
        ValueError: if ``verts`` or ``mask`` has another shape or dtype, or there are no vertices.

    Example:
        >>> bounding_box_center(torch.tensor([[[0.0, 0, 0], [2, 4, 6], [1, 1, 1]]]))
        tensor([[[1., 2., 3.]]])
    """
    check_verts(verts)
    check_mask(mask, verts.shape[0], verts.shape[1])
    if mask is None:
        return (verts.amin(1, keepdim=True) + verts.amax(1, keepdim=True)) / 2
    real = mask[..., None]
    low = torch.where(real, verts, torch.inf).amin(1, keepdim=True)
    high = torch.where(real, verts, -torch.inf).amax(1, keepdim=True)
    occupied = real.any(1, keepdim=True)
    # Zero both ends before the sum: inf - inf would leave a NaN behind in the gradient.
    return (torch.where(occupied, low, 0) + torch.where(occupied, high, 0)) / 2


def center(verts: Tensor, mask: Tensor | None = None) -> Tensor:
    """Move each sample so that its bounding box is centred at the origin.

    Args:
        verts: ``(B, N, 3)`` positions.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real.

    Returns:
        ``(B, N, 3)``, ``verts - bounding_box_center(verts, mask)``; padded entries are 0.

    Raises:
        ValueError: as :func:`bounding_box_center`.

    Example:
        >>> center(torch.tensor([[[0.0, 0, 0], [2, 4, 6]]]))
        tensor([[[-1., -2., -3.],
                 [ 1.,  2.,  3.]]])
    """
    centered = verts - bounding_box_center(verts, mask)
    return centered if mask is None else torch.where(mask[..., None], centered, 0)


def _check_stackable(tensors: Sequence[Tensor], shape: str) -> None:
    if len(tensors) == 0:
        raise ValueError(f"expected a list of at least one {shape} tensor, got an empty list")
    first = tensors[0]
    for index, tensor in enumerate(tensors):
        if tensor.ndim != 2:
            raise ValueError(f"every tensor must have shape {shape}, number {index} has {tuple(tensor.shape)}")
        if tensor.shape[0] == 0:
            raise ValueError(f"tensor number {index} is empty, shape {tuple(tensor.shape)}; drop empty meshes")
        if (tensor.shape[1], tensor.dtype, tensor.device) != (first.shape[1], first.dtype, first.device):
            raise ValueError(
                f"tensors must agree in columns, dtype and device: number 0 has ({first.shape[1]}, {first.dtype}, "
                f"{first.device}), number {index} has ({tensor.shape[1]}, {tensor.dtype}, {tensor.device})"
            )
