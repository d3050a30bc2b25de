"""Normal consistency loss: neighbouring faces should point the same way."""

import torch
from torch import Tensor

from meshkit._connectivity import connectivity
from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import ReducedLoss, Reduction, at_least_float32, check_reduction, reduce_samples

__all__ = ["NormalConsistencyLoss", "normal_consistency_loss"]


def normal_consistency_loss(
    verts: Tensor, faces: Tensor, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    r"""Angle between the normals of the two faces at an edge, as 1 minus its cosine.

    .. math::

        L = \frac1Q \sum_{e} \bigl(1 - \langle n_{e,1}, n_{e,2} \rangle\bigr)
          = \frac1Q \sum_{e} \tfrac12 \lVert n_{e,1} - n_{e,2} \rVert_2^2

    over the Q edges with exactly two faces. The second form is computed; it stays accurate at small angles. At each
    edge both faces are given one winding, so the winding of ``faces`` does not matter: 0 in the plane, 1 at a
    right angle, 2 where one face is folded onto the other.

    Args:
        verts: ``(B, N, 3)`` positions.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Pairs of faces that touch a padded vertex are
            left out.
        reduction: ``"mean"`` over each sample's edges, then over samples; ``"sum"`` over the edges, then the mean over
            samples; ``"none"`` for the mean of each sample, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``, dimensionless; at least float32. Edges at a boundary (one face) and non-manifold edges
        (three or more, among which none is the neighbour) are left out; a sample without other edges counts 0. A pair
        with a face of no area contributes 0, in value and gradient, and counts in the mean.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, or the reduction is unknown.

    Example:
        >>> hinge = torch.tensor([[[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]]])
        >>> normal_consistency_loss(hinge, torch.tensor([[0, 1, 2], [0, 1, 3]]))  # a right angle
        tensor(1.)
    """
    check_reduction(reduction)
    check_verts(verts)
    check_mask(mask, *verts.shape[:2])
    mesh = connectivity(verts, faces)
    x = mesh.rows(at_least_float32(verts))
    start, end, first, second = (x.index_select(0, rows) for rows in mesh.hinges)
    sides = torch.stack([end - start, first - start, second - start])
    real = None
    if mask is not None:
        real = mesh.real(mask, mesh.hinges)
        sides = torch.where(real[:, None], sides, 0)
    edge, first, second = sides
    normals = torch.stack([torch.linalg.cross(edge, first, dim=1), torch.linalg.cross(second, edge, dim=1)])
    squared = normals.square().sum(2, keepdim=True)
    longest = sides.detach().square().sum(2).amax(0)
    # Written so that NaN is not degenerate: a broken mesh must show.
    degenerate = squared <= (4 * torch.finfo(x.dtype).eps * longest).square()[:, None]
    first, second = normals / torch.where(degenerate, 1, squared).sqrt()
    terms = torch.where(degenerate.any(0)[:, 0], 0, (first - second).square().sum(1) / 2)
    total = mesh.totals(terms, mesh.hinge_counts)
    return reduce_samples(total, mesh.counts(real, mesh.hinge_counts, total), reduction)


class NormalConsistencyLoss(ReducedLoss):
    """Module form of :func:`normal_consistency_loss`.

    Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if the reduction is unknown.

    Example:
        >>> flat = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
        >>> NormalConsistencyLoss()(flat, torch.tensor([[0, 1, 2], [0, 2, 3]]))
        tensor(0.)
    """

    def forward(self, verts: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Return the loss, see :func:`normal_consistency_loss`."""
        return normal_consistency_loss(verts, faces, mask=mask, reduction=self.reduction)
