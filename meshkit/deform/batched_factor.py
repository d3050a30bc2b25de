"""The linear solves of a batch on one device: a dense factor, or conjugate gradients."""

from collections.abc import Callable

import torch
from torch import Tensor

from meshkit.deform.batched import BatchedEnergy, csr

__all__ = ["BatchedFactor"]

_DENSE_VERTICES, _DENSE_BYTES = 8192, 8 * 2**30
_LOOK = 16  # iterations between two looks at the residual, each of which waits for the device


class BatchedFactor:
    """Stiffness of a batch with some vertices fixed, and its inverse on the others.

    Args:
        energy: of the batch.
        free: (B, V) bool, the vertices to solve for.
        soft: (B, V) weights over m, or None.
        solver: "dense": the inverse of a Cholesky factor per mesh, 24 B V^2 bytes at the peak and two batched products
            per solve; "pcg": conjugate gradients, memory O(B V); "auto": dense up to 8192 vertices and 8 GiB.
    """

    def __init__(self, energy: BatchedEnergy, free: Tensor, soft: Tensor | None, solver: str) -> None:
        batch, size = free.shape
        self.energy, self.free, self.soft = energy, free.view(-1, 1), soft
        values = energy.values
        if soft is not None:
            diagonal = energy.rows == energy.cols
            values = values + torch.where(diagonal, soft.flatten()[energy.rows], 0.0)
        self.stiffness = csr(energy.rows, energy.cols, values, (batch * size,) * 2)
        if solver == "auto":
            fits = size <= _DENSE_VERTICES and 24 * batch * size**2 <= _DENSE_BYTES
            solver = "dense" if fits else "pcg"
        inside = self.free[energy.rows, 0] & self.free[energy.cols, 0]
        values = torch.where(inside, values, 0.0)
        make = _dense if solver == "dense" else _conjugate_gradients
        self.solve: Callable[[Tensor], Tensor] = make(energy, values, self.free, batch, size)


def _dense(energy: BatchedEnergy, values: Tensor, free: Tensor, batch: int, size: int) -> Callable[[Tensor], Tensor]:
    matrix = values.new_zeros(batch, size, size)
    matrix.view(-1)[energy.rows * size + energy.cols % size] = values
    matrix.diagonal(dim1=1, dim2=2).add_((~free).view(batch, size))
    lower = torch.linalg.cholesky_ex(matrix).L
    identity = torch.eye(size, dtype=values.dtype, device=values.device)
    # One product with the inverse of the factor replaces a substitution, which a GPU does row after row.
    inverse = torch.linalg.solve_triangular(lower, identity.expand_as(lower), upper=False)

    def solve(right: Tensor) -> Tensor:
        return (inverse.mT @ (inverse @ right.view(batch, size, 3))).view(-1, 3)

    return solve


def _conjugate_gradients(
    energy: BatchedEnergy, values: Tensor, free: Tensor, batch: int, size: int
) -> Callable[[Tensor], Tensor]:
    """Preconditioned by the diagonal, each column with its own step, to 1e-10 of the right-hand side."""
    matrix = csr(energy.rows, energy.cols, values, (batch * size,) * 2)
    diagonal = values.new_zeros(batch * size).index_add_(0, energy.rows, values * (energy.rows == energy.cols))
    inverse = torch.where(free[:, 0] & (diagonal > 0), 1 / diagonal, 0.0)[:, None]
    tiny = torch.finfo(values.dtype).tiny

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).view(batch, size, 3).sum(1, keepdim=True)

    def scaled(share: Tensor, vectors: Tensor) -> Tensor:
        return (share * vectors.view(batch, size, 3)).view(-1, 3)

    def solve(right: Tensor) -> Tensor:
        x, r = torch.zeros_like(right), right.clone()
        direction = inverse * r
        square = dot(r, direction)
        goal = 1e-20 * square
        for iteration in range(10 * size):
            if iteration % _LOOK == 0 and bool((square <= goal).all()):
                break
            image = matrix @ direction
            step = square / dot(direction, image).clamp_min(tiny)
            x = x + scaled(step, direction)
            r = r - scaled(step, image)
            z = inverse * r
            before, square = square, dot(r, z)
            direction = z + scaled(square / before.clamp_min(tiny), direction)
        return x

    return solve
