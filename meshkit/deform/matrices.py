"""Algebra of 3 x 3 matrices stored component first, (3, 3, N).

Each elementwise operation then runs over one long contiguous row, which on a CPU is an order of magnitude faster than
batched 3 x 3 linear algebra.
"""

import torch
from torch import Tensor

__all__ = ["axial", "cofactors_of", "curvature", "symmetric_product", "transposed_product"]


def transposed_product(A: Tensor, B: Tensor) -> Tensor:
    """A^T B of component-first matrices. Not an einsum: autocast would run that in low precision."""
    return (A.unsqueeze(2) * B.unsqueeze(1)).sum(0)


def axial(P: Tensor) -> Tensor:
    """Axial vector (3, N) of P - P^T."""
    return torch.stack([P[2, 1] - P[1, 2], P[0, 2] - P[2, 0], P[1, 0] - P[0, 1]])


def curvature(P: Tensor) -> Tensor:
    """Entries 00, 11, 22, 01, 02, 12 of tr(P) I - sym(P), the negative Hessian of tr(R^T S) on SO(3)."""
    a, b, c = P[0, 0], P[1, 1], P[2, 2]
    off = [P[0, 1] + P[1, 0], P[0, 2] + P[2, 0], P[1, 2] + P[2, 1]]
    return torch.stack([b + c, a + c, a + b, *(-0.5 * entry for entry in off)])


def cofactors_of(M: Tensor) -> tuple[Tensor, Tensor]:
    """Cofactors of symmetric matrices, both as the six entries 00, 11, 22, 01, 02, 12; and their determinants."""
    a, b, c, d, e, f = M
    first, second, third = b * c - f * f, e * f - d * c, d * f - e * b
    cofactors = torch.stack([first, a * c - e * e, a * b - d * d, second, third, d * e - a * f])
    return cofactors, a * first + d * second + e * third


def symmetric_product(M: Tensor, v: Tensor) -> Tensor:
    """M v of symmetric matrices, as six entries, and vectors (3, N)."""
    (a, b, c, d, e, f), (x, y, z) = M, v
    return torch.stack([a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z])
