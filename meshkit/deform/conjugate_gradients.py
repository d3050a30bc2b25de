"""Conjugate gradients: for one system, whose end the host sees at once, and for several, each with its own steps.

They are here twice for the reason that L-BFGS is: see the module ``lbfgs``.
"""

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["conjugate_gradients", "conjugate_gradients_batch"]

Map = Callable[[Tensor], Tensor]
Product = Callable[[Tensor, Tensor], Tensor]


def conjugate_gradients(
    product: Map, precondition: Map, right: Tensor, *, dot: Product, tol: float, max_iter: int
) -> tuple[Tensor, bool]:
    """Solve A x = b, and tell whether a direction p with p^T A p <= 0 ended it.

    Args:
        product: A, symmetric.
        precondition: symmetric positive, but for rows that it ignores and gives 0; makes a new tensor.
        right: (N, D) right-hand side b; what the preconditioner gives 0 is not solved for.
        dot: inner product of vectors (N, D).
        tol: relative accuracy, in the norm of the preconditioner.
        max_iter: iterations at most.
    """
    solution, residual = torch.zeros_like(right), right.clone()
    direction = precondition(residual)
    square = first = float(dot(residual, direction))
    for iteration in range(max_iter):
        if not square > tol * tol * first:  # also where it is NaN
            break
        image = product(direction)
        curvature = float(dot(direction, image))
        if curvature <= 0:  # the preconditioner's step is better than none
            return (solution if iteration else direction), True
        step = square / curvature
        solution.add_(direction, alpha=step)
        residual.sub_(image, alpha=step)
        scaled = precondition(residual)
        before, square = square, float(dot(residual, scaled))
        direction = scaled.add_(direction, alpha=square / before)
    return solution, False


def conjugate_gradients_batch(
    product: Map,
    precondition: Map,
    right: Tensor,
    *,
    dot: Product,
    spread: Map,
    tol: float,
    max_iter: int,
    look: int,
) -> tuple[Tensor, Tensor]:
    """Solve several systems at once, and tell which met a direction p with p^T A p <= 0 and ended there.

    Args:
        product, precondition, right, tol, max_iter: see :func:`conjugate_gradients`.
        dot: one number per system from two vectors (N, D).
        spread: of numbers per system what broadcasts with (N, D).
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


def diagonal_solver(matrix: Tensor, inverse: Tensor) -> Map:
    """Solver of sparse A x = b (N, 3) to 1e-10 of b, with the inverse (N, 1) of the diagonal as preconditioner."""

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return torch.dot(a.view(-1), b.view(-1))

    def solve(right: Tensor) -> Tensor:
        return conjugate_gradients(matrix.matmul, inverse.mul, right, dot=dot, tol=1e-10, max_iter=10 * len(right))[0]

    return solve


def column_solver(matrix: Tensor, inverse: Tensor, *, batch: int, look: int = 16) -> Map:
    """Solver of sparse A x = b (N, 3), N over a batch of blocks, to 1e-10 of b; every column takes its own steps.

    Args:
        matrix: (N, N) symmetric and positive on what it is asked for.
        inverse: (N, 1) of the diagonal; 0 where there is nothing to solve for.
        batch: number of blocks of equal size.
        look: see :func:`conjugate_gradients_batch`.
    """
    size = len(matrix) // batch

    def solve(right: Tensor) -> Tensor:
        return conjugate_gradients_batch(
            matrix.matmul,
            inverse.mul,
            right,
            dot=lambda a, b: (a * b).view(batch, size, 3).sum(1),
            spread=lambda values: values.repeat_interleave(size, 0),
            tol=1e-10,
            max_iter=10 * size,
            look=look,
        )[0]

    return solve
