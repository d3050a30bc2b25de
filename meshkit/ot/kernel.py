"""The Gibbs kernel as a node of the autograd graph that never holds an N x M gradient.

Several operations may use one kernel: the Sinkhorn iterations, a warp, a loss. Each contributes ``K * (A @ B.T)`` to
the gradient of the logits, with few columns in A and B. They hand these factors in, and when autograd reaches the
kernel, after all of them, one sweep contracts their sum with the features.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from meshkit._numerics import full_precision
from meshkit.ot.tiles import Factors, Reference, Tiles

__all__: list[str] = []  # internal: meshkit.ot lists what is public

NO_SECOND_DERIVATIVE = (
    "sinkhorn has no second derivatives: its gradient is computed without a graph of its own. Leave out create_graph, "
    "or differentiate a dense plan written with torch operations"
)


class Ledger:
    """Factors handed in by the users of one kernel, until its gradient is computed."""

    def __init__(self, tiles: Tiles) -> None:
        self.tiles = tiles
        self._pages: dict[int, tuple[Factors, ...]] = {}

    def hand_in(self, user: Any, *factors: Factors) -> Tensor | None:
        """Keep the factors of one user's backward pass; returns its gradient for the kernel's token, a count.

        A page replaces the one that the same user left in a pass which did not ask for the kernel's gradient.
        """
        if not user.needs_input_grad[0]:
            return None
        self._pages.pop(id(user), None)
        self._pages[id(user)] = factors
        return factors[0].left.new_ones(())

    def collect(self, count: Tensor) -> list[Factors]:
        """The factors of this backward pass. Earlier pages stem from passes that did not ask for this gradient.

        While a CUDA graph is captured the count cannot be read; there, one whole backward pass is all there is.
        """
        pages, self._pages = list(self._pages.values()), {}
        if not (count.is_cuda and torch.cuda.is_current_stream_capturing()):
            pages = pages[len(pages) - round(count.item()) :]
        return [factors for page in pages for factors in page]


class GibbsKernel:
    """Differentiable products with the kernel of one sample.

    Args:
        tiles: the kernel.
        inputs: the tensors that the logits are computed from, with their graph, in the order of ``tiles.pullback``.
    """

    def __init__(self, tiles: Tiles, *inputs: Tensor) -> None:
        self.tiles, self.inputs = tiles, inputs
        self.ledger = Ledger(tiles)
        self.token: Tensor = _Token.apply(self.ledger, *inputs)

    def apply(self, columns: Tensor, reference: Reference | None = None, *, transpose: bool = False) -> Tensor:
        """``K @ columns``, or ``K.T @ columns``, for the kernel under a constant reference."""
        return _Product.apply(self.token, columns, self.ledger, reference, transpose)


class _Token(torch.autograd.Function):
    """A scalar that stands for the kernel in the graph; its gradient counts the users that handed in factors."""

    @staticmethod
    def forward(ctx: Any, ledger: Ledger, *inputs: Tensor) -> Tensor:
        ctx.ledger = ledger
        return inputs[0].new_zeros(())

    @staticmethod
    @full_precision
    def backward(ctx: Any, count: Tensor) -> tuple[Any, ...]:
        refuse_second_derivative()
        return None, *ctx.ledger.tiles.pullback(ctx.ledger.collect(count))


class _Product(torch.autograd.Function):
    """O = K V: the gradient of V is Kᵀ dO, that of the logits K ∘ (dO Vᵀ)."""

    @staticmethod
    @full_precision
    def forward(
        ctx: Any, token: Tensor, columns: Tensor, ledger: Ledger, reference: Reference | None, transpose: bool
    ) -> Tensor:
        ctx.save_for_backward(columns)
        ctx.ledger, ctx.reference, ctx.transpose = ledger, reference, transpose
        multiply = ledger.tiles.apply_transpose if transpose else ledger.tiles.apply
        return multiply(columns, reference)

    @staticmethod
    @full_precision
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        refuse_second_derivative()
        (columns,) = ctx.saved_tensors
        tiles, grad_columns = ctx.ledger.tiles, None
        if ctx.needs_input_grad[1]:
            multiply = tiles.apply if ctx.transpose else tiles.apply_transpose
            grad_columns = multiply(gradient, ctx.reference)
        left, right = (columns, gradient) if ctx.transpose else (gradient, columns)
        token = ctx.ledger.hand_in(ctx, Factors(left, right, ctx.reference))
        return token, grad_columns, None, None, None


def refuse_second_derivative() -> None:
    """Silence would be a wrong second derivative."""
    if torch.is_grad_enabled():
        raise RuntimeError(NO_SECOND_DERIVATIVE)
