"""Elastic instance normalisation (ElaIN)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from meshkit.batching import check_mask, masked_mean
from meshkit.norm.statistics import instance_statistics

__all__ = ["ElaIN"]


class ElaIN(nn.Module):
    r"""Instance normalisation whose scale and shift blend learned parameters with the input's own statistics.

    With :math:`\hat x = (x - \mu)/\sigma`, :math:`h = W_s c + b_s` the condition brought to the width of ``x``, the
    learned :math:`\gamma = W_\gamma h + b_\gamma`, :math:`\beta = W_\beta h + b_\beta`, and the channel-wise weight
    :math:`w = W_w [\bar h, \mu] + b_w` from the two means,

    .. math::
        \gamma' = w \gamma + (1 - w) \sigma, \qquad \beta' = w \beta + (1 - w) \mu,
        \qquad y = (o + \gamma')\, \hat x + \beta'

    where :math:`o` is 1 for ``variant="released"`` and 0 for ``variant="paper"``.

    There is no activation between :math:`W_s` and :math:`W_\gamma`, :math:`W_\beta`, and ``w`` is constant over the
    vertices. So :math:`w W_\gamma W_s / \sigma` is one small matrix per sample, scale and shift are each one product
    with the condition, and no C x C product runs per vertex. Parameters stay those of the equations; only the order
    of evaluation differs.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        variant: ``"released"`` (offset 1, unbiased variance) or ``"paper"`` (offset 0, biased variance).
        eps: added to the variance.

    Shape:
        ``x`` ``(B, N, C)``, ``cond`` ``(B, N, D)`` with one row per vertex of ``x``, ``mask`` ``(B, N)`` bool shared by
        both; the result is ``(B, N, C)`` in the dtype of ``x``.

    Raises:
        ValueError: unknown ``variant``, or shapes that do not fit.

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

    def __init__(self, num_features: int, cond_features: int, *, variant: str = "released", eps: float = 1e-5) -> None:
        super().__init__()
        if variant not in ("released", "paper"):
            raise ValueError(f'variant must be "released" or "paper", got {variant!r}')
        self.variant = variant
        self.eps = eps
        self.shared = nn.Linear(cond_features, num_features)
        self.gamma = nn.Linear(num_features, num_features)
        self.beta = nn.Linear(num_features, num_features)
        self.weight = nn.Linear(2 * num_features, num_features)

    def forward(
        self,
        x: Tensor,
        cond: Tensor,
        *,
        mask: Tensor | None = None,
        statistics: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """Normalise ``x`` under ``cond``; ``statistics`` are those of ``x`` when the caller already has them."""
        if x.dim() != 3 or cond.dim() != 3 or x.shape[:2] != cond.shape[:2]:
            raise ValueError(
                f"x (B, N, C) and cond (B, N, D) must agree in B and N, got {tuple(x.shape)}, {tuple(cond.shape)}"
            )
        if x.shape[2] != self.gamma.out_features or cond.shape[2] != self.shared.in_features:
            raise ValueError(
                f"expected x with {self.gamma.out_features} and cond with {self.shared.in_features} channels, "
                f"got {x.shape[2]} and {cond.shape[2]}"
            )
        check_mask(mask, *x.shape[:2])
        if mask is not None:
            x = x.masked_fill(~mask[..., None], 0.0)
        mean, std = self.statistics(x, mask=mask) if statistics is None else statistics
        scale, shift = self._modulation(cond, mask, mean, std)
        return torch.addcmul(shift, x - mean.to(x.dtype), scale).to(x.dtype)

    def statistics(self, x: Tensor, *, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The statistics this variant uses, to be shared between norms of one input."""
        return instance_statistics(x, mask=mask, unbiased=self.variant == "released", eps=self.eps)

    def _modulation(self, cond: Tensor, mask: Tensor | None, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        """``scale, shift`` with ``y = (x - mean) * scale + shift``, each ``(B, N, C)``."""
        cond_mean = masked_mean(cond, mask)[:, None]
        if mask is not None:
            cond = cond.masked_fill(~mask[..., None], 0.0)
        w = self.weight(torch.cat([self.shared(cond_mean), mean.to(cond.dtype)], 2)).to(std.dtype)
        gain = w / std
        gamma_weight, gamma_bias = _compose(self.gamma, self.shared)
        beta_weight, beta_bias = _compose(self.beta, self.shared)
        offset = 1.0 if self.variant == "released" else 0.0
        scale_bias = gain * gamma_bias + (offset + (1 - w) * std) / std
        shift_bias = w * beta_bias + (1 - w) * mean
        scale = torch.baddbmm(scale_bias, cond, (gain.mT * gamma_weight).mT)
        shift = torch.baddbmm(shift_bias, cond, (w.mT * beta_weight).mT)
        return scale, shift


def _compose(outer: nn.Linear, inner: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of ``outer(inner(.))``."""
    return outer.weight @ inner.weight, outer.weight @ inner.bias + outer.bias
