"""Spatially adaptive normalisation (SPADE) for vertex features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from meshkit._checks import check_whole
from meshkit._repr import settings
from meshkit.norm.base import ConditionalNorm
from meshkit.norm.modulation import Modulation

__all__ = ["SPADE", "spade"]


def spade(x: Tensor, gamma: Tensor, beta: Tensor, *, mean: Tensor, var: Tensor, eps: float = 1e-5) -> Tensor:
    r"""Normalisation by statistics of the batch, with a given scale and shift per vertex.

    .. math:: y = (1 + \gamma) \frac{x - \mu}{\sqrt{\mathrm{var} + \epsilon}} + \beta

    Args:
        x: ``(B, N, C)``.
        gamma: ``(B, N, C)``, or anything that broadcasts with it.
        beta: ``(B, N, C)``, or anything that broadcasts with it.
        mean: ``(C,)``, of the batch (training, see :func:`batch_statistics`) or running (evaluation).
        var: ``(C,)``, likewise.
        eps: added to the variance.

    Returns:
        ``(B, N, C)`` in the dtype of ``x``.

    Reference:
        Park et al., "Semantic image synthesis with spatially-adaptive normalization", Equation 1.

    Example:
        >>> x = torch.tensor([[[1.0], [3.0]]])
        >>> spade(x, torch.tensor(1.0), torch.tensor(5.0), mean=torch.tensor([2.0]), var=torch.tensor([1.0]), eps=0.0)
        tensor([[[3.],
                 [7.]]])
    """
    return ((1 + gamma) * ((x - mean) * (var + eps).rsqrt()) + beta).to(x.dtype)


def batch_statistics(x: Tensor, *, mask: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    r"""Mean and biased variance of each channel over all real vertices of the batch, and their number.

    Args:
        x: ``(B, N, C)``.
        mask: ``(B, N)`` bool, True = real vertex.

    Returns:
        ``mean (C,)``, ``var (C,)`` and ``count ()``, in float32 or better; all 0 without a real vertex.
    """
    x = x.flatten(0, 1).to(torch.promote_types(x.dtype, torch.float32))
    if mask is None:
        return x.mean(0), x.var(0, correction=0), x.new_tensor(len(x))
    real = mask.flatten()[:, None]
    count = real.sum().to(x.dtype)
    mean = torch.where(real, x, 0).sum(0) / count.clamp_min(1)
    return mean, torch.where(real, x - mean, 0).square().sum(0) / count.clamp_min(1), count


class SPADE(ConditionalNorm):
    r"""Batch normalisation whose scale and shift are learned from the condition, vertex by vertex.

    :func:`spade` with :math:`h = \mathrm{ReLU}(W_s c + b_s)`, :math:`\gamma = W_\gamma h + b_\gamma` and
    :math:`\beta = W_\beta h + b_\beta`. In training, mean and variance are those of all real vertices of the batch,
    and running ones are kept; evaluation takes the running ones. A batch without a real vertex does not move them.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        hidden: channels of h.
        momentum: share of the new batch in the running statistics.
        eps: added to the variance.

    Shape:
        As :class:`ConditionalNorm`, with one row of ``cond`` per vertex of ``x``.

    Raises:
        ValueError: shapes that do not fit, ``hidden`` below 1, or ``momentum`` outside [0, 1].

    Reference:
        Park et al., "Semantic image synthesis with spatially-adaptive normalization", Equation 1.

    Deviations:
        Vertices have no grid, so the 3 x 3 convolutions are linear maps per vertex. The statistics are those of one
        process; the other norms of the package know single samples only and need no synchronisation.

    Example:
        >>> SPADE(64, 128)(torch.randn(2, 100, 64), torch.randn(2, 100, 128)).shape
        torch.Size([2, 100, 64])
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor

    def __init__(
        self, num_features: int, cond_features: int, *, hidden: int = 128, momentum: float = 0.1, eps: float = 1e-5
    ) -> None:
        super().__init__(num_features, cond_features, eps=eps)
        check_whole(hidden, "hidden")
        if not 0 <= momentum <= 1:
            raise ValueError(f"momentum is a share, from 0 to 1, got {momentum}")
        self.momentum = momentum
        self.shared = nn.Linear(cond_features, hidden)
        self.gamma = nn.Linear(hidden, num_features)
        self.beta = nn.Linear(hidden, num_features)
        self.register_buffer("running_mean", torch.zeros(num_features))
        self.register_buffer("running_var", torch.ones(num_features))
        self.register_buffer("num_batches_tracked", torch.tensor(0))

    def extra_repr(self) -> str:
        """Widths and options in the printed module."""
        return f"{super().extra_repr()}, {settings(self, 'momentum')}"

    def statistics(self, x: Tensor, *, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the batch in training, running ones in evaluation."""
        mean, var = self.running_mean, self.running_var
        if self.training:
            mean, var, count = batch_statistics(x, mask=mask)
            with torch.no_grad():
                unbiased = var * (count / (count - 1).clamp_min(1))
                some = count > 0  # without a real vertex there is nothing to learn from
                for running, new in ((self.running_mean, mean), (self.running_var, unbiased)):
                    running.lerp_(new.to(running.dtype), self.momentum * some.to(running.dtype))
                self.num_batches_tracked += some
        shape = (len(x), 1, -1)
        return mean.expand(shape), (var + self.eps).sqrt().expand(shape)

    def modulation(self, cond: Tensor, mean: Tensor, std: Tensor, *, cond_mask: Tensor | None = None) -> Modulation:
        """Scale and shift as maps of the hidden features."""
        hidden = self.shared(cond).relu()
        return Modulation(
            mean,
            scale_bias=(1 + self.gamma.bias) / std,
            shift_bias=self.beta.bias.to(std.dtype).expand_as(std),
            features=hidden,
            scale_weight=self.gamma.weight.mT / std,
            shift_weight=self.beta.weight.mT.expand(len(std), -1, -1),
        )
