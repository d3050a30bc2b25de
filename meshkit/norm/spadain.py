"""Spatially adaptive instance normalisation (SPAdaIN)."""

from __future__ import annotations

from torch import Tensor, nn

from meshkit.norm.base import ConditionalNorm
from meshkit.norm.modulation import Modulation
from meshkit.norm.statistics import instance_norm, zero_padding

__all__ = ["SPAdaIN", "spadain"]


def spadain(x: Tensor, gamma: Tensor, beta: Tensor, *, mask: Tensor | None = None, eps: float = 1e-5) -> Tensor:
    r"""Instance normalisation with a given scale and shift per vertex.

    .. math:: y = \gamma \frac{x - \mu}{\sigma} + \beta

    Args:
        x: ``(B, N, C)``.
        gamma: ``(B, N, C)``, or anything that broadcasts with it.
        beta: ``(B, N, C)``, or anything that broadcasts with it.
        mask: ``(B, N)`` bool, True = real vertex.
        eps: added to the variance, which is biased.

    Returns:
        ``(B, N, C)`` in the dtype of ``x``; padded rows are 0.

    Raises:
        ValueError: ``x`` or ``mask`` has another shape or dtype.

    Reference:
        Wang et al., "Neural pose transfer by spatially adaptive instance normalization", Equation 1.

    Example:
        >>> import torch
        >>> spadain(torch.tensor([[[1.0], [3.0]]]), torch.tensor(5.0), torch.tensor(7.0), eps=0.0).flatten().tolist()
        [2.0, 12.0]
    """
    y = (gamma * instance_norm(x, mask=mask, eps=eps) + beta).to(x.dtype)
    return zero_padding(y, mask)


class SPAdaIN(ConditionalNorm):
    r"""Instance normalisation whose scale and shift are linear maps of the condition, vertex by vertex.

    :func:`spadain` with :math:`\gamma = W_\gamma c + b_\gamma` and :math:`\beta = W_\beta c + b_\beta`.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        eps: added to the variance, which is biased.

    Shape:
        As :class:`ConditionalNorm`, with one row of ``cond`` per vertex of ``x``.

    Raises:
        ValueError: shapes that do not fit.

    Reference:
        Wang et al., "Neural pose transfer by spatially adaptive instance normalization", Equation 1.

    Example:
        >>> import torch
        >>> SPAdaIN(64, 3)(torch.randn(2, 100, 64), torch.randn(2, 100, 3)).shape
        torch.Size([2, 100, 64])
    """

    def __init__(self, num_features: int, cond_features: int, *, eps: float = 1e-5) -> None:
        super().__init__(num_features, cond_features, eps=eps)
        self.gamma = nn.Linear(cond_features, num_features)
        self.beta = nn.Linear(cond_features, num_features)

    def modulation(self, cond: Tensor, mean: Tensor, std: Tensor, *, cond_mask: Tensor | None = None) -> Modulation:
        """Scale and shift as maps of the condition."""
        return Modulation(
            mean,
            scale_bias=self.gamma.bias / std,
            shift_bias=self.beta.bias.to(std.dtype).expand_as(std),
            features=cond,
            scale_weight=self.gamma.weight.mT / std,
            shift_weight=self.beta.weight.mT.expand(len(std), -1, -1),
        )
