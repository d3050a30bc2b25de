"""Residual block around a conditional normalisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn
from torch.nn.functional import leaky_relu, linear
from torch.nn.utils.parametrizations import spectral_norm

from meshkit.norm import ElaIN

__all__ = ["ConditionalResBlock"]


class ConditionalResBlock(nn.Module):
    r"""Residual block whose three branches normalise under a condition.

    .. math:: y = C_s\,\phi(\mathrm{N}_s(x, c)) + C_1\,\phi(\mathrm{N}_1(C_0\,\phi(\mathrm{N}_0(x, c)), c))

    with :math:`\phi` a LeakyReLU and :math:`C` linear maps per vertex (1 x 1 convolutions). The shortcut is always
    learned. The two norms of ``x`` share its statistics.

    Args:
        num_features: channels of ``x`` and of the result.
        cond_features: channels of ``cond``.
        norm: conditional norm, called as ``norm(num_features, cond_features)``.
        slope: of the LeakyReLU.
        spectral: put spectral normalisation on the three linear maps, as the released code does.

    Shape:
        ``x (B, N, C)``, ``cond (B, N, D)``, ``mask (B, N)``; the result is ``(B, N, C)``.

    Reference:
        X-DualNet, "Pose transfer module"; LeakyReLU slope 0.2 and spectral norm from the released code.

    Example:
        >>> import torch
        >>> ConditionalResBlock(16, 8)(torch.randn(1, 20, 16), torch.randn(1, 20, 8)).shape
        torch.Size([1, 20, 16])
    """

    def __init__(
        self,
        num_features: int,
        cond_features: int,
        *,
        norm: Callable[[int, int], nn.Module] = ElaIN,
        slope: float = 0.2,
        spectral: bool = True,
    ) -> None:
        super().__init__()
        self.slope = slope
        wrap: Callable[[nn.Module], Any] = spectral_norm if spectral else lambda layer: layer
        self.norm_0, self.norm_1, self.norm_s = (norm(num_features, cond_features) for _ in range(3))
        self.conv_0 = wrap(nn.Linear(num_features, num_features))
        self.conv_1 = wrap(nn.Linear(num_features, num_features))
        self.conv_s = wrap(nn.Linear(num_features, num_features, bias=False))

    def forward(self, x: Tensor, cond: Tensor, *, mask: Tensor | None = None, then: nn.Linear | None = None) -> Tensor:
        """Transform ``x`` under ``cond``, and apply the linear map ``then`` to the result.

        ``then`` is composed with the last maps of both branches, since no activation lies between: where it narrows,
        the two C x C products per vertex shrink to its width.
        """
        shared: dict[str, Any] = {}
        statistics: Callable[..., Any] | None = getattr(self.norm_0, "statistics", None)
        if statistics is not None:
            shared["statistics"] = statistics(x, mask=mask)
        residual = self.conv_0(self._act(self.norm_0(x, cond, mask=mask, **shared)))
        residual = self._act(self.norm_1(residual, cond, mask=mask))
        shortcut = self._act(self.norm_s(x, cond, mask=mask, **shared))
        if then is None:
            return self.conv_s(shortcut) + self.conv_1(residual)
        weight, bias = then.weight @ self.conv_1.weight, then(self.conv_1.bias)
        return linear(shortcut, then.weight @ self.conv_s.weight) + linear(residual, weight, bias)

    def _act(self, x: Tensor) -> Tensor:
        return leaky_relu(x, self.slope)
