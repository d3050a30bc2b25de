"""Instance statistics over the real vertices of a batch."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["instance_statistics"]


def instance_statistics(
    x: Tensor, *, mask: Tensor | None = None, unbiased: bool = False, eps: float = 1e-5
) -> tuple[Tensor, Tensor]:
    r"""Mean and standard deviation over the vertices of each sample and channel.

    .. math:: \mu = \frac1N \sum_n x_n, \qquad \sigma = \sqrt{\frac{1}{N - u} \sum_n (x_n - \mu)^2 + \epsilon}

    with :math:`u = 1` when ``unbiased``. The sum is of centred squares, so nothing is lost to cancellation.

    Args:
        x: ``(B, N, C)``.
        mask: ``(B, N)`` bool, True = real vertex.
        unbiased: divide by N - 1 (at least 1, so that a single vertex has deviation :math:`\sqrt\epsilon`).
        eps: added to the variance.

    Returns:
        ``mean`` and ``std``, each ``(B, 1, C)``, in float32 or better.

    Reference:
        X-DualNet, "Elastic instance normalization", Equation of sigma (biased variance, eps 1e-5).

    Deviations:
        The released code takes the unbiased variance.

    Example:
        >>> mean, std = instance_statistics(torch.tensor([[[1.0], [3.0]]]), eps=0.0)
        >>> mean.item(), std.item()
        (2.0, 1.0)
    """
    if x.dim() != 3 or x.shape[1] == 0:
        raise ValueError(f"x must have shape (B, N, C) with at least one vertex, got {tuple(x.shape)}")
    if mask is not None and mask.shape != x.shape[:2]:
        raise ValueError(f"mask must have shape {tuple(x.shape[:2])}, got {tuple(mask.shape)}")
    x = x.to(torch.promote_types(x.dtype, torch.float32))
    if mask is None:
        count = x.new_full((1, 1, 1), float(x.shape[1]))
        mean = x.mean(1, keepdim=True)
        centred = x - mean
    else:
        count = mask.sum(1).clamp_min(1).to(x.dtype)[:, None, None]
        mean = x.masked_fill(~mask[..., None], 0.0).sum(1, keepdim=True) / count
        centred = (x - mean).masked_fill(~mask[..., None], 0.0)
    variance = centred.square().sum(1, keepdim=True) / (count - float(unbiased)).clamp_min(1.0)
    return mean, (variance + eps).sqrt()
