"""Sparse matrices as tensors, and the linear maps they stand for."""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["csr", "csr_of_scipy", "linear"]


def csr(rows: Tensor, cols: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Sparse matrix of entries sorted by row, then column."""
    return _csr(torch.searchsorted(rows, torch.arange(shape[0] + 1, device=rows.device)), cols, values, shape)


def csr_of_scipy(matrix: Any, factor: float = 1.0) -> Tensor:
    """A scipy CSR matrix times a number."""
    indptr, indices = torch.from_numpy(matrix.indptr), torch.from_numpy(matrix.indices)
    return _csr(indptr, indices, torch.from_numpy(matrix.data * factor), matrix.shape)


def _csr(indptr: Tensor, indices: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
        place = values.device
        return torch.sparse_csr_tensor(indptr, indices, values, size=shape, device=place, check_invariants=False)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.adjoint = adjoint
        return apply(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return ctx.adjoint(grad.contiguous()), None, None


def linear(x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
    """Apply a linear map given together with its adjoint: a factor, or a matrix and its transpose."""
    if not (x.requires_grad and torch.is_grad_enabled()):
        return apply(x)
    result: Tensor = _Linear.apply(x, apply, adjoint)
    return result
