"""Volume change of a closed surface."""

import torch
from torch import Tensor

from meshkit._connectivity import check_batch_faces
from meshkit.batching import bounding_box_center
from meshkit.metrics._common import check_pair, common_dtype, real_faces

__all__ = ["volume_change"]


def volume_change(pred: Tensor, target: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
    r"""Relative change of the enclosed volume, with its sign: 0.1 if the prediction is 10 % larger.

    .. math:: \frac{V(v') - V(v)}{|V(v)|}, \qquad V(v) = \frac16 \sum_f \det [v_{f1}, v_{f2}, v_{f3}]

    By the divergence theorem V is the enclosed volume of a closed mesh whose faces all turn the same way; where the
    surface crosses itself, parts count as often as it winds around them. For an open mesh, it is that of the mesh
    closed by a cone to the centre of its bounding box, which is where coordinates are taken from.

    Args:
        pred: ``(B, N, 3)`` positions v'.
        target: ``(B, N, 3)`` positions v, in the same vertex order.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Faces of padded vertices are left out.

    Returns:
        ``(B,)``, dimensionless; at least float32. Infinite or NaN where the target has no volume.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, or a sample has no real vertex.

    Example:
        >>> corner = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> volume_change(2 * corner, corner, faces).round(decimals=4)
        tensor([7.])
    """
    check_pair(pred, target, mask)
    check_batch_faces(pred, faces)
    dtype = common_dtype(pred, target)
    before, after = (_volume(verts.to(dtype), faces, mask) for verts in (target, pred))
    return (after - before) / before.abs()


def _volume(verts: Tensor, faces: Tensor, mask: Tensor | None) -> Tensor:
    verts = verts - bounding_box_center(verts, mask)
    index = faces.long().clamp_min(0).expand(len(verts), *faces.shape[-2:])
    rows = torch.arange(len(verts), device=verts.device)[:, None, None]
    corners = torch.where(real_faces(faces, mask)[..., None, None], verts[rows, index], 0)
    first, second, third = corners.unbind(2)
    return (first * torch.linalg.cross(second, third, dim=-1)).sum((1, 2)) / 6
