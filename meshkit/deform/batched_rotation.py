"""Closest rotations in a fixed sequence of batched products: for GPUs, without a branch on the data."""

from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.quaternion import horn_matrix

__all__ = ["BatchedRotation", "Differential"]

_SQUARINGS = (8, 8, 8)  # between them the trace is brought back to 1; float64 holds (1/4)^256


class BatchedRotation(torch.autograd.Function):
    r"""S (N, 3, 3) float64 to the closest R, with the gradient of :func:`~meshkit.deform.closest_rotation`.

    R is the unit quaternion that is the largest eigenvector of Horn's matrix K. With a shift that makes K positive,
    its 2^24th power, by repeated squaring, is a multiple of the projector on that eigenvector, or on the space of them
    where several rotations are equally close.
    """

    @staticmethod
    def forward(ctx: Any, S: Tensor) -> Tensor:
        """Project."""
        matrix, shift = _constants(S.device)
        size = torch.linalg.vector_norm(S, dim=(1, 2), keepdim=True).clamp_min(torch.finfo(S.dtype).tiny)
        power = torch.addmm(shift, (S / size).flatten(1), matrix).view(-1, 4, 4)
        for count in _SQUARINGS:
            for _ in range(count):
                power = power @ power
            power = power / power.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        largest = power.diagonal(dim1=1, dim2=2).argmax(1)
        q = power.gather(2, largest[:, None, None].expand(-1, 4, 1)).squeeze(2)
        q = q / torch.linalg.vector_norm(q, dim=1, keepdim=True)
        R = ((q[:, :, None] * q[:, None]).flatten(1) @ matrix.T).view(-1, 3, 3)
        ctx.save_for_backward(S, R)
        return R

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        """Apply the self-adjoint differential."""
        return Differential(*ctx.saved_tensors)(grad)


class Differential:
    """The self-adjoint linear map from a change of S to that of its rotation R; damped where R is ill-determined."""

    def __init__(self, S: Tensor, R: Tensor) -> None:
        tiny, eps = torch.finfo(S.dtype).tiny, torch.finfo(S.dtype).eps
        self.R, self.scale = R, S.abs().amax((1, 2), keepdim=True).clamp_min(tiny)
        self.eye, self.axial = torch.eye(3, dtype=S.dtype, device=S.device), _axial(S.device)
        P = R.mT @ (S / self.scale)
        trace = P.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        M = trace * self.eye - 0.5 * (P + P.mT)
        cofactors, det = _cofactors(M)
        # as in RotationDifferential
        smallest = det / cofactors.diagonal(dim1=1, dim2=2).sum(1)[:, None, None].clamp_min(tiny)
        shift = torch.relu(2 * eps**0.5 * trace - smallest)
        cofactors, det = _cofactors(M + shift * self.eye)
        self.inverse = cofactors / det.clamp_min(tiny)

    def __call__(self, dS: Tensor) -> Tensor:
        """Apply the map to (N, 3, 3)."""
        turn = ((self.R.mT @ dS).flatten(1) @ self.axial)[:, :, None] / self.scale
        omega = (self.inverse @ turn).squeeze(2)
        return self.R @ (omega @ self.axial.T).view(-1, 3, 3)


def _cofactors(M: Tensor) -> tuple[Tensor, Tensor]:
    """Cofactors of symmetric matrices (N, 3, 3), and determinants (N, 1, 1)."""
    cofactors = torch.linalg.cross(M.roll(-1, 1), M.roll(-2, 1), dim=2)
    return cofactors, (M[:, :1] * cofactors[:, :1]).sum(2, keepdim=True)


@cache
@torch.inference_mode(False)
def _constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """The linear map (9, 16) from S to Horn's matrix, and the shift (16,) that makes that positive where |S| = 1."""
    basis = torch.eye(9, dtype=torch.float64, device="cpu").view(3, 3, 9)
    matrix = horn_matrix(basis)[0].reshape(16, 9).T.contiguous()
    # A trace of preference for the identity, for matrices that are zero.
    shift = torch.diag(torch.tensor([3**0.5 + 1e-14, 3**0.5, 3**0.5, 3**0.5], dtype=torch.float64, device="cpu"))
    return matrix.to(device), shift.flatten().to(device)


@cache
@torch.inference_mode(False)
def _axial(device: torch.device) -> Tensor:
    """The map (9, 3) from a matrix to the axial vector of its skew part, times two."""
    axial = torch.zeros(9, 3, dtype=torch.float64, device="cpu")
    for k in range(3):
        i, j = (k + 2) % 3, (k + 1) % 3
        axial[3 * i + j, k], axial[3 * j + i, k] = 1.0, -1.0
    return axial.to(device)
