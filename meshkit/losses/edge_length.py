"""Edge length loss: squared lengths of the mesh edges."""

import torch
from torch import Tensor, nn

from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import Reduction, at_least_float32, check_faces_match, check_reduction, reduce_samples
from meshkit.scatter import segment_sum
from meshkit.topology import unique_edges

__all__ = ["EdgeLengthLoss", "edge_length_loss"]


def edge_length_loss(
    verts: Tensor, faces: Tensor, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    r"""Squared lengths of the edges, which penalises vertices that fly away from their neighbours.

    .. math:: L_{edge} = \sum_v \sum_{u \in \mathcal N(v)} \lVert v - u \rVert_2^2

    Every edge counts twice, once from each of its ends, whether one, two or more faces share it.

    Args:
        verts: ``(B, N, 3)`` positions.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Edges that touch a padded vertex are left out.
        reduction: ``"sum"`` for the sum above, averaged over samples; ``"mean"`` for the mean over each sample's
            directed edges, averaged over samples; ``"none"`` for these means, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``, in squared units of length; at least float32. A sample without edges counts 0.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, or the reduction is unknown.

    Reference:
        X-DualNet, section "Edge loss".

    Deviations:
        The paper prints the sum; ``"mean"`` is the default since its scale does not depend on the mesh. The released
        code uses another loss, :func:`meshkit.losses.edge_ratio_loss`.

    Example:
        >>> triangle = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]])
        >>> edge_length_loss(triangle, torch.tensor([[0, 1, 2]]), reduction="sum")  # 2 (9 + 16 + 25)
        tensor(100.)
    """
    check_reduction(reduction)
    check_verts(verts)
    check_faces_match(verts, faces)
    batch, num = verts.shape[:2]
    check_mask(mask, batch, num)
    tail, head = _packed_edges(faces, batch, num).unbind(-1)
    packed = at_least_float32(verts).flatten(0, 1)
    edge = packed[tail] - packed[head]
    real = torch.ones_like(tail, dtype=torch.bool)
    if mask is not None:
        real = mask.flatten()[tail] & mask.flatten()[head]
        edge = torch.where(real[:, None], edge, 0)
    terms = torch.stack([edge.square().sum(-1), real.to(edge.dtype)], 1)
    total, count = segment_sum(terms, tail // num, batch).unbind(1)
    return reduce_samples(2 * total, 2 * count, reduction)


def _packed_edges(faces: Tensor, batch: int, num: int) -> Tensor:
    """Edges (E, 2) of the whole batch as one mesh, with vertex n of sample b at b * num + n."""
    offset = num * torch.arange(batch, device=faces.device)[:, None, None]
    if faces.ndim == 2:
        return (unique_edges(faces) + offset).flatten(0, 1)
    return unique_edges(torch.where(faces >= 0, faces + offset, -1).flatten(0, 1))


class EdgeLengthLoss(nn.Module):
    """Module form of :func:`edge_length_loss`.

    Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if the reduction is unknown.

    Example:
        >>> EdgeLengthLoss()(torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), torch.tensor([[0, 1, 2]])).item()
        1.3333333730697632
    """

    def __init__(self, *, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction)
        self.reduction = reduction

    def forward(self, verts: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Return the loss, see :func:`edge_length_loss`."""
        return edge_length_loss(verts, faces, mask=mask, reduction=self.reduction)
