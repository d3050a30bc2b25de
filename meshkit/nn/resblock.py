"""Residual block around a conditional normalisation."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, linear
from torch.nn.utils.parametrizations import spectral_norm
from torch.nn.utils.parametrize import is_parametrized

from meshkit._repr import settings
from meshkit.nn.spectral import settle_spectral_norm
from meshkit.norm import ConditionalNorm, ElaIN, modulate

__all__ = ["ConditionalResBlock"]


class ConditionalResBlock(nn.Module):
    r"""Residual block whose three branches normalise under a condition.

    .. math:: y = C_s\,\phi(\mathrm{N}_s(x, c)) + C_1\,\phi(\mathrm{N}_1(C_0\,\phi(\mathrm{N}_0(x, c)), c))

    with :math:`\phi` a LeakyReLU and :math:`C` linear maps per vertex (1 x 1 convolutions). The shortcut is always
    learned. The two norms of ``x`` share its statistics.

    Args:
        num_features: channels of ``x`` and of the result.
        cond_features: channels of ``cond``.
        norm: conditional norm, called as ``norm(num_features, cond_features)``; any module of the signature
            ``forward(x, cond, *, mask, cond_mask)``. A :class:`~meshkit.norm.ConditionalNorm` is fused with the
            activation and the linear map after it.
        slope: of the LeakyReLU, not negative.
        spectral: put spectral normalisation on the three linear maps, as the released code does. It is settled at
            construction, so that evaluation before any training step is sound.

    Shape:
        ``x (B, N, C)``, ``cond (B, N, D)`` (any number of rows if the norm says so), ``mask (B, N)``; the result is
        ``(B, N, C)``, 0 at padded vertices.

    Raises:
        ValueError: a negative slope, or shapes that do not fit.
        TypeError: a norm of another signature; no tensors, or ``x`` and the parameters in two dtypes.

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
        if not slope >= 0:
            raise ValueError(f"slope must not be negative, got {slope}")
        if not callable(norm) or isinstance(norm, nn.Module):
            raise ValueError(
                f"norm must be a class or function called as norm(num_features, cond_features), got {norm!r}; bind "
                "options with functools.partial"
            )
        self.slope = slope
        wrap: Callable[[nn.Module], Any] = spectral_norm if spectral else lambda layer: layer
        self.norm_0, self.norm_1, self.norm_s = (norm(num_features, cond_features) for _ in range(3))
        _check_norm(self.norm_0)
        self.conv_0 = wrap(nn.Linear(num_features, num_features))
        self.conv_1 = wrap(nn.Linear(num_features, num_features))
        self.conv_s = wrap(nn.Linear(num_features, num_features, bias=False))
        settle_spectral_norm(self)

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "slope")

    def reset_parameters(self) -> None:
        """Draw the three linear maps anew, Xavier normal, and settle their spectral normalisation."""
        for conv in (self.conv_0, self.conv_1, self.conv_s):
            # Under a parametrisation, conv.weight is a result: what is written to it is lost.
            nn.init.xavier_normal_(conv.parametrizations.weight.original if is_parametrized(conv) else conv.weight)
            if conv.bias is not None:
                nn.init.zeros_(conv.bias)
        settle_spectral_norm(self)

    def forward(
        self,
        x: Tensor,
        cond: Tensor,
        *,
        mask: Tensor | None = None,
        cond_mask: Tensor | None = None,
        then: nn.Linear | None = None,
    ) -> Tensor:
        """Transform ``x`` under ``cond``, and apply the linear map ``then`` to the result.

        ``then`` is composed with the last maps of both branches, since no activation lies between: where it narrows,
        the two C x C products per vertex shrink to its width.
        """
        norm_0, norm_1, norm_s = self.norm_0, self.norm_1, self.norm_s
        shared = None
        if isinstance(norm_0, ConditionalNorm):
            x, cond, cond_mask = norm_0.prepare(x, cond, mask, cond_mask)
            if isinstance(norm_s, ConditionalNorm) and norm_0.shares_statistics(norm_s):
                shared = norm_0.statistics(x, mask=mask)
        masks: dict[str, Any] = {"mask": mask, "cond_mask": cond_mask}
        weight_1, bias, weight_s = self.conv_1.weight, self.conv_1.bias, self.conv_s.weight
        if then is not None:
            if then.in_features != weight_1.shape[0]:
                raise ValueError(
                    f"then must take the {weight_1.shape[0]} channels of the block, it takes {then.in_features}"
                )
            weight_1, bias, weight_s = then.weight @ weight_1, then(bias), then.weight @ weight_s
        h = self._branch(norm_0, x, cond, self.conv_0.weight, self.conv_0.bias, statistics=shared, **masks)
        y = self._branch(norm_1, h, cond, weight_1, bias, **masks)
        y = y + self._branch(norm_s, x, cond, weight_s, statistics=shared, **masks)
        return y if mask is None else torch.where(mask[..., None], y, 0)

    def _branch(
        self,
        norm: nn.Module,
        x: Tensor,
        cond: Tensor,
        weight: Tensor,
        bias: Tensor | None = None,
        *,
        mask: Tensor | None,
        cond_mask: Tensor | None,
        statistics: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """Norm, activation, linear map."""
        if not isinstance(norm, ConditionalNorm):
            return linear(leaky_relu(norm(x, cond, mask=mask, cond_mask=cond_mask), self.slope), weight, bias)
        mean, std = norm.statistics(x, mask=mask) if statistics is None else statistics
        modulation = norm.modulation(cond, mean, std, cond_mask=cond_mask)
        return modulate(x, modulation, slope=self.slope, weight=weight, bias=bias)


def _check_norm(norm: object) -> None:
    """Name a norm that could not be called, here and not in the first forward pass."""
    if not isinstance(norm, nn.Module):
        raise TypeError(f"norm(num_features, cond_features) must give a torch.nn.Module, got {type(norm).__name__}")
    if isinstance(norm, ConditionalNorm):
        return
    signature = inspect.signature(norm.forward)
    try:
        signature.bind("x", "cond", mask=None, cond_mask=None)
    except TypeError as error:
        raise TypeError(
            f"a norm is called as norm(x, cond, mask=mask, cond_mask=cond_mask), but {type(norm).__name__} has "
            f"forward{signature}: {error}"
        ) from None
