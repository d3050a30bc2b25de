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
