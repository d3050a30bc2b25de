"""Edge length loss: squared lengths of the mesh edges."""

from torch import Tensor

from meshkit._connectivity import connectivity, edge_lengths
from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import ReducedLoss, Reduction, at_least_float32, check_reduction, reduce_samples

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
        >>> import torch
        >>> triangle = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]])
        >>> edge_length_loss(triangle, torch.tensor([[0, 1, 2]]), reduction="sum")  # 2 (9 + 16 + 25)
        tensor(100.)
    """
    check_reduction(reduction)
    check_verts(verts)
    check_mask(mask, *verts.shape[:2])
    mesh = connectivity(verts, faces)
    real = None if mask is None else mesh.real(mask, mesh.edges)
    total = mesh.totals(edge_lengths(mesh, at_least_float32(verts), real, squared=True), mesh.edge_counts)
    count = mesh.counts(real, mesh.edge_counts, total)
    return reduce_samples(2 * total, 2 * count, reduction)


class EdgeLengthLoss(ReducedLoss):
    """Module form of :func:`edge_length_loss`.

    Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if the reduction is unknown.

    Example:
        >>> import torch
        >>> EdgeLengthLoss()(torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), torch.tensor([[0, 1, 2]])).item()
        1.3333333730697632
    """

    def forward(self, verts: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Return the loss, see :func:`edge_length_loss`."""
        return edge_length_loss(verts, faces, mask=mask, reduction=self.reduction)
