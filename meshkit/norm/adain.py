"""Adaptive instance normalisation (AdaIN) and its soft form."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from meshkit._checks import check_features
from meshkit._repr import settings
from meshkit.batching import masked_mean
from meshkit.norm.base import ConditionalNorm, check_gate
from meshkit.norm.modulation import Modulation
from meshkit.norm.statistics import instance_statistics, zero_padding

__all__ = ["AdaIN", "SoftAdaIN", "adain", "soft_adain"]


def adain(
    x: Tensor, style: Tensor, *, mask: Tensor | None = None, style_mask: Tensor | None = None, eps: float = 1e-5
) -> Tensor:
    r"""Give ``x`` the mean and deviation of a style.

    .. math:: y = \sigma_s \frac{x - \mu}{\sigma} + \mu_s

    Args:
        x: ``(B, N, C)``.
        style: ``(B, M, C)``, any number of rows.
        mask: ``(B, N)`` bool, True = real vertex of ``x``.
        style_mask: ``(B, M)`` bool, True = real row of ``style``.
        eps: added to both variances.

    Returns:
        ``(B, N, C)`` in the dtype of ``x``; padded rows are 0.

    Raises:
        ValueError: shapes that do not fit.

    Reference:
        Huang and Belongie, "Arbitrary style transfer in real-time with adaptive instance normalization", Equation 8.

    Deviations:
        The variances are biased, as everywhere in the package but ElaIN's released form.

    Example:
        >>> x, style = torch.tensor([[[1.0], [3.0]]]), torch.tensor([[[4.0], [10.0]]])
        >>> adain(x, style, eps=0.0).flatten().tolist()
        [4.0, 10.0]
    """
    return soft_adain(
        x, style, weight=torch.ones((), dtype=x.dtype, device=x.device), mask=mask, style_mask=style_mask, eps=eps
    )


def soft_adain(
    x: Tensor,
    style: Tensor,
    *,
    weight: Tensor,
    mask: Tensor | None = None,
    style_mask: Tensor | None = None,
    eps: float = 1e-5,
) -> Tensor:
    r"""Give ``x`` a blend of its own statistics and those of a style.

    .. math:: y = \sigma' \frac{x - \mu}{\sigma} + \mu', \qquad \sigma' = w \sigma_s + (1 - w) \sigma, \qquad
              \mu' = w \mu_s + (1 - w) \mu

    Args:
        x: ``(B, N, C)``.
        style: ``(B, M, C)``, any number of rows.
        weight: w, anything that broadcasts with ``(B, 1, C)``: 0 returns ``x``, 1 is :func:`adain`.
        mask: ``(B, N)`` bool, True = real vertex of ``x``.
        style_mask: ``(B, M)`` bool, True = real row of ``style``.
        eps: added to both variances.

    Returns:
        ``(B, N, C)`` in the dtype of ``x``; padded rows are 0.

    Raises:
        ValueError: shapes that do not fit.

    Reference:
        Chen et al., "CartoonRenderer: an instance-based multi-style cartoon image translator", Soft-AdaIN; the relative
        of ElaIN that X-DualNet names, "Elastic instance normalization".

    Example:
        >>> x, style = torch.tensor([[[1.0], [3.0]]]), torch.tensor([[[4.0], [10.0]]])
        >>> soft_adain(x, style, weight=torch.tensor(0.5), eps=0.0).flatten().tolist()
        [2.5, 6.5]
    """
    check_features(x)
    check_features(style, name="style", layout="(B, M, C)")
    if x.shape[::2] != style.shape[::2]:
        raise ValueError(
            f"x (B, N, C) and style (B, M, C) must agree in B and C, got {tuple(x.shape)}, {tuple(style.shape)}"
        )
    mean, std = instance_statistics(x, mask=mask, eps=eps)
    style_mean, style_std = instance_statistics(style, mask=style_mask, eps=eps)
    y = torch.lerp(std, style_std, weight.to(std.dtype)) * ((zero_padding(x, mask) - mean) / std)
    y = (y + torch.lerp(mean, style_mean, weight.to(mean.dtype))).to(x.dtype)
    return zero_padding(y, mask)


class AdaIN(ConditionalNorm):
    r"""Instance normalisation that takes over mean and deviation of the condition.

    :func:`adain` with the style :math:`h = W_s c + b_s`, the condition brought to the width of ``x``. Where the widths
    are equal, :math:`W_s` starts as the identity map, which is the parameter-free AdaIN of the literature; elsewhere
    that is not defined. The style's statistics follow from mean and covariance of the condition,
    :math:`\mu_s = W_s \bar c + b_s` and :math:`\sigma_s^2 = \mathrm{diag}(W_s \Sigma_c W_s^\top)`, so h is never
    formed.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        eps: added to both variances.

    Shape:
        As :class:`ConditionalNorm`, with any number of rows in ``cond``.

    Raises:
        ValueError: shapes that do not fit.

    Reference:
        Huang and Belongie, "Arbitrary style transfer in real-time with adaptive instance normalization", Equation 8.

    Deviations:
        The map :math:`W_s` is an addition, without which condition and features must have one width.

    Example:
        >>> AdaIN(64, 128)(torch.randn(2, 100, 64), torch.randn(2, 80, 128)).shape
        torch.Size([2, 100, 64])
    """

    per_vertex = False

    def __init__(self, num_features: int, cond_features: int, *, eps: float = 1e-5) -> None:
        super().__init__(num_features, cond_features, eps=eps)
        self.shared = nn.Linear(cond_features, num_features)
        if num_features == cond_features:
            nn.init.eye_(self.shared.weight)
            nn.init.zeros_(self.shared.bias)

    def modulation(self, cond: Tensor, mean: Tensor, std: Tensor, *, cond_mask: Tensor | None = None) -> Modulation:
        """The style's statistics."""
        style_mean, style_std = self._style(cond, cond_mask)
        return Modulation(mean, scale_bias=style_std / std, shift_bias=style_mean)

    def _style(self, cond: Tensor, cond_mask: Tensor | None) -> tuple[Tensor, Tensor]:
        """Mean and deviation ``(B, 1, C)`` of ``shared(cond)``, at least in float32."""
        with torch.autocast(cond.device.type, enabled=False):
            dtype = torch.promote_types(torch.promote_types(cond.dtype, self.shared.weight.dtype), torch.float32)
            cond, weight, bias = (t.to(dtype) for t in (cond, self.shared.weight, self.shared.bias))
            cond_mean = masked_mean(cond, cond_mask)[:, None]
            centred = cond - cond_mean
            count: Tensor | int = cond.shape[1]
            if cond_mask is not None:
                centred = centred.masked_fill(~cond_mask[..., None], 0.0)
                count = cond_mask.sum(1).clamp_min(1)[:, None, None]
            covariance = centred.mT @ centred / count
            variance = ((weight @ covariance) * weight).sum(2)[:, None].clamp_min(0)
            return nn.functional.linear(cond_mean, weight, bias), (variance + self.eps).sqrt()


