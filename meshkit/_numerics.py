"""Small numerics that several components share."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor


def safe_sqrt(squared: Tensor) -> Tensor:
    """Square root with the subgradient 0 at 0; NaN stays NaN."""
    if not squared.requires_grad:
        return squared.sqrt()
    zero = squared == 0
    return torch.where(zero, 0, torch.where(zero, 1, squared).sqrt())


def safe_log(x: Tensor) -> Tensor:
    """Logarithm, -inf with the subgradient 0 where there is nothing, at 0 and below; NaN stays NaN."""
    none = x <= 0
    return torch.where(none, 1, x).log().masked_fill(none, -torch.inf)


def full_precision(method: Callable[..., Any]) -> Callable[..., Any]:
    """Run a pass of an autograd function outside autocast: in bfloat16 marginals would be off by half a per cent.

    A backward pass finds autocast on where it is started in the block of the forward pass.
    """

    @wraps(method)
    def run(ctx: Any, first: Tensor, *rest: Any) -> Any:
        with torch.autocast(first.device.type, enabled=False):
            return method(ctx, first, *rest)

    return run


def launch_bound(x: Tensor) -> bool:
    """Whether an operation costs more to start than to run on a small sample, so that samples are best done together.

    On a CPU it is the other way round: what fits its cache is worth doing by itself.
    """
    return x.device.type != "cpu"
