"""Marginals of a batch: which rows and columns of each sample take part, and with what weight."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from meshkit.batching import check_mask

__all__: list[str] = []  # internal: meshkit.ot lists what is public


class Sides(NamedTuple):
    """Rows and columns of one sample that have weight; indices are ``None`` if all have."""

    mu: Tensor
    nu: Tensor
    index_x: Tensor | None
    index_y: Tensor | None
    weight_range: float

    def rows_of(self, values: Tensor) -> Tensor:
        """The rows ``(n, ...)`` that take part, of all ``(N, ...)``."""
        return values if self.index_x is None else values.index_select(0, self.index_x)

    def columns_of(self, values: Tensor) -> Tensor:
        """The columns that take part."""
        return values if self.index_y is None else values.index_select(0, self.index_y)

    def detached(self) -> Sides:
        """The same, as constants."""
        return self._replace(mu=self.mu.detach(), nu=self.nu.detach())


def marginals(
    a: Tensor | None,
    b: Tensor | None,
    mask_x: Tensor | None,
    mask_y: Tensor | None,
    shape: tuple[int, int, int],
    like: Tensor,
    *,
    balanced: bool,
) -> list[Sides]:
    """Check weights and masks of problems of shape ``(B, N, M)``, and read them sample by sample.

    ``like`` gives dtype and device.
    """
    batch, rows, columns = shape
    mu, nu = weights(a, mask_x, (batch, rows), like.dtype, "x"), weights(b, mask_y, (batch, columns), like.dtype, "y")
    if balanced and (a is not None or b is not None):
        check_totals(mu, nu)
    return [pick(mu, nu, sample, (rows, columns), like) for sample in range(batch)]


def pick(mu: Tensor | None, nu: Tensor | None, sample: int, sizes: tuple[int, int], like: Tensor) -> Sides:
    """Weights of one sample and where they are positive. Without mass on either side nothing is left of both."""
    sides: list[tuple[Tensor, Tensor | None]] = []
    weight_range = 0.0
    for weight, size in zip((mu, nu), sizes, strict=True):
        if weight is None:
            sides.append((like.new_full((size,), 1 / size), None))
            weight_range += math.log(size)
        else:
            index = (weight[sample].detach() > 0).nonzero()[:, 0]
            chosen = weight[sample].index_select(0, index)
            if len(chosen):
                share = float(chosen.detach().amin() / chosen.detach().sum())
                weight_range -= math.log(max(share, 1e-300))
            sides.append((chosen, index))
    if any(len(weight) == 0 for weight, _ in sides):
        nothing = torch.empty(0, dtype=torch.int64, device=like.device)
        sides = [(weight[:0], nothing) for weight, _ in sides]
    (mu_s, index_x), (nu_s, index_y) = sides
    return Sides(mu_s, nu_s, index_x, index_y, weight_range)


def weights(
    given: Tensor | None, mask: Tensor | None, shape: tuple[int, int], dtype: torch.dtype, side: str
) -> Tensor | None:
    """Weights ``(B, N)`` of one side; ``None`` if all are equal."""
    batch, size = shape
    check_mask(mask, batch, size, name=f"mask_{side}")
    if given is None:
        if mask is None:
            return None
        return mask.to(dtype) / mask.sum(1, keepdim=True).clamp_min(1)
    name = "a" if side == "x" else "b"
    if given.shape not in ((batch, size), (size,)):
        raise ValueError(f"{name} must have shape {(batch, size)} or {(size,)}, got {tuple(given.shape)}")
    if not bool((given.detach() >= 0).all() & given.detach().isfinite().all()):
        raise ValueError(f"{name} must be finite and at least 0")
    given = given.to(dtype).expand(batch, size)
    return given if mask is None else torch.where(mask, given, 0.0)


def check_totals(mu: Tensor | None, nu: Tensor | None) -> None:
    """Balanced transport moves as much mass as there is room for; a side without any mass is let pass."""
    if mu is None and nu is None:
        return
    totals = [torch.ones(1, device="cpu") if w is None else w.detach().sum(1).cpu() for w in (mu, nu)]
    differ = (totals[0] - totals[1]).abs() > 1e-3 * totals[0].maximum(totals[1])
    if bool((differ & (totals[0] > 0) & (totals[1] > 0)).any()):
        raise ValueError(
            f"a and b must have the same sum in every sample, got {totals[0].tolist()} and {totals[1].tolist()}; "
            "normalise them, or give reach for unbalanced transport"
        )