class SoftAdaIN(AdaIN):
    r"""AdaIN that blends the condition's statistics with the input's own.

    :func:`soft_adain` with the style of :class:`AdaIN` and the channel-wise weight
    :math:`w = \mathrm{sigmoid}(W_w [\mu_s, \mu] + b_w)` from the two means.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        gate: ``"sigmoid"`` bounds w to (0, 1), so that it interpolates; None leaves it unbounded.
        eps: added to both variances.

    Shape:
        As :class:`ConditionalNorm`, with any number of rows in ``cond``.

    Raises:
        ValueError: unknown ``gate``, or shapes that do not fit.

    Reference:
        Chen et al., "CartoonRenderer: an instance-based multi-style cartoon image translator", Soft-AdaIN.

    Deviations:
        One linear map from the pooled features to w, as in ElaIN, instead of a bottleneck of several layers.

    Example:
        >>> SoftAdaIN(64, 128)(torch.randn(2, 100, 64), torch.randn(2, 80, 128)).shape
        torch.Size([2, 100, 64])
    """

    def __init__(
        self, num_features: int, cond_features: int, *, gate: str | None = "sigmoid", eps: float = 1e-5
    ) -> None:
        super().__init__(num_features, cond_features, eps=eps)
        check_gate(gate)
        self.gate = gate
        self.weight = nn.Linear(2 * num_features, num_features)

    def extra_repr(self) -> str:
        """Widths and options in the printed module."""
        return f"{super().extra_repr()}, {settings(self, 'gate')}"

    def modulation(self, cond: Tensor, mean: Tensor, std: Tensor, *, cond_mask: Tensor | None = None) -> Modulation:
        """The blended statistics."""
        style_mean, style_std = self._style(cond, cond_mask)
        means = torch.cat([style_mean, mean.to(style_mean.dtype)], 2)
        w = self.weight(means.to(self.weight.weight.dtype)).to(std.dtype)
        if self.gate == "sigmoid":
            w = w.sigmoid()
        scale = (w * style_std + (1 - w) * std) / std
        return Modulation(mean, scale_bias=scale, shift_bias=w * style_mean + (1 - w) * mean)
