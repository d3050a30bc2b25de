"""What the conditional norms have in common: one signature, one evaluation."""

from __future__ import annotations

import inspect
from functools import wraps
from numbers import Integral
from typing import Any

import torch
from torch import Tensor, nn

from meshkit._checks import check_channels, check_dtype, check_features
from meshkit._repr import settings
from meshkit.batching import check_mask
from meshkit.norm.modulation import Modulation, modulate
from meshkit.norm.statistics import instance_statistics, zero_padding

__all__ = ["ConditionalNorm"]


class ConditionalNorm(nn.Module):
    """A norm of ``x`` whose scale and shift come from a condition; subclasses say how, in :meth:`modulation`.

    Args:
        num_features: channels C of ``x``.
        cond_features: channels D of ``cond``.
        eps: added to the variance.

    Shape:
        ``x (B, N, C)`` and ``cond (B, M, D)`` with masks ``(B, N)`` and ``(B, M)``; the result is ``(B, N, C)`` in the
        dtype of ``x``, 0 at padded vertices. Where ``per_vertex``, M = N, row n of ``cond`` belongs to vertex
        n of ``x``. Otherwise ``cond`` may have any number of rows. Where it has as many as ``x``, ``cond_mask`` is
        ``mask`` unless given.

    Raises:
        ValueError: shapes that do not fit.
        TypeError: no tensors, or ``x`` and the parameters in two dtypes outside autocast; ``cond`` may have any. A
            subclass whose ``modulation`` takes no ``cond_mask``, or whose constructor leaves out this one's.

    Example:
        A norm of one's own, which runs fused in a :class:`~meshkit.nn.ConditionalResBlock` like the package's:

        >>> from meshkit.batching import masked_mean
        >>> class ShiftByMean(ConditionalNorm):
        ...     per_vertex = False
        ...
        ...     def modulation(self, cond, mean, std, *, cond_mask=None):
        ...         return Modulation(mean, scale_bias=1 / std, shift_bias=masked_mean(cond, cond_mask)[:, None])
        >>> ShiftByMean(8, 8)(torch.randn(2, 100, 8), torch.randn(2, 50, 8)).shape
        torch.Size([2, 100, 8])
    """

    per_vertex = True
    unbiased = False

    def __init_subclass__(cls, **options: Any) -> None:
        """Name the usual slips of a subclass where they are made, not in the first forward pass."""
        super().__init_subclass__(**options)
        taken = inspect.signature(cls.modulation).parameters.values()
        if not any(p.name == "cond_mask" or p.kind is p.VAR_KEYWORD for p in taken):
            raise TypeError(
                f"{cls.__name__}.modulation must take cond_mask: modulation(self, cond, mean, std, *, cond_mask=None)"
            )
        if "__init__" in cls.__dict__:
            cls.__init__ = _calling_super(cls.__init__)  # type: ignore[method-assign]

    def __init__(self, num_features: int, cond_features: int, *, eps: float = 1e-5) -> None:
        super().__init__()
        for width in (num_features, cond_features):
            if not isinstance(width, Integral) or width < 1:
                given = f"{num_features!r}, {cond_features!r}"
                raise ValueError(f"num_features and cond_features must be positive whole numbers, got {given}")
        if not eps >= 0:
            raise ValueError(f"eps is added to a variance and cannot be negative, got {eps}")
        self.num_features, self.cond_features, self.eps = num_features, cond_features, eps

    def forward(
        self, x: Tensor, cond: Tensor, *, mask: Tensor | None = None, cond_mask: Tensor | None = None
    ) -> Tensor:
        """Normalise ``x`` under ``cond``."""
        x, cond, cond_mask = self.prepare(x, cond, mask, cond_mask)
        mean, std = self.statistics(x, mask=mask)
        y = modulate(x, self.modulation(cond, mean, std, cond_mask=cond_mask))
        return y if mask is None else torch.where(mask[..., None], y, 0)

    def prepare(
        self, x: Tensor, cond: Tensor, mask: Tensor | None, cond_mask: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Check the arguments of :meth:`forward`; returns ``x``, ``cond`` with padding zeroed, and ``cond_mask``."""
        layout = f"(B, {'N' if self.per_vertex else 'M'}, D)"
        check_features(x)
        check_features(cond, name="cond", layout=layout)
        check_channels(x, self.num_features)
        check_channels(cond, self.cond_features, name="cond")
        if x.shape[: 1 + self.per_vertex] != cond.shape[: 1 + self.per_vertex]:
            rows = "B and N" if self.per_vertex else "B"
            raise ValueError(
                f"x (B, N, C) and cond {layout} must agree in {rows}, got {tuple(x.shape)}, {tuple(cond.shape)}"
            )
        check_dtype(x, self)
        if cond_mask is None and cond.shape[1] == x.shape[1]:
            cond_mask = mask
        check_mask(mask, *x.shape[:2])
        check_mask(cond_mask, *cond.shape[:2], name="cond_mask")
        if cond.dtype != x.dtype and not torch.is_autocast_enabled(x.device.type):
            cond = cond.to(x.dtype)
        return zero_padding(x, mask), zero_padding(cond, cond_mask), cond_mask

    def statistics(self, x: Tensor, *, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and deviation ``(B, 1, C)`` that ``x`` is normalised by."""
        return instance_statistics(x, mask=mask, unbiased=self.unbiased, eps=self.eps)

    def shares_statistics(self, other: ConditionalNorm) -> bool:
        """Whether :meth:`statistics` of ``other`` are the same for the same ``x``, so that they are needed once."""
        own = (type(norm).statistics is ConditionalNorm.statistics for norm in (self, other))
        return all(own) and (self.unbiased, self.eps) == (other.unbiased, other.eps)

    def extra_repr(self) -> str:
        """Widths and options in the printed module."""
        return f"{self.num_features}, {self.cond_features}, {settings(self, 'eps')}"

    def modulation(self, cond: Tensor, mean: Tensor, std: Tensor, *, cond_mask: Tensor | None = None) -> Modulation:
        """Scale and shift for a condition whose padded rows are zero, given the statistics of ``x``."""
        raise NotImplementedError(f"{type(self).__name__} must define modulation(cond, mean, std, *, cond_mask=None)")


def _calling_super(init: Any) -> Any:
    """A constructor that says when it left out that of :class:`ConditionalNorm`."""

    @wraps(init)
    def checked(self: ConditionalNorm, *arguments: Any, **options: Any) -> None:
        left_out = f"{init.__qualname__} must begin with super().__init__(num_features, cond_features)"
        try:
            init(self, *arguments, **options)
        except AttributeError as error:
            if "before Module.__init__() call" not in str(error):
                raise
            raise TypeError(left_out) from error
        if "num_features" not in self.__dict__:
            raise TypeError(left_out)

    return checked


def check_gate(gate: str | None) -> None:
    if gate not in ("sigmoid", None):
        raise ValueError(f'gate must be "sigmoid" or None, got {gate!r}')
