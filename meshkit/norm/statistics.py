"""Instance statistics over the real vertices of a batch."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from meshkit._checks import check_features
from meshkit.batching import check_mask, masked_mean
from meshkit.norm._tiles import fill, tile_buffer, tiles, traced

__all__ = ["instance_norm", "instance_statistics"]


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

    Raises:
        ValueError: ``x`` or ``mask`` has another shape or dtype, or there is no vertex.

    Reference:
        X-DualNet, "Elastic instance normalization", Equation of sigma (biased variance, eps 1e-5).

    Deviations:
        The released code takes the unbiased variance.

    Example:
        >>> mean, std = instance_statistics(torch.tensor([[[1.0], [3.0]]]), eps=0.0)
        >>> mean.item(), std.item()
        (2.0, 1.0)
    """
    check_features(x)
    if x.shape[1] == 0:
        raise ValueError(f"x must have shape (B, N, C) with at least one vertex, got {tuple(x.shape)}")
    check_mask(mask, x.shape[0], x.shape[1])
    x = x.to(torch.promote_types(x.dtype, torch.float32))
    mean, variance = _moments(x, mask) if traced() else _Moments.apply(x, mask)
    if unbiased:
        count = _count(x, mask)
        variance = variance * (count / (count - 1).clamp_min(1))
    return mean, (variance + eps).sqrt()


def instance_norm(x: Tensor, *, mask: Tensor | None = None, unbiased: bool = False, eps: float = 1e-5) -> Tensor:
    r"""Normalise each sample and channel over its vertices.

    .. math:: \hat x = (x - \mu) / \sigma

    with the statistics of :func:`instance_statistics`, whose arguments these are.

    Returns:
        ``(B, N, C)`` in the dtype of ``x``; padded rows are 0.

    Example:
        >>> instance_norm(torch.tensor([[[1.0], [3.0]]]), eps=0.0).flatten().tolist()
        [-1.0, 1.0]
    """
    mean, std = instance_statistics(x, mask=mask, unbiased=unbiased, eps=eps)
    x = zero_padding(x, mask)
    return zero_padding(((x - mean) / std).to(x.dtype), mask)


def zero_padding(x: Tensor, mask: Tensor | None) -> Tensor:
    """Zero at padded rows, before arithmetic too: what is not finite there would reach the gradient otherwise."""
    return x if mask is None else x.masked_fill(~mask[..., None], 0.0)


def _count(x: Tensor, mask: Tensor | None) -> Tensor:
    """Number of real vertices, at least 1, ``(B or 1, 1, 1)``."""
    if mask is None:
        return x.new_full((1, 1, 1), x.shape[1])
    return mask.sum(1).clamp_min(1).to(x.dtype)[:, None, None]


def _moments(x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Mean and biased variance: the definition."""
    mean = masked_mean(x, mask)[:, None]
    return mean, masked_mean((x - mean).square(), mask)[:, None]


class _Moments(torch.autograd.Function):
    """:func:`_moments` in tiles: two passes over ``x`` forward and one backward, and no copy of ``x`` in between."""

    @staticmethod
    def forward(x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        mean = masked_mean(x, mask)[:, None]
        squares, work = torch.zeros_like(mean), tile_buffer(x, x.dtype)
        for b, rows in tiles(x):
            centred = torch.sub(x[b, rows], mean[b], out=fill(work, x[b, rows]))
            if mask is not None:
                centred.masked_fill_(~mask[b, rows, None], 0.0)
            squares[b] += centred.square_().sum(-2, keepdim=True)
        return mean, squares / _count(x, mask)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        x, mask = inputs
        ctx.save_for_backward(x, output[0], mask)

    @staticmethod
    def backward(ctx: Any, grad_mean: Tensor, grad_variance: Tensor) -> tuple[Tensor, None]:
        x, mean, mask = ctx.saved_tensors
        if torch.is_grad_enabled():  # of second order: differentiate the definition
            return torch.func.vjp(lambda x: _moments(x, mask), x)[1]((grad_mean, grad_variance))[0], None
        count = _count(x, mask)
        offset, gain = grad_mean / count, 2 * grad_variance / count
        grad, work = torch.empty_like(x), tile_buffer(x, x.dtype)
        for b, rows in tiles(x):
            centred = torch.sub(x[b, rows], mean[b], out=fill(work, x[b, rows]))
            tile = torch.addcmul(offset[b], centred, gain[b], out=grad[b, rows])
            if mask is not None:
                tile.masked_fill_(~mask[b, rows, None], 0.0)
        return grad, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], x: Tensor, mask: Tensor | None) -> Any:
        return torch.vmap(_moments, in_dims)(x, mask), (0, 0)
