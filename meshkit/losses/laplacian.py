"""Laplacian loss: differential coordinates, their size or their change."""

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from meshkit._connectivity import Connectivity, connectivity
from meshkit._repr import settings
from meshkit.batching import check_mask, check_verts
from meshkit.losses._common import Reduction, at_least_float32, check_reduction, check_same_shape, reduce_samples
from meshkit.topology import cotangent_weights

__all__ = ["LaplacianLoss", "laplacian_loss"]

Weights = Literal["uniform", "cotangent"]


def laplacian_loss(
    verts: Tensor,
    faces: Tensor,
    *,
    reference: Tensor | None = None,
    weights: Weights = "uniform",
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    r"""Squared differential coordinates of a mesh, or of its displacement from a reference mesh.

    .. math::

        \delta_i(V) = v_i - \frac{\sum_{j \in \mathcal N(i)} w_{ij} v_j}{\sum_{j \in \mathcal N(i)} w_{ij}},
        \qquad
        L = \frac1N \sum_i \lVert \delta_i(V) \rVert_2^2
        \quad\text{or}\quad
        L = \frac1N \sum_i \lVert \delta_i(V) - \delta_i(\bar V) \rVert_2^2

    Without a reference it smooths: each vertex is drawn to the mean of its neighbours. With one it keeps detail: each
    vertex should lie to its neighbours as in the reference. Both are invariant to translation, neither to rotation.

    Args:
        verts: V, ``(B, N, 3)``.
        faces: ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1.
        reference: :math:`\bar V`, ``(B, N, 3)``, or None.
        weights: ``"uniform"``, w = 1: depends on how the surface is meshed and moves vertices within it too. Or
            ``"cotangent"``, :math:`w_{ij} = \max(0, (\cot\alpha_{ij} + \cot\beta_{ij})/2)`: nearly normal to the
            surface on any meshing. They are those of the reference, as constants, if there is one, else those of
            ``verts``, and then the gradient passes through them.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real. Edges and faces that touch a padded vertex are
            left out.
        reduction: ``"mean"`` over each sample's vertices, then over samples; ``"sum"`` over the vertices, then the mean
            over samples; ``"none"`` for the mean of each sample, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``, in squared units of length; at least float32. A vertex without neighbours, or whose
        weights are all 0, has :math:`\delta_i = 0` and counts in the mean.

    Raises:
        ValueError: if shapes, dtypes or face indices do not fit, or an option is unknown.

    Reference:
        Sorkine, "Laplacian Mesh Processing", section 2; Desbrun et al., "Implicit Fairing of Irregular Meshes using
        Diffusion and Curvature Flow", section 5.

    Deviations:
        The clamp at 0 is ours: sums of negative weights (at obtuse angles) may vanish, and the quotient with them.

    Example:
        >>> tent = torch.tensor([[[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0]]])
        >>> faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
        >>> laplacian_loss(tent, faces) > laplacian_loss(tent * torch.tensor([1, 1, 0.1]), faces)
        tensor(True)
        >>> laplacian_loss(tent + 3, faces, reference=tent)
        tensor(0.)
    """
    check_reduction(reduction)
    _check_weights(weights)
    check_verts(verts)
    if reference is not None:
        check_verts(reference, name="reference")
        check_same_shape(verts, reference, "verts and reference")
    batch, num = verts.shape[:2]
    check_mask(mask, batch, num)
    mesh = connectivity(verts, faces)
    shape = at_least_float32(verts if reference is None else reference.detach())
    # Under one set of weights delta is linear: the change of delta is the delta of the displacement.
    field = mesh.rows(at_least_float32(verts) if reference is None else at_least_float32(verts) - reference)
    tail, head = mesh.edges
    difference = field.index_select(0, tail) - field.index_select(0, head)
    weight = difference.new_ones(len(tail), 1)
    if weights == "cotangent":
        weight = _cotangent(mesh, shape, mask)
    if mask is not None:
        real = mesh.real(mask, mesh.edges)
        difference, weight = torch.where(real[:, None], difference, 0), weight * real
    pull = weight[:, None] * difference
    total = torch.zeros_like(field).index_add(0, tail, pull).index_add(0, head, -pull)
    degree = weight.new_zeros(len(field), weight.shape[1]).index_add(0, tail, weight).index_add(0, head, weight)
    delta = torch.where(degree > 0, 1 / torch.where(degree > 0, degree, 1), 0)[:, None] * total
    squared = delta.square().sum(1)
    per_sample = squared.sum(0) if mesh.batch is None else squared.view(batch, num).sum(1)
    return reduce_samples(per_sample, num if mask is None else mask.sum(1), reduction)


def _cotangent(mesh: Connectivity, verts: Tensor, mask: Tensor | None) -> Tensor:
    """Clamped cotangent weights of the edges, ``(E, L)``."""
    if mask is not None:  # no NaN of the padding may reach the quotients, whose gradients it would poison
        verts = torch.where(mask[..., None], verts, 0)
    half = cotangent_weights(mesh.lanes(verts), mesh.faces)
    if mask is not None:
        half = half * mesh.real(mask, mesh.faces.T).T[..., None]
    sides = half.flatten(1).T.index_select(0, mesh.corners)
    return sides.new_zeros(mesh.edges.shape[1], sides.shape[1]).index_add(0, mesh.corner_edges, sides).clamp_min(0)


def _check_weights(weights: str) -> None:
    if weights not in get_args(Weights):
        raise ValueError(f"weights must be one of {get_args(Weights)}, got {weights!r}")


class LaplacianLoss(nn.Module):
    """Module form of :func:`laplacian_loss`.

    Args:
        weights: ``"uniform"`` or ``"cotangent"``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if an option is unknown.

    Example:
        >>> flat = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> LaplacianLoss()(flat, torch.tensor([[0, 1, 2]])).item()
        1.0
    """

    def __init__(self, *, weights: Weights = "uniform", reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction)
        _check_weights(weights)
        self.weights: Weights = weights
        self.reduction: Reduction = reduction

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "weights", "reduction")

    def forward(
        self, verts: Tensor, faces: Tensor, *, reference: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Return the loss, see :func:`laplacian_loss`."""
        return laplacian_loss(
            verts, faces, reference=reference, weights=self.weights, mask=mask, reduction=self.reduction
        )
