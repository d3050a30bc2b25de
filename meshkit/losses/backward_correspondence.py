"""Backward correspondence loss: a matching plan, applied forth and back, should return the pose mesh."""

from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import torch
from torch import Tensor, nn

from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import Reduction, at_least_float32, check_reduction, reduce_samples

__all__ = ["BackwardCorrespondenceLoss", "PlanLike", "backward_correspondence_loss"]

Form = Literal["coordinates", "matrix"]
Normalization = Literal["rows", "both", "none"]


class PlanLike(Protocol):
    """What the loss asks of a batch of transport plans T, which need not be stored.

    Padded rows and columns hold no mass.
    """

    @property
    def shape(self) -> torch.Size:
        """``(B, N, M)``."""

    def __matmul__(self, other: Tensor, /) -> Tensor:
        """Return T x, ``(B, N, d)``, for x ``(B, M, d)``."""

    @property
    def T(self) -> "PlanLike":
        """The transposed plan."""

    def row_sums(self) -> Tensor:
        """Return T 1, ``(B, N)``."""

    def dense(self) -> Tensor:
        """Return T, ``(B, N, M)``."""


def backward_correspondence_loss(
    plan: Tensor | PlanLike,
    pose_verts: Tensor,
    *,
    form: Form = "coordinates",
    normalization: Normalization = "rows",
    mask: Tensor | None = None,
    identity_mask: Tensor | None = None,
    warped: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    r"""Distance between the pose mesh and its image under the plan and back.

    .. math::

        \mathrm{coordinates}: \lVert T^\top T V - V \rVert_2^2
        \qquad
        \mathrm{matrix}: \lVert T^\top T - I \rVert_F^2

    Under ``normalization="rows"`` T stands for :math:`\hat T = \mathrm{diag}(1 / T\mathbf 1)\, T`: each identity vertex
    goes to a weighted mean of pose vertices. The columns of :math:`\hat T` do not sum to one: with uniform marginals
    they sum to N/M, so :math:`\hat T^\top \hat T\, \mathbf 1 = (N/M)\, \mathbf 1`. Hence with N != M the coordinate
    form changes when the pose mesh is moved, even for the best matching; centre the pose meshes. ``"both"`` repairs
    that: the way back is normalised too, :math:`\mathrm{diag}(1 / T^\top \mathbf 1)\, T^\top \hat T V`, so that
    each pose vertex returns to a weighted mean whatever N and M (coordinates only). Under ``"none"`` T is
    taken as it is: a plan of total mass 1 with uniform marginals has rows that sum to 1/N, and
    :math:`T^\top T\, \mathbf 1 = \mathbf 1/(NM)` shrinks the mesh towards the origin.

    The two forms are not equivalent, though the paper says so. The matrix form is zero only if the columns of T are
    orthonormal, and then so is the coordinate form; the coordinate form only asks that TᵀT fixes the three coordinate
    columns of V. M = 2 vertices at x = 1 and x = -1, matched by N = 4 rows (1, 0), (0, 1), (½, ½), (½, ½), have
    coordinate form 0 and matrix form 1.

    Args:
        plan: T, a tensor ``(B, N, M)`` or an object as :class:`PlanLike` (whose padded rows and columns hold no mass);
            N identity vertices, M pose vertices, entries >= 0. Rows without mass contribute nothing.
        pose_verts: V ``(B, M, 3)``.
        form: ``"coordinates"``, two products with the plan; or ``"matrix"``, which stores an ``(M, M)`` matrix per
            sample and costs N M² operations.
        normalization: ``"rows"``, ``"both"`` or ``"none"``, see above.
        mask: ``(B, M)`` bool, True = real pose vertex; None if all are real.
        identity_mask: ``(B, N)`` bool, True = real identity vertex. Only for plans that have mass in padded rows.
        warped: T V ``(B, N, 3)`` under the same normalization, if known already; saves one product. Coordinates only.
        reduction: ``"sum"`` for the squared norms above, averaged over samples; ``"mean"`` for the mean over each
            sample's 3 M coordinates (or M² entries), averaged over samples; ``"none"`` for these means, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``; squared units of length, dimensionless for the matrix form; at least float32.

    Raises:
        ValueError: if shapes or dtypes do not fit, an option is unknown, or ``warped`` meets the matrix form.

    Reference:
        X-DualNet, section "Backward correspondence loss", equations lcorr (coordinates) and lcorr2 (matrix).

    Deviations:
        The paper prints raw T and squared norms; the released code normalises the rows and takes the mean, and so does
        the default.

    Example:
        >>> pose = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [-1, -1, 0]]])
        >>> permutation = torch.eye(3)[[2, 0, 1]][None] / 3
        >>> backward_correspondence_loss(permutation, pose)
        tensor(0.)
        >>> backward_correspondence_loss(permutation, pose, form="matrix", normalization="none", reduction="sum")
        tensor(2.3704)
    """
    check_reduction(reduction)
    _check_options(form, normalization)
    if warped is not None and form == "matrix":
        raise ValueError('warped is of no use with form="matrix"; leave it out, or take form="coordinates"')
    check_verts(pose_verts, name="pose_verts")
    batch, num = pose_verts.shape[:2]
    check_mask(mask, batch, num)
    if len(plan.shape) != 3 or (plan.shape[0], plan.shape[2]) != (batch, num) or plan.shape[1] == 0:
        raise ValueError(
            f"plan must have shape (B, N, M) = ({batch}, N, {num}) to match pose_verts, got {tuple(plan.shape)}"
        )
    rows = plan.shape[1]
    check_mask(identity_mask, batch, rows, name="identity_mask")
    if warped is not None and warped.shape != (batch, rows, 3):
        raise ValueError(f"warped must have shape {(batch, rows, 3)}, got {tuple(warped.shape)}")

    # Bfloat16 products would drown the difference of nearly equal terms.
    with torch.autocast(pose_verts.device.type, enabled=False):
        verts = at_least_float32(pose_verts)
        real = verts.new_ones(batch, num, dtype=torch.bool) if mask is None else mask
        if form == "matrix":
            return _matrix_form(_real_block(plan, mask, identity_mask), real, normalization, reduction)
        if isinstance(plan, Tensor):
            block = _real_block(plan, mask, identity_mask)
            dtype = torch.promote_types(block.dtype, verts.dtype)
            plan, verts = _DensePlan(block.to(dtype)), verts.to(dtype)
        verts = torch.where(real[..., None], verts, 0)
        return _coordinate_form(plan, verts, real, identity_mask, warped, normalization, reduction)


def _coordinate_form(
    plan: PlanLike,
    verts: Tensor,
    real: Tensor,
    identity_mask: Tensor | None,
    warped: Tensor | None,
    normalization: Normalization,
    reduction: Reduction,
) -> Tensor:
    scale = None
    if normalization != "none":
        scale = _inverse_or_zero(plan.row_sums())[..., None]
        has_mass = scale[..., 0] != 0
        identity_mask = has_mass if identity_mask is None else identity_mask & has_mass
    if warped is None:
        warped = plan @ verts if scale is None else scale * (plan @ verts)
    warped = warped.to(verts.dtype)
    if identity_mask is not None:
        warped = torch.where(identity_mask[..., None], warped, 0)
    if normalization == "both":
        restored = _inverse_or_zero(plan.T.row_sums())[..., None] * (plan.T @ warped)
    else:
        restored = plan.T @ (warped if scale is None else scale * warped)
    # Padded pose vertices are 0 in both terms: zeroed in verts, without mass in the plan.
    return reduce_samples((restored - verts).square().sum((1, 2)), 3 * real.sum(1), reduction)


def _matrix_form(plan: Tensor, real: Tensor, normalization: Normalization, reduction: Reduction) -> Tensor:
    if normalization == "rows":
        plan = plan * _inverse_or_zero(plan.sum(2))[..., None]
    residual = plan.mT @ plan - torch.diag_embed(real.to(plan.dtype))
    return reduce_samples(residual.square().sum((1, 2)), real.sum(1).square(), reduction)


def _real_block(plan: Tensor | PlanLike, mask: Tensor | None, identity_mask: Tensor | None) -> Tensor:
    """The dense plan, zero outside the real rows and columns."""
    block = at_least_float32(plan if isinstance(plan, Tensor) else plan.dense())
    if mask is not None:
        block = torch.where(mask[:, None, :], block, 0)
    if identity_mask is not None:
        block = torch.where(identity_mask[:, :, None], block, 0)
    return block


def _inverse_or_zero(sums: Tensor) -> Tensor:
    empty = sums < torch.finfo(sums.dtype).tiny
    return torch.where(empty, 0, torch.where(empty, 1, sums).reciprocal())


@dataclass(frozen=True)
class _DensePlan:
    """A stored plan behind the protocol of :class:`PlanLike`."""

    matrix: Tensor

    @property
    def shape(self) -> torch.Size:
        return self.matrix.shape

    def __matmul__(self, other: Tensor, /) -> Tensor:
        return self.matrix @ other

    @property
    def T(self) -> "_DensePlan":
        return _DensePlan(self.matrix.mT)

    def row_sums(self) -> Tensor:
        return self.matrix.sum(2)

    def dense(self) -> Tensor:
        return self.matrix


def _check_options(form: str, normalization: str) -> None:
    if form not in get_args(Form):
        raise ValueError(f"form must be one of {get_args(Form)}, got {form!r}")
    if normalization not in get_args(Normalization):
        raise ValueError(f"normalization must be one of {get_args(Normalization)}, got {normalization!r}")
    if form == "matrix" and normalization == "both":
        raise ValueError('normalization="both" needs form="coordinates"; take "rows" or "none" for the matrix form')


class BackwardCorrespondenceLoss(nn.Module):
    """Module form of :func:`backward_correspondence_loss`.

    Args:
        form: ``"coordinates"`` or ``"matrix"``.
        normalization: ``"rows"``, ``"both"`` or ``"none"``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if an option is unknown.

    Example:
        >>> BackwardCorrespondenceLoss(form="matrix")(torch.eye(4)[None], torch.rand(1, 4, 3))
        tensor(0.)
    """

    def __init__(
        self, *, form: Form = "coordinates", normalization: Normalization = "rows", reduction: Reduction = "mean"
    ) -> None:
        super().__init__()
        check_reduction(reduction)
        _check_options(form, normalization)
        self.form = form
        self.normalization = normalization
        self.reduction = reduction

    def forward(
        self,
        plan: Tensor | PlanLike,
        pose_verts: Tensor,
        *,
        mask: Tensor | None = None,
        identity_mask: Tensor | None = None,
        warped: Tensor | None = None,
    ) -> Tensor:
        """Return the loss, see :func:`backward_correspondence_loss`."""
        return backward_correspondence_loss(
            plan,
            pose_verts,
            form=self.form,
            normalization=self.normalization,
            mask=mask,
            identity_mask=identity_mask,
            warped=warped,
            reduction=self.reduction,
        )
