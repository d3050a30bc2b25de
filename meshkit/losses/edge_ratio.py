"""Edge ratio loss: relative change of the edge lengths against a reference mesh."""

import torch
from torch import Tensor, nn

from meshkit._connectivity import check_batch_faces, connectivity, edge_lengths
from meshkit._numerics import launch_bound, safe_sqrt
from meshkit._repr import settings
from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import Reduction, check_reduction, check_same_shape, reduce_samples
from meshkit.neighbors import gather_vertices

__all__ = ["EdgeRatioLoss", "edge_ratio_loss"]


def edge_ratio_loss(
    verts: Tensor,
    reference: Tensor,
    faces: Tensor,
    *,
    mask: Tensor | None = None,
    min_length: float = 1e-8,
    reduction: Reduction = "mean",
) -> Tensor:
    r"""Relative change of the edge lengths, summed over the three edges of a face and averaged over the faces.

    .. math::

        L = \frac1F \sum_f \sum_{k=1}^{3} \left| \frac{\lVert e_{fk} \rVert}{\lVert \bar e_{fk} \rVert} - 1 \right|

    with :math:`e_{fk}` the edges of face f in ``verts`` and :math:`\bar e_{fk}` those in ``reference``.

    Args:
        verts: ``(B, N, 3)`` positions.
        reference: ``(B, N, 3)`` positions that set the lengths, in pose transfer the identity mesh.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Faces that touch a padded vertex are left out.
        min_length: reference edges of at most this length, in the unit of the positions, are degenerate: they
            contribute 0, in value and gradient. Their face still counts in the mean.
        reduction: ``"mean"`` over each sample's faces, then over samples; ``"sum"`` over the faces, then the mean over
            samples; ``"none"`` for the mean of each sample, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``, dimensionless; at least float32. A sample without faces counts 0. An edge of ``verts``
        of zero length has ratio 0, hence contributes 1, and passes the subgradient 0.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, ``min_length`` is negative, or the reduction is
            unknown.

    Reference:
        Wang et al., "Neural Pose Transfer by Spatially Adaptive Instance Normalization" (NPT), edge regularisation; the
        released code of X-DualNet uses it too.

    Deviations:
        X-DualNet prints the sum of squared edge lengths instead, :func:`meshkit.losses.edge_length_loss`; the ratio is
        its released code's. The guard against degenerate edges is ours.

    Example:
        >>> mesh = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> edge_ratio_loss(2 * mesh, mesh, torch.tensor([[0, 1, 2]]))  # every edge doubled: 3 x |2 - 1|
        tensor(3.)
    """
    check_reduction(reduction)
    _check_min_length(min_length)
    check_verts(verts)
    check_verts(reference, name="reference")
    check_same_shape(verts, reference, "verts and reference")
    check_mask(mask, *verts.shape[:2])
    if launch_bound(verts) and faces.dim() == 3:
        return _by_faces(verts, reference, faces, mask, min_length, reduction)
    mesh = connectivity(verts, faces)
    dtype = torch.promote_types(torch.promote_types(verts.dtype, reference.dtype), torch.float32)
    # Faces share edges: each is measured once, and counts for every face that has it.
    weight = mesh.around[:, None].to(dtype)
    real_face = real_edge = None
    if mask is not None:
        real_face = mesh.real(mask, mesh.faces.T)
        sides = real_face.to(dtype).index_select(0, mesh.corners // 3)
        weight = weight.new_zeros(len(weight), sides.shape[1]).index_add(0, mesh.corner_edges, sides)
        real_edge = weight > 0
    length, reference_length = (edge_lengths(mesh, positions.to(dtype), real_edge) for positions in (verts, reference))
    # Written so that NaN is not degenerate: a broken reference must show.
    degenerate = reference_length <= min_length
    # w |l / r - 1|, and exactly 0 where l = r
    terms = ((length - reference_length) * (weight / reference_length.masked_fill(degenerate, torch.inf))).abs()
    total = mesh.totals(terms, mesh.edge_counts)
    return reduce_samples(total, mesh.counts(real_face, mesh.face_counts, total), reduction)


def _by_faces(
    verts: Tensor, reference: Tensor, faces: Tensor, mask: Tensor | None, min_length: float, reduction: Reduction
) -> Tensor:
    """The definition, face by face: finding the edges of faces that are new in every batch would take longer.

    A CUDA graph may be captured of it, in which faces cannot be looked at.
    """
    if not (faces.is_cuda and torch.cuda.is_current_stream_capturing()):
        check_batch_faces(verts, faces)
    dtype = torch.promote_types(torch.promote_types(verts.dtype, reference.dtype), torch.float32)
    corners = faces.clamp_min(0)
    real = (faces >= 0).all(2)
    if mask is not None:
        real = real & gather_vertices(mask[..., None], corners)[..., 0].all(2)

    def lengths(positions: Tensor) -> Tensor:
        corner = gather_vertices(positions.to(dtype), corners).masked_fill(~real[..., None, None], 0.0)
        return safe_sqrt((corner - corner.roll(1, 2)).square().sum(3))

    length, reference_length = lengths(verts), lengths(reference)
    degenerate = reference_length <= min_length
    terms = ((length - reference_length) / reference_length.masked_fill(degenerate, torch.inf)).abs()
    return reduce_samples(terms.sum((1, 2)), real.sum(1), reduction)


def _check_min_length(min_length: float) -> None:
    if not min_length >= 0:
        raise ValueError(f"min_length must be a length >= 0, got {min_length}")


class EdgeRatioLoss(nn.Module):
    """Module form of :func:`edge_ratio_loss`.

    Args:
        min_length: longest degenerate reference edge.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if ``min_length`` is negative or the reduction is unknown.

    Example:
        >>> mesh = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> EdgeRatioLoss()(mesh + 5, mesh, torch.tensor([[0, 1, 2]]))
        tensor(0.)
    """

    def __init__(self, *, min_length: float = 1e-8, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction)
        _check_min_length(min_length)
        self.min_length = min_length
        self.reduction = reduction

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "min_length", "reduction")

    def forward(self, verts: Tensor, reference: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Return the loss, see :func:`edge_ratio_loss`."""
        return edge_ratio_loss(verts, reference, faces, mask=mask, min_length=self.min_length, reduction=self.reduction)
