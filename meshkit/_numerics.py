"""Small numerics that several components share."""

from __future__ import annotations

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


def launch_bound(x: Tensor) -> bool:
    """Whether an operation costs more to start than to run on a small sample, so that samples are best done together.

    On a CPU it is the other way round: what fits its cache is worth doing by itself.
    """
    return x.device.type != "cpu"
