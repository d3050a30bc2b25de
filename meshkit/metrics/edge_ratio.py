"""Edge ratio: how much a prediction stretches the edges of its reference."""

from torch import Tensor

from meshkit._connectivity import connectivity, edge_lengths
from meshkit.metrics._common import check_pair, common_dtype

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
        >>> import torch
        >>> mesh = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> edge_ratio(1.5 * mesh, mesh, torch.tensor([[0, 1, 2]]))
        tensor([0.5000])
    """
    check_pair(pred, target, mask)
    if not min_length >= 0:
        raise ValueError(f"min_length must be a length >= 0, got {min_length}")
    dtype = common_dtype(pred, target)
    mesh = connectivity(pred, faces)
    real = None if mask is None else mesh.real(mask, mesh.edges)
    length, reference = (edge_lengths(mesh, positions.to(dtype), real) for positions in (pred, target))
    regular = reference > min_length
    terms = (length / reference.where(regular, 1) - 1).abs().where(regular, 0)
    total = mesh.totals(terms, mesh.edge_counts)
    return total / mesh.counts(regular, mesh.edge_counts, total)
