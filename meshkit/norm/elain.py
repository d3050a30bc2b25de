"""Elastic instance normalisation (ElaIN)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from meshkit._repr import settings
from meshkit.batching import masked_mean
from meshkit.norm.base import ConditionalNorm, check_gate
from meshkit.norm.modulation import Modulation, compose
from meshkit.norm.statistics import instance_statistics, zero_padding

__all__ = ["ElaIN", "elain"]

OFFSET = {"released": 1.0, "paper": 0.0}


def elain(
    x: Tensor,
    gamma: Tensor,
    beta: Tensor,
    *,
    weight: Tensor,
    mask: Tensor | None = None,
    variant: str = "released",
    eps: float = 1e-5,
) -> Tensor:
    r"""Instance normalisation whose scale and shift blend given ones with the input's own statistics.

    .. math::
        \gamma' = w \gamma + (1 - w) \sigma, \qquad \beta' = w \beta + (1 - w) \mu,
        \qquad y = (o + \gamma') \frac{x - \mu}{\sigma} + \beta'

    where :math:`o` is 1 for ``variant="released"`` and 0 for ``variant="paper"``.

    Args:
        x: ``(B, N, C)``.
        gamma: scale, ``(B, N, C)`` or ``(B, 1, C)``.
        beta: shift, ``(B, N, C)`` or ``(B, 1, C)``.
        weight: w, ``(B, 1, C)``: 0 keeps the statistics of ``x``, 1 takes ``gamma`` and ``beta``.
        mask: ``(B, N)`` bool, True = real vertex.
        variant: ``"released"`` (offset 1, unbiased variance) or ``"paper"`` (offset 0, biased variance).
        eps: added to the variance.

    Returns:
        ``(B, N, C)`` in the dtype of ``x``; padded rows are 0.

    Raises:
        ValueError: unknown ``variant``, or ``x`` or ``mask`` of another shape or dtype.

    Reference:
        X-DualNet, "Elastic instance normalization"; the variants are those of :class:`ElaIN`.

    Example:
        >>> x = torch.tensor([[[1.0], [3.0]]])
        >>> elain(x, torch.tensor(5.0), torch.tensor(7.0), weight=torch.ones(1, 1, 1), variant="paper", eps=0.0)
        tensor([[[ 2.],
                 [12.]]])
    """
    check_variant(variant)
    mean, std = instance_statistics(x, mask=mask, unbiased=variant == "released", eps=eps)
    scale = OFFSET[variant] + weight * gamma + (1 - weight) * std
    scale = zero_padding(scale.expand_as(x), mask)
    y = (scale * ((zero_padding(x, mask) - mean) / std) + weight * beta + (1 - weight) * mean).to(x.dtype)
    return zero_padding(y, mask)


class ElaIN(ConditionalNorm):
    r"""Instance normalisation whose scale and shift blend learned parameters with the input's own statistics.

    :func:`elain` with :math:`\gamma = W_\gamma h + b_\gamma`, :math:`\beta = W_\beta h + b_\beta` learned from the
    condition brought to the width of ``x``, :math:`h = W_s c + b_s`, and the channel-wise weight
    :math:`w = W_w [\bar h, \mu] + b_w` from the two means.

    There is no activation between :math:`W_s` and :math:`W_\gamma`, :math:`W_\beta`, and ``w`` is constant over the
    vertices. So :math:`w W_\gamma W_s / \sigma` is one small matrix per sample, scale and shift are each one product
    with the condition, and no C x C product runs per vertex. Parameters stay those of the equations; only the order
    of evaluation differs.

    Statistics are float32 or better in any dtype. Without a gate w is linear in the mean of ``x``, so the result grows
    with the square of ``x``: in float16, which ends at 65504, a mean or deviation of some hundreds may overflow. Take
    ``gate="sigmoid"``, under which it grows in proportion, or bfloat16.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        variant: ``"released"`` (offset 1, unbiased variance) or ``"paper"`` (offset 0, biased variance).
        gate: ``"sigmoid"`` bounds w to (0, 1), so that it interpolates; None leaves it unbounded.
        eps: added to the variance.

    Shape:
        As :class:`ConditionalNorm`, with one row of ``cond`` per vertex of ``x``.

    Raises:
        ValueError: unknown ``variant`` or ``gate``, or shapes that do not fit.

    Reference:
        X-DualNet, "Elastic instance normalization".

    Deviations:
        The default follows the released code: 1 + gamma', and the unbiased variance. It starts near the identity map
        of the normalised features, where the paper's form starts near zero. Neither bounds w.

    Example:
        >>> norm = ElaIN(64, 128)
        >>> norm(torch.randn(2, 100, 64), torch.randn(2, 100, 128)).shape
        torch.Size([2, 100, 64])
    """

    def __init__(
        self,
        num_features: int,
        cond_features: int,
        *,
        variant: str = "released",
        gate: str | None = None,
        eps: float = 1e-5,
    ) -> None:
        super().__init__(num_features, cond_features, eps=eps)
        check_variant(variant)
        check_gate(gate)
        self.variant, self.gate = variant, gate
        self.unbiased = variant == "released"
        self.shared = nn.Linear(cond_features, num_features)
        self.gamma = nn.Linear(num_features, num_features)
        self.beta = nn.Linear(num_features, num_features)
        self.weight = nn.Linear(2 * num_features, num_features)

    def extra_repr(self) -> str:
        """Widths and options in the printed module."""
        return f"{super().extra_repr()}, {settings(self, 'variant', 'gate')}"

    def modulation(self, cond: Tensor, mean: Tensor, std: Tensor, *, cond_mask: Tensor | None = None) -> Modulation:
        """Composed scale and shift."""
        cond_mean = self.shared(masked_mean(cond, cond_mask)[:, None])
        w = self.weight(torch.cat([cond_mean, mean.to(cond_mean.dtype)], 2)).to(std.dtype)
        if self.gate == "sigmoid":
            w = w.sigmoid()
        gain = w / std
        gamma_weight, gamma_bias = compose(self.gamma, self.shared)
        beta_weight, beta_bias = compose(self.beta, self.shared)
        return Modulation(
            mean,
            scale_bias=gain * gamma_bias + (OFFSET[self.variant] + (1 - w) * std) / std,
            shift_bias=w * beta_bias + (1 - w) * mean,
            features=cond,
            scale_weight=gain * gamma_weight.mT,
            shift_weight=w * beta_weight.mT,
        )


def check_variant(variant: str) -> None:
    if variant not in OFFSET:
        raise ValueError(f'variant must be "released" or "paper", got {variant!r}')
