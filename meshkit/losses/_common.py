"""What the losses share: one meaning of `reduction`, one precision, one check of the faces."""

from typing import Literal, get_args

import torch
from torch import Tensor

from meshkit.topology import check_faces

Reduction = Literal["mean", "sum", "none"]


def check_reduction(reduction: str) -> None:
    if reduction not in get_args(Reduction):
        raise ValueError(f"reduction must be one of {get_args(Reduction)}, got {reduction!r}")


def check_faces_match(verts: Tensor, faces: Tensor) -> None:
    check_faces(faces, verts.shape[1], batched=True)
    if faces.ndim == 3 and faces.shape[0] != verts.shape[0]:
        raise ValueError(
            f"faces {tuple(faces.shape)} must have the batch size of verts {tuple(verts.shape)}; pass (F, 3) to share "
            "one face list"
        )


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
    mean = total / (count.clamp_min(1) if isinstance(count, Tensor) else count)
    return mean.mean() if reduction == "mean" else mean
