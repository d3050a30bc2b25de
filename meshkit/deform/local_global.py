"""The alternation of local and global steps, recorded for autograd if wanted."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.factor import ARAPFactor
from meshkit.deform.rotation import ClosestRotation

__all__ = ["alternate"]


class LinearMap(torch.autograd.Function):
    """A linear map on (N, D) CPU tensors, given as a numpy callable together with its adjoint."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, apply: Callable[[Any], Any], adjoint: Callable[[Any], Any]) -> Tensor:
        """Apply the map."""
        ctx.adjoint = adjoint
        return torch.from_numpy(apply(x.detach().numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """Apply the adjoint."""
        return torch.from_numpy(ctx.adjoint(grad.numpy())), None, None


def alternate(
    factor: ARAPFactor,
    targets: Tensor,
    pull: Tensor | None,
    start: Tensor | None,
    *,
    constant: float,
    max_iter: int,
    tol: float,
    dtype: torch.dtype,
) -> tuple[Tensor, int]:
    """Positions after local-global iterations, and how many.

    Args:
        factor: of the free vertices.
        targets: (H, 3) handle positions; differentiable, as is `pull`.
        pull: (V, 3) soft weights (over m) times soft targets.
        start: (V, 3) positions whose rotations to start from, or None for the identity.
        constant: what the energy over m holds beside its terms in x.
        max_iter: number of iterations.
        tol: stop when an iteration lowered the energy by at most this share, from the second one on; 0 for never.
        dtype: of the rotations.
    """
    rest, solve = factor.rest, factor.solve
    cells = rest.topology.num_cells
    place = torch.argsort(torch.cat([factor.free, factor.handles]))
    coupling = factor.coupling
    pulled = LinearMap.apply(targets, coupling.__matmul__, coupling.T.__matmul__)
    quaternions = torch.eye(4, 1, dtype=dtype, device="cpu").repeat(1, cells)
    rotations = torch.eye(3, dtype=dtype, device="cpu")[:, :, None].expand(3, 3, cells)
    x = torch.cat([targets.new_zeros(len(factor.free), 3), targets])[place] if start is None else start
    if start is not None:
        x = x.index_copy(0, factor.handles, targets)
    iteration = 0
    while iteration < max_iter:
        if iteration or start is not None:
            stacked = LinearMap.apply(x, rest.moments.__matmul__, rest.moments_t.__matmul__)
            S = stacked.view(-1, 3, 3).permute(2, 1, 0).to(dtype).contiguous()
            rotations, quaternions = ClosestRotation.apply(S, quaternions)
        stacked = rotations.permute(2, 1, 0).reshape(-1, 3).double()
        force = LinearMap.apply(stacked, rest.moments_t.__matmul__, rest.moments.__matmul__)
        force = force if pull is None else force + pull
        right = force.index_select(0, factor.free) - pulled
        moved = torch.cat([LinearMap.apply(right, solve, solve), targets]).index_select(0, place)
        x, before = moved, x.detach()
        iteration += 1
        if tol > 0 and (iteration > 1 or start is not None):
            ended, step = x.detach(), x.detach() - before
            image, drop = (torch.from_numpy(factor.stiffness @ value.numpy()) for value in (ended, step))
            bound = float((ended * (image - 2 * force.detach())).sum()) + constant
            if float((step * drop).sum()) <= tol * max(bound, 1e-10 * constant):
                break
    return x, iteration
