"""Edge ratio: how much a prediction stretches the edges of its reference."""

import torch
from torch import Tensor

from meshkit._numerics import safe_sqrt
from meshkit.metrics._common import check_faces_of, check_pair, common_dtype
from meshkit.topology import unique_edges

__all__ = ["edge_ratio"]


def edge_ratio(
    pred: Tensor, target: Tensor, faces: Tensor, *, mask: Tensor | None = None, min_length: float = 1e-8
) -> Tensor:
    r"""Mean relative change of the edge lengths.

    .. math:: \frac{1}{|E|} \sum_{(i,j) \in E}
              \left| \frac{\lVert v'_i - v'_j \rVert}{\lVert v_i - v_j \rVert} - 1 \right|

    Every edge counts once, whereas :func:`meshkit.losses.edge_ratio_loss` sums the three edges of every face, so that
    an edge of two faces counts twice and the value is about three times as large. Against the ground truth it measures
    distortion; against the identity mesh, how far the transfer is from isometric.

    Args:
        pred: ``(B, N, 3)`` positions v'.
        target: ``(B, N, 3)`` positions v, in the same vertex order, that set the lengths.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Edges of padded vertices are left out.
        min_length: edges at most this long in ``target``, in units of length, have no ratio and are left out.

    Returns:
        ``(B,)``, dimensionless; at least float32. NaN for a sample without edges.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, or ``min_length`` is negative.

    Example:
        >>> mesh = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> edge_ratio(1.5 * mesh, mesh, torch.tensor([[0, 1, 2]]))
        tensor([0.5000])
    """
    check_pair(pred, target, mask)
    check_faces_of(pred, faces)
    if not min_length >= 0:
        raise ValueError(f"min_length must be a length >= 0, got {min_length}")
    dtype = common_dtype(pred, target)
    pred, target = pred.to(dtype), target.to(dtype)
    shared = unique_edges(faces) if faces.ndim == 2 else None
    values = []
    for b in range(len(pred)):
        edges = unique_edges(faces[b]) if shared is None else shared
        if mask is not None:
            edges = edges[mask[b][edges].all(1)]
        reference = _edge_lengths(target[b], edges)
        regular = reference > min_length
        ratio = _edge_lengths(pred[b], edges[regular]) / reference[regular]
        values.append((ratio - 1).abs().mean())
    return torch.stack(values)


def _edge_lengths(verts: Tensor, edges: Tensor) -> Tensor:
    return safe_sqrt((verts[edges[:, 0]] - verts[edges[:, 1]]).square().sum(1))
