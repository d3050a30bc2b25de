"""Rigid moving least squares: bend a shape so that it follows scattered targets, keeping its local form."""

import torch
from torch import Tensor

from meshkit.deform.neighbourhoods import centred, check_target, local_rotations, neighbour_weights

__all__ = ["rigid_moving_least_squares"]


def rigid_moving_least_squares(
    rest: Tensor, target: Tensor, *, radius: float, mask: Tensor | None = None, features: Tensor | None = None
) -> Tensor:
    r"""Move each vertex by a blend of the rigid motions that best carry the neighbourhoods around it to the target.

    .. math:: R_i = \operatorname*{arg\,max}_{R \in SO(3)} \sum_j q_{ij}\,
              (t_j - \bar t_i) \cdot R (v_j - \bar v_i), \qquad
              \hat v_j = \frac{\sum_i q_{ij} \bigl(\bar t_i + R_i (v_j - \bar v_i)\bigr)}{\sum_i q_{ij}}

    with :math:`q_{ij} = \max(0, 1 - \lVert v_i - v_j \rVert^2 / r^2)^2` and means :math:`\bar v_i, \bar t_i` weighted
    by :math:`q_{ij}`. What a neighbourhood leaves undetermined, such as the turn of a limb about its own axis, follows
    the rotation of the whole shape. A target that blurs the shape, such as the barycentric image under a soft matching,
    gives good positions and directions on the scale of the radius and none below it; there the rest shape fills in. A
    rigid motion of ``rest`` is reproduced exactly.

    Args:
        rest: ``(B, N, 3)`` shape whose local form is kept.
        target: ``(B, N, 3)`` where its vertices should go; differentiable.
        radius: :math:`r`, in the unit of ``rest``. A vertex with nobody in reach goes to its target.
        mask: ``(B, N)`` bool, True = real vertex; padded rows come out as 0.
        features: ``(B, N, D)``. If given, the weights are multiplied by :math:`\exp(-\lVert f_i - f_j \rVert^2 / D)`,
            so that parts that merely pass close to each other (a hand at a hip) do not move together. Standardised
            descriptors fit.

    Returns:
        ``(B, N, 3)``. Weights are constants: the gradient to ``rest`` and ``features`` through them is left out. A
        sample is NaN throughout if a number at one of its real vertices is not finite; the others are as they were.

    Raises:
        ValueError: shapes differ or the radius is not positive.

    Reference:
        Schaefer, McPhail and Warren, "Image deformation using moving least squares", 2006, in three dimensions and
        with the blend of Sumner, Schmid and Pauly, "Embedded deformation", 2007. Not part of the X-DualNet paper.

    Deviations:
        Stores N x N weights per sample.

    Example:
        >>> rest = torch.randn(1, 50, 3)
        >>> turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        >>> moved = rigid_moving_least_squares(rest, rest @ turn.mT + 2, radius=10.0)
        >>> torch.allclose(moved, rest @ turn.mT + 2, atol=1e-4)
        True
    """
    check_target(rest, target, radius, features)
    with torch.autocast(rest.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(rest.dtype, target.dtype), torch.float32)
        v, t, middle = centred(rest.to(dtype), target.to(dtype), mask)
        q = neighbour_weights(v.detach(), radius, mask, features)
        rotation, mean_v, mean_t = local_rotations(v, t, q, mask)
        shift = mean_t - (rotation @ mean_v[..., None])[..., 0]
        motion = q.mT @ torch.cat([rotation.flatten(2), shift], 2) / q.sum(1)[..., None]
        moved = (motion[..., :9].unflatten(2, (3, 3)) @ v[..., None])[..., 0] + motion[..., 9:] + middle
    return moved.to(target.dtype) if mask is None else moved.to(target.dtype).masked_fill(~mask[..., None], 0.0)
