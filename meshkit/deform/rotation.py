"""The rotation closest to a 3 x 3 matrix, without an SVD in the common case, and with a gradient that stays finite."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit._numerics import launch_bound
from meshkit.deform.batched_rotation import BatchedRotation
from meshkit.deform.matrices import axial, cofactors_of, curvature, symmetric_product, transposed_product
from meshkit.deform.quaternion import project

__all__ = ["closest_rotation"]


def closest_rotation(S: Tensor) -> Tensor:
    r"""Project matrices onto the rotations.

    .. math:: R = \arg\max_{R \in SO(3)} \operatorname{tr}(R^\top S) = \arg\min_{R \in SO(3)} \lVert R - S \rVert_F

    R is the unit quaternion that is the largest eigenvector of Horn's symmetric 4 x 4 matrix, found by Rayleigh
    quotient iteration and certified by the derivatives of the characteristic quartic; the few matrices that fail the
    certificate go through an SVD. On a GPU it comes by repeated squaring instead, in float64, without a branch on the
    data. A matrix of negative determinant gets its closest proper rotation.

    With :math:`P = R^\top S` the gradient solves
    :math:`(\operatorname{tr}(P) I - P)\,\omega = \operatorname{axl}(R^\top dS)`, :math:`dR = R[\omega]_\times`.
    It is exact while the smallest sum of two singular values (the last one signed like det S) is above the square root
    of machine epsilon times their total. Below that R is one of several (nearly) best rotations and the gradient is
    damped to a finite value. It is finite at repeated singular values, where that of an SVD is not. First derivatives
    only.

    Args:
        S: (..., 3, 3) matrices of any scale. float16 and bfloat16 are computed in float32.

    Returns:
        (..., 3, 3) rotations in the dtype of `S`; NaN where `S` is not finite; the identity, with zero gradient, at 0.

    Raises:
        ValueError: `S` is not a floating (..., 3, 3) tensor.

    Reference:
        Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987.

    Example:
        >>> closest_rotation(torch.diag(torch.tensor([3.0, -2.0, -1.0]))).diagonal().tolist()
        [1.0, -1.0, -1.0]
    """
    if not S.is_floating_point() or S.shape[-2:] != (3, 3):
        raise ValueError(f"S must be a floating (..., 3, 3) tensor, got {S.dtype} {tuple(S.shape)}")
    if launch_bound(S):
        return BatchedRotation.apply(S.double().reshape(-1, 3, 3)).reshape(S.shape).to(S.dtype)
    matrices = S.to(torch.promote_types(S.dtype, torch.float32)).reshape(-1, 3, 3).permute(1, 2, 0).contiguous()
    rotations, _ = ClosestRotation.apply(matrices, None)
    return rotations.permute(2, 0, 1).reshape(S.shape).to(S.dtype)


class ClosestRotation(torch.autograd.Function):
    """Component-first core: S (3, 3, N) and a guess (4, N) or None to R (3, 3, N) and its unit quaternions (4, N)."""

    @staticmethod
    def forward(ctx: Any, S: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor]:
        """Project."""
        q, R = project(S, guess)
        ctx.save_for_backward(S, R)
        ctx.mark_non_differentiable(q)
        return R, q

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, None]:
        """Solve the self-adjoint 3 x 3 system for the axial vector of the upstream gradient."""
        return RotationDifferential(*ctx.saved_tensors)(grad), None


class RotationDifferential:
    """The self-adjoint linear map from a change of S to that of its rotation R, component first."""

    def __init__(self, S: Tensor, R: Tensor) -> None:
        tiny, eps = torch.finfo(S.dtype).tiny, torch.finfo(S.dtype).eps
        self.R, self.scale = R, S.abs().amax((0, 1)).clamp_min(tiny)
        M = curvature(transposed_product(R, S / self.scale))
        cofactors, det = cofactors_of(M)
        # 1 / tr(M^-1) is the smallest eigenvalue of M up to a factor of 3: shift only where that is negligible.
        smallest = det / (cofactors[0] + cofactors[1] + cofactors[2]).clamp_min(tiny)
        shift = torch.relu(eps**0.5 * (M[0] + M[1] + M[2]) - smallest)
        cofactors, det = cofactors_of(torch.cat([M[:3] + shift, M[3:]]))
        self.inverse = cofactors / det.clamp_min(tiny)

    def __call__(self, dS: Tensor) -> Tensor:
        """Apply the map to (3, 3, N)."""
        x, y, z = symmetric_product(self.inverse, axial(transposed_product(self.R, dS)) / self.scale).unbind(0)
        a, b, c = self.R.unbind(1)
        return torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], 1)
