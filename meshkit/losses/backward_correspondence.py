"""Backward correspondence loss: a matching plan, applied forth and back, should return the pose mesh."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import torch
from torch import Tensor, nn

from meshkit._numerics import full_precision
from meshkit._repr import settings
from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import Reduction, at_least_float32, check_reduction, reduce_samples

__all__ = ["BackwardCorrespondenceLoss", "PlanLike", "backward_correspondence_loss"]

Form = Literal["coordinates", "matrix"]
Normalization = Literal["rows", "both", "none"]

_BLOCK = 512  # columns of the Gram matrix held at once by the matrix form


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
    pose_mask: Tensor | None = None,
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
        form: ``"coordinates"``, two products with the plan, which is not stored. Or ``"matrix"``, which costs
            2 N M min(N, M) operations and holds the smaller Gram matrix in blocks of 512 columns, never as a whole. It
            stores T, ``(B, N, M)``, if T is a tensor or passes a gradient; else it reads blocks of T and stores no
            matrix.
        normalization: ``"rows"``, ``"both"`` or ``"none"``, see above.
        pose_mask: ``(B, M)`` bool, True = real pose vertex; None if all are real.
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
    check_mask(pose_mask, batch, num, name="pose_mask")
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
        real = verts.new_ones(batch, num, dtype=torch.bool) if pose_mask is None else pose_mask
        if form == "matrix":
            return _matrix_form(plan, real, pose_mask, identity_mask, normalization, reduction)
        if isinstance(plan, Tensor):
            block = _real_block(plan, pose_mask, identity_mask)
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


def _matrix_form(
    plan: Tensor | PlanLike,
    real: Tensor,
    mask: Tensor | None,
    identity_mask: Tensor | None,
    normalization: Normalization,
    reduction: Reduction,
) -> Tensor:
    r"""The smaller of the two Gram matrices is enough: TᵀT and T Tᵀ have the same norm and trace, hence

    .. math:: \lVert T^\top T - I_M \rVert_F^2 = \lVert T T^\top - I_N \rVert_F^2 + M - N.
    """
    batch, num_rows, num_columns = plan.shape
    rows = real.new_ones(batch, num_rows) if identity_mask is None else identity_mask
    wide = num_rows < num_columns
    if isinstance(plan, Tensor) or (torch.is_grad_enabled() and plan.row_sums().requires_grad):
        block = _real_block(plan, mask, identity_mask)
        if normalization == "rows":
            block = block * _inverse_or_zero(block.sum(2))[..., None]
        total: Tensor = _GramResidual.apply(block.mT if wide else block, rows if wide else real)
    else:
        sums = plan.row_sums()
        scale = (_inverse_or_zero(sums) if normalization == "rows" else torch.ones_like(sums)) * rows
        total = _residual_by_products(plan, scale[..., None], rows if wide else real, wide)
    if wide:
        total = total + (real.sum(1) - rows.sum(1))
    return reduce_samples(total, real.sum(1).square(), reduction)


class _GramResidual(torch.autograd.Function):
    """``|SᵀS - diag(real)|²`` of ``S (B, K, k)``, by blocks of columns; the gradient ``4 S (SᵀS - I)`` likewise.

    Kept for the backward pass: S alone.
    """

    @staticmethod
    def forward(ctx: Any, factor: Tensor, real: Tensor) -> Tensor:
        ctx.save_for_backward(factor, real)
        parts = [_gram_residual(factor, real, block).square().sum((1, 2)) for block in _blocks(factor.shape[2])]
        return torch.stack(parts).sum(0)

    @staticmethod
    @full_precision
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        factor, real = ctx.saved_tensors
        gradient = torch.empty_like(factor)
        for block in _blocks(factor.shape[2]):
            gradient[:, :, block] = 4 * upstream[:, None, None] * (factor @ _gram_residual(factor, real, block))
        return gradient, None


def _blocks(size: int) -> list[slice]:
    return [slice(start, min(start + _BLOCK, size)) for start in range(0, size, _BLOCK)]


def _gram_residual(factor: Tensor, real: Tensor, block: slice) -> Tensor:
    residual = factor.mT @ factor[:, :, block]
    residual[:, block].diagonal(dim1=1, dim2=2).sub_(real[:, block].to(residual.dtype))
    return residual


def _residual_by_products(plan: PlanLike, scale: Tensor, real: Tensor, wide: bool) -> Tensor:
    """The same from products with blocks of the identity, two for each block; no N x M matrix is stored."""
    total = scale.new_zeros(len(scale))
    for block in _blocks(real.shape[1]):
        basis = _unit_columns(real, block, scale.dtype)
        image = scale * (plan @ (plan.T @ (scale * basis))) if wide else plan.T @ (scale.square() * (plan @ basis))
        total = total + (image - basis).square().sum((1, 2))
    return total


def _unit_columns(real: Tensor, block: slice, dtype: torch.dtype) -> Tensor:
    """Columns ``block`` of the identity over the real entries, ``(B, k, block)``."""
    basis = torch.zeros(*real.shape, block.stop - block.start, dtype=dtype, device=real.device)
    basis[:, block].diagonal(dim1=1, dim2=2).copy_(real[:, block])
    return basis


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

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "form", "normalization", "reduction")

    def forward(
        self,
        plan: Tensor | PlanLike,
        pose_verts: Tensor,
        *,
        pose_mask: Tensor | None = None,
        identity_mask: Tensor | None = None,
        warped: Tensor | None = None,
    ) -> Tensor:
        """Return the loss, see :func:`backward_correspondence_loss`."""
        return backward_correspondence_loss(
            plan,
            pose_verts,
            form=self.form,
            normalization=self.normalization,
            pose_mask=pose_mask,
            identity_mask=identity_mask,
            warped=warped,
            reduction=self.reduction,
        )
