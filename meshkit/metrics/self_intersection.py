"""Self-intersection rate: the share of faces that pass through another face."""

import torch
from torch import Tensor

from meshkit._connectivity import check_batch_faces
from meshkit.batching import check_mask, check_verts
from meshkit.metrics._common import real_faces

__all__ = ["self_intersection_rate"]


def self_intersection_rate(verts: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
    r"""Share of the faces that meet another face where they should not.

    .. math:: \frac{1}{F} \left| \{ f : \exists\, g \ne f,\; f \cap g \not\subset \text{their common vertices and edge}
              \} \right|

    Found with a bounding-box tree and exact predicates in libigl, so there is no tolerance. Faces that touch without
    a common vertex index count, hence the seams of a mesh whose vertices are not welded: weld it first. Degenerate
    faces and copies of a face do not count. The rate of the ground truth is rarely 0 in bent poses: compare with it.

    Args:
        verts: ``(B, N, 3)`` positions.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Faces of padded vertices are left out.

    Returns:
        ``(B,)`` in [0, 1], at least float32, without a gradient. 0 for a sample without faces; NaN if a vertex of a
        face is not finite.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, or a sample has no real vertex.

    Example:
        >>> verts = torch.tensor([[[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, -1], [0.5, 0.5, 1], [1, 0.5, 1]]])
        >>> self_intersection_rate(verts, torch.tensor([[0, 1, 2], [3, 4, 5]]))
        tensor([1.])
    """
    import numpy as np
    from igl.predicates import find_self_intersections

    check_verts(verts)
    check_mask(mask, verts.shape[0], verts.shape[1], nonempty=True)
    check_batch_faces(verts, faces)
    real = real_faces(faces, mask).expand(len(verts), -1)
    rates = []
    for b in range(len(verts)):
        chosen = (faces if faces.ndim == 2 else faces[b])[real[b]].long()
        used, local = torch.unique(chosen, return_inverse=True)
        positions = verts[b].detach()[used].double().cpu()
        if not bool(positions.isfinite().all()):
            rates.append(torch.nan)
        elif len(chosen) == 0:
            rates.append(0.0)
        else:
            pairs = find_self_intersections(positions.numpy(), local.cpu().numpy())[1]
            rates.append(len(np.unique(pairs)) / len(chosen))
    return torch.tensor(rates, device=verts.device, dtype=torch.promote_types(verts.dtype, torch.float32))
