"""What the losses share: one meaning of `reduction`, one precision."""

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from meshkit._repr import settings

Reduction = Literal["mean", "sum", "none"]


def check_reduction(reduction: str) -> None:
    if reduction not in get_args(Reduction):
        raise ValueError(f"reduction must be one of {get_args(Reduction)}, got {reduction!r}")


def check_same_shape(first: Tensor, second: Tensor, names: str) -> None:
    if first.shape != second.shape:
        raise ValueError(f"{names} must have the same shape, got {tuple(first.shape)} and {tuple(second.shape)}")


def at_least_float32(x: Tensor) -> Tensor:
    """Squares and sums of half precision coordinates over- and underflow; so losses are float32 or float64."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def reduce_samples(total: Tensor, count: Tensor | int, reduction: Reduction) -> Tensor:
    """Reduce the sums (B,) over the real elements of each sample, and the numbers of these elements.

    "sum" is the mean over samples of the sums, "mean" the mean over samples of the samples' means, "none" these means.
    A sample without elements counts as 0.
    """
    if reduction == "sum":
        return total.mean()
    mean = total / (count.clamp_min(1) if isinstance(count, Tensor) else max(count, 1))
    return mean.mean() if reduction == "mean" else mean


class ReducedLoss(nn.Module):
    """A loss without any option but the reduction."""

    def __init__(self, *, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction)
        self.reduction: Reduction = reduction

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "reduction")
