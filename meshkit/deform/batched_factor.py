"""The linear solves of a batch on one device: a dense factor, or conjugate gradients."""

from collections.abc import Callable

import torch
from torch import Tensor

from meshkit.deform.batched_rest import BatchedRest
from meshkit.deform.conjugate_gradients import column_solver
from meshkit.deform.sparse import csr

__all__ = ["BatchedFactor"]

_DENSE_VERTICES, _DENSE_BYTES = 8192, 8 * 2**30


class BatchedFactor:
    """Stiffness of a batch with some vertices fixed, and its inverse on the others.

    Args:
        rest: of the batch.
        free: (B, V) bool, the vertices to solve for.
        soft: (B, V) weights over m, or None.
        solver: "dense": the inverse of a Cholesky factor per mesh, 24 B V^2 bytes at the peak and two batched products
            per solve; "pcg": conjugate gradients, memory O(B V); "auto": dense up to 8192 vertices and 8 GiB.
    """

    def __init__(self, rest: BatchedRest, free: Tensor, soft: Tensor | None, solver: str) -> None:
        batch, size = free.shape
        self.rest, self.free = rest, free.view(-1, 1)
        self.soft = None if soft is None else soft.view(-1, 1)
        rows, cols, values = rest.rows, rest.cols, rest.values
        if self.soft is not None:
            values = values + torch.where(rows == cols, self.soft[rows, 0], 0.0)
        self.stiffness = csr(rows, cols, values, (batch * size,) * 2)
        if solver == "auto":
            fits = size <= _DENSE_VERTICES and 24 * batch * size**2 <= _DENSE_BYTES
            solver = "dense" if fits else "pcg"
        values = torch.where(self.free[rows, 0] & self.free[cols, 0], values, 0.0)
        make = _dense if solver == "dense" else _conjugate_gradients
        self.solve: Callable[[Tensor], Tensor] = make(rows, cols, values, free)


def _dense(rows: Tensor, cols: Tensor, values: Tensor, free: Tensor) -> Callable[[Tensor], Tensor]:
    batch, size = free.shape
    matrix = values.new_zeros(batch, size, size)
    matrix.view(-1)[rows * size + cols % size] = values
    matrix.diagonal(dim1=1, dim2=2).add_(~free)
    lower = torch.linalg.cholesky_ex(matrix).L
    identity = torch.eye(size, dtype=values.dtype, device=values.device)
    # One product with the inverse of the factor replaces a substitution, which a GPU does row after row.
    inverse = torch.linalg.solve_triangular(lower, identity.expand_as(lower), upper=False)

    def solve(right: Tensor) -> Tensor:
        right = torch.where(free[..., None], right.view(batch, size, 3), 0.0)
        return (inverse.mT @ (inverse @ right)).view(-1, 3)

    return solve


def _conjugate_gradients(rows: Tensor, cols: Tensor, values: Tensor, free: Tensor) -> Callable[[Tensor], Tensor]:
    """Preconditioned by the diagonal."""
    batch, count = len(free), free.numel()
    diagonal = values.new_zeros(count).index_add_(0, rows, values * (rows == cols))
    inverse = torch.where(free.flatten() & (diagonal > 0), 1 / diagonal, 0.0)[:, None]
    return column_solver(csr(rows, cols, values, (count, count)), inverse, batch=batch)
