"""Conjugate gradients for several systems at once."""

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["conjugate_gradients"]


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    *,
    dot: Callable[[Tensor, Tensor], Tensor],
    spread: Callable[[Tensor], Tensor],
    tol: float,
    max_iter: int,
    look: int,
) -> tuple[Tensor, Tensor]:
    """Solve A x = b for every system, and tell which met a direction p with p^T A p <= 0 and ended there.

    Args:
        product: A, symmetric.
        precondition: symmetric positive, but for rows that it ignores and gives 0.
        right: (N, D) the right-hand sides b; what the preconditioner gives 0 is not solved for.
        dot: one number per system from two vectors (N, D).
        spread: of numbers per system what broadcasts with (N, D).
        tol: relative accuracy, in the norm of the preconditioner.
        max_iter: iterations at most.
        look: iterations between two looks at what is done, each of which waits for the device.
    """
    solution, residual = torch.zeros_like(right), right
    direction = precondition(residual)
    square = dot(residual, direction)
    goal = tol * tol * square
    negative = torch.zeros_like(square, dtype=torch.bool)
    for iteration in range(max_iter):
        moving = (square > goal) & ~negative
        if iteration % look == 0 and not bool(moving.any()):
            break
        image = product(direction)
        curvature = dot(direction, image)
        bent = moving & (curvature <= 0)
        negative, moving = negative | bent, moving & ~bent
        if iteration == 0:  # the preconditioner's step is better than none
            solution = torch.where(spread(bent), direction, solution)
        step = spread(torch.where(moving, square / curvature, 0.0))
        solution = torch.addcmul(solution, step, direction)
        residual = torch.addcmul(residual, step, image, value=-1)
        scaled = precondition(residual)
        before, square = square, torch.where(moving, dot(residual, scaled), square)
        share = torch.where(moving, square / before, 0.0)
        direction = torch.addcmul(scaled, spread(share), direction)
    return solution, negative


def column_solver(matrix: Tensor, inverse: Tensor, *, batch: int, look: int = 16) -> Callable[[Tensor], Tensor]:
    """Solver of sparse A x = b (N, 3), N over a batch of blocks, to 1e-10 of b; every column takes its own steps.

    Args:
        matrix: (N, N) symmetric and positive on what it is asked for.
        inverse: (N, 1) of the diagonal; 0 where there is nothing to solve for.
        batch: number of blocks of equal size.
        look: see :func:`conjugate_gradients`.
    """
    size = len(matrix) // batch

    def solve(right: Tensor) -> Tensor:
        return conjugate_gradients(
            matrix.matmul,
            inverse.mul,
            right,
            dot=lambda a, b: (a * b).view(batch, size, 3).sum(1),
            spread=lambda values: values if batch == 1 else values.repeat_interleave(size, 0),
            tol=1e-10,
            max_iter=10 * size,
            look=look,
        )[0]

    return solve
