"""Costs between features, written as inner products."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from meshkit.ot.kernel import refuse_second_derivative
from meshkit.ot.tiles import LOG2_E

__all__: list[str] = []  # internal: meshkit.ot lists what is public


def logit_features(
    x: Tensor, y: Tensor, cost: str, eps: float | Tensor, *, constant: bool
) -> tuple[Tensor, Tensor, float, float]:
    """Features whose inner products are the base-2 logits, a bound on the logits' spread (nats), and the cost shift.

    The cost is ``shift`` minus eps times the logit. A shift changes nothing in balanced transport; with ``constant`` it
    is 0, for unbalanced transport.
    """
    rate, value = logits_per_cost(eps, x.dtype), number(eps)
    if cost == "dot":
        bound = 2 * float(norms(x).amax() * norms(y).amax()) if len(x) else 0.0
        return x * rate, y.clone(), bound / value, 0.0  # of its own: the caller may change y in place later
    if cost == "cosine":
        x, y = unit(x), unit(y)
        if not constant:
            # The smaller side is scaled, since that takes a copy.
            x, y = (x, y * rate) if x.shape[-2] > y.shape[-2] else (x * rate, y)
            return x, y, 2 / value, 1.0
        x = torch.cat([x, -torch.ones_like(x[:, :1])], 1) * rate
        return x, torch.cat([y, y.new_ones(len(y), 1)], 1), 2 / value, 0.0
    # |x - y|² = |x|² + |y|² - 2 x·y as one inner product; centred, so that less cancels.
    if len(x):
        centre = torch.cat([x, y]).detach().mean(0)
        x, y = x - centre, y - centre
    spread = float((norms(x).amax() + norms(y).amax()).square()) / value if len(x) else 0.0
    squared_x, squared_y = x.square().sum(1, keepdim=True), y.square().sum(1, keepdim=True)
    x = torch.cat([2 * x, -squared_x, -torch.ones_like(squared_x)], 1) * rate
    return x, torch.cat([y, torch.ones_like(squared_y), squared_y], 1), spread, 0.0


def number(eps: float | Tensor) -> float:
    """Its value, a constant."""
    return float(eps.detach() if isinstance(eps, Tensor) else eps)


def logits_per_cost(eps: float | Tensor, dtype: torch.dtype) -> float | Tensor:
    """The factor from costs to base-2 logits, in the precision of these, whatever that of eps."""
    return LOG2_E / (eps.to(dtype) if isinstance(eps, Tensor) else eps)


def norms(x: Tensor) -> Tensor:
    """Length of each row, a constant."""
    return x.detach().square().sum(1).sqrt()


def unit(x: Tensor) -> Tensor:
    """Rows of unit norm; zero rows stay zero, with zero gradient."""
    return _Unit.apply(x)


class _Unit(torch.autograd.Function):
    """y = x / |x|, dx = (dy - y (y·dy)) / |x|: nothing of the size of x is kept besides y."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        # Divided by its largest entry first, a row's norm neither over- nor underflows.
        largest = x.abs().amax(-1, keepdim=True)
        alive = largest > 0
        largest = torch.where(alive, largest, 1.0)
        y = x / largest
        inverse = torch.where(alive, y.square().sum(-1, keepdim=True).rsqrt(), 0.0)
        y *= inverse
        ctx.save_for_backward(y, inverse / largest)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        refuse_second_derivative()
        y, inverse = ctx.saved_tensors
        along = (gradient * y).sum(-1, keepdim=True)
        return torch.addcmul(gradient, y, along, value=-1).mul_(inverse)
