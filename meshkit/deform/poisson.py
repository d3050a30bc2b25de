"""Poisson deformation: bend a shape along scattered targets, its edges turned but not stretched."""

import math

import torch
from torch import Tensor

from meshkit.batching import masked_mean
from meshkit.deform.neighbourhoods import centred, check_target, local_rotations, neighbour_weights

__all__ = ["poisson_deform"]


def poisson_deform(
    rest: Tensor,
    target: Tensor,
    *,
    radius: float,
    weight: float = 0.2,
    mask: Tensor | None = None,
    features: Tensor | None = None,
) -> Tensor:
    r"""Turn the differences between neighbouring vertices as the target turns them, and find positions that have them.

    .. math:: R_i = \operatorname*{arg\,max}_{R \in SO(3)} \sum_j q_{ij}\, (t_j - \bar t_i) \cdot R (v_j - \bar v_i)

    .. math:: \hat x = \operatorname*{arg\,min}_x \sum_{i < j} q_{ij} \Bigl\lVert x_i - x_j -
              \tfrac12 (R_i + R_j)(v_i - v_j) \Bigr\rVert^2 + \lambda \bar d \sum_i \lVert x_i - t_i \rVert^2

    with :math:`q_{ij} = \max(0, 1 - \lVert v_i - v_j \rVert^2 / r^2)^2`, means :math:`\bar v_i, \bar t_i` weighted
    by it, and the mean :math:`\bar d` of :math:`d_i = \sum_{j \ne i} q_{ij}`. The minimum solves one linear system,
    :math:`(D - Q + \lambda \bar d I)\, x = b`.

    :func:`rigid_moving_least_squares` moves every neighbourhood to the middle of its targets, so a limb gets as long as
    they lie apart, and shrinks where they are blurred. Here they say above all how things are turned, and lengths add
    up along the shape: a limb keeps that of ``rest``, the more so the smaller the weight. A rigid motion of ``rest`` is
    reproduced exactly.

    Args:
        rest: ``(B, N, 3)`` shape whose local form is kept.
        target: ``(B, N, 3)`` where its vertices should go; differentiable.
        radius: :math:`r`, in the unit of ``rest``. A vertex with nobody in reach goes to its target.
        weight: :math:`\lambda`, of the targets' positions. In float32 take 1e-4 or more: the system's condition grows
            as its inverse (1000 vertices: some 1 mm off at 1e-5, 1 cm at 1e-6).
        mask: ``(B, N)`` bool, True = real vertex; padded rows come out as 0.
        features: ``(B, N, D)``. If given, the weights are multiplied by :math:`\exp(-\lVert f_i - f_j \rVert^2 / D)`,
            so that parts that merely pass close to each other (a hand at a hip) do not move together. Standardised
            descriptors fit.

    Returns:
        ``(B, N, 3)``. Weights are constants: the gradient to ``rest`` and ``features`` through them is left out. A
        sample is NaN throughout if a number at one of its real vertices is not finite; the others are as they were.

    Raises:
        ValueError: shapes differ, or the radius or weight is not positive.

    Reference:
        Yu et al., "Mesh editing with Poisson-based gradient field manipulation", 2004, on the graph of neighbours in
        place of the mesh, with the edges of Sorkine and Alexa, "As-rigid-as-possible surface modeling", 2007. Not part
        of the X-DualNet paper.

    Deviations:
        Stores N x N matrices per sample and factors one: some 20 ms of one core for 1000 vertices, cubic in them.

    Example:
        >>> rest = torch.randn(1, 50, 3)
        >>> turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        >>> moved = poisson_deform(rest, rest @ turn.mT + 2, radius=10.0)
        >>> torch.allclose(moved, rest @ turn.mT + 2, atol=1e-4)
        True
    """
    check_target(rest, target, radius, features)
    if not 0 < weight < math.inf:
        raise ValueError(f"weight must be positive and finite, got {weight}")
    with torch.autocast(rest.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(rest.dtype, target.dtype), torch.float32)
        v, t, middle = centred(rest.to(dtype), target.to(dtype), mask)
        q = neighbour_weights(v.detach(), radius, mask, features)
        R, _, _ = local_rotations(v, t, q, mask)
        q = q - torch.diag_embed(q.diagonal(dim1=1, dim2=2))
        degree = q.sum(2, keepdim=True)
        hold = weight * masked_mean(degree, mask)[:, None].clamp_min(torch.finfo(dtype).eps)
        # The four sums of sum_j q_ij (R_i + R_j)(v_i - v_j) take one product with the weights.
        turned = _apply(R, v)
        sum_v, sum_R, sum_turned = (q @ torch.cat([v, R.flatten(2), turned], 2)).split([3, 9, 3], 2)
        b = degree * turned - _apply(R, sum_v) + _apply(sum_R.unflatten(2, (3, 3)), v) - sum_turned
        system = torch.diag_embed((degree + hold)[..., 0]) - q
        moved = torch.cholesky_solve(b / 2 + hold * t, torch.linalg.cholesky_ex(system)[0]) + middle
    return moved.to(target.dtype) if mask is None else moved.to(target.dtype).masked_fill(~mask[..., None], 0.0)


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[..., None])[..., 0]
