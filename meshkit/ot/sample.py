"""The transport plan of one sample."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from meshkit.ot.kernel import GibbsKernel
from meshkit.ot.tiles import LOG2_E, Reference

__all__: list[str] = []  # internal: meshkit.ot lists what is public


@dataclass
class SamplePlan:
    """The plan of one sample, over its rows and columns of positive weight.

    Also of several samples of one size: everything then has a leading batch dimension (see :mod:`meshkit.ot.stacked`).

    Args:
        kernel: of the sample.
        mu: ``(N,)`` row weights.
        nu: ``(M,)`` column weights.
        b: ``(M,)`` column scaling relative to ``reference``.
        reference: potentials taken into the kernel, or ``None``.
        power_x: exponent of the row scaling.
        eps: final regularisation, a number or a scalar tensor with its graph.
        shift: the cost is ``shift - eps * ln 2 * L``.
        index_x: positions of the rows in the padded batch, or ``None`` for all.
        index_y: of the columns.
        n_iters: iterations done.
        centred: potentials are given with those of the columns of mean 0. The gradient of a limit knows no free
            constant, which an upstream gradient must not ask for.
    """

    kernel: GibbsKernel
    mu: Tensor
    nu: Tensor
    b: Tensor
    reference: Reference | None
    power_x: float
    eps: float | Tensor
    shift: float
    index_x: Tensor | None
    index_y: Tensor | None
    n_iters: int
    centred: bool = False
    _sums: Tensor | None = field(default=None, repr=False)

    def detach(self) -> SamplePlan:
        """The same numbers without their graph and without a stored kernel."""
        tiles = self.kernel.tiles.transposed().transposed()  # which stores nothing
        return replace(
            self,
            kernel=GibbsKernel(tiles, *(tensor.detach() for tensor in self.kernel.inputs)),
            mu=self.mu.detach(),
            nu=self.nu.detach(),
            b=self.b.detach(),
            eps=self.eps.detach() if isinstance(self.eps, Tensor) else self.eps,
            _sums=None if self._sums is None else self._sums.detach(),
        )

    def rows(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """``K (b v)`` and ``K b`` in one sweep."""
        b = self.b[..., None]
        product = self.kernel.apply(torch.cat([b * values, b], -1), self.reference)
        if not values.requires_grad:  # else the cached sums would hold on to the graph of the values
            self._remember(product[..., -1])
        return product[..., :-1], product[..., -1:]

    def columns(self, values: Tensor) -> Tensor:
        """``Kᵀ (a v)``."""
        return self.kernel.apply(self.a[..., None] * values, self.reference, transpose=True)

    @property
    def sums(self) -> Tensor:
        """``K b``, ``(N,)``."""
        if self._sums is not None and (self._sums.requires_grad or not self._tracked()):
            return self._sums
        sums = self.kernel.apply(self.b[..., None], self.reference)[..., 0]
        self._remember(sums)
        return sums

    def _remember(self, sums: Tensor) -> None:
        if sums.requires_grad or not self._tracked():
            self._sums = sums

    def _tracked(self) -> bool:
        return torch.is_grad_enabled() and (self.b.requires_grad or self.kernel.token.requires_grad)

    @property
    def a(self) -> Tensor:
        """Row scaling relative to the reference."""
        return self.scaling(self.sums)

    def scaling(self, sums: Tensor) -> Tensor:
        """Row scaling, from the last half step ``(mu / K b) ** power_x``."""
        if self.reference is None or self.power_x == 1.0:
            return (self.mu / sums).pow(self.power_x)
        # Relative to potentials that hold the value already only the gradient is left.
        return ((self.mu / self.mu.detach()) * (sums.detach() / sums)).pow(self.power_x)

    def product(self, values: Tensor) -> Tensor:
        """``T v``."""
        product, sums = self.rows(values)
        return self.scaling(sums[..., 0])[..., None] * product

    def row_mass(self) -> Tensor:
        """Row sums ``(N,)``."""
        return self.a * self.sums

    def column_mass(self) -> Tensor:
        """Column sums ``(M,)``."""
        return self.b * self.columns(torch.ones_like(self.mu)[..., None])[..., 0]

    def logarithms(self) -> tuple[Tensor, Tensor]:
        """Natural logarithms of both scalings."""
        log_a, log_b = self.a.log(), self.b.log()
        if self.reference is not None:
            log_a = log_a + self.reference.alpha / LOG2_E
            log_b = log_b + self.reference.beta / LOG2_E
        return log_a, log_b

    def potentials(self) -> tuple[Tensor, Tensor]:
        """Dual potentials in units of the cost."""
        log_a, log_b = self.logarithms()
        f, g = self.eps * log_a + self.shift, self.eps * log_b
        if not self.centred or len(g) == 0:
            return f, g
        constant = (self.nu * g).sum() / self.nu.sum()
        return f + constant, g - constant

    def log_dense(self) -> Tensor:
        """Natural logarithm of the plan, ``(N, M)``."""
        log_a, log_b = self.logarithms()
        return self.logits() + log_a[:, None] + log_b

    def logits(self) -> Tensor:
        """Natural logits ``(N, M)``, with their graph."""
        first, *rest = self.kernel.inputs
        return (first @ rest[0].mT if rest else first) / LOG2_E

    def mean_logit(self) -> Tensor:
        """``sum_ij T_ij L_ij``, natural logits."""
        x, *rest = self.kernel.inputs
        if not rest:
            return (self.log_dense().exp() * self.logits()).sum()
        return (x * self.product(rest[0])).sum() / LOG2_E

    def cost(self) -> Tensor:
        """``sum_ij T_ij C_ij``."""
        return self.shift * self.row_mass().sum() - self.eps * self.mean_logit()

    def entropy(self) -> Tensor:
        """``-sum_ij T_ij log T_ij``, with log T = L + log a + log b."""
        log_a, log_b = self.logarithms()
        return -self.mean_logit() - (self.row_mass() * log_a).sum() - (self.column_mass() * log_b).sum()

    def heaviest(self, k: int, over_rows: bool) -> Tensor:
        """Positions of the heaviest entries of each row (or column), ``(N, k)`` or fewer."""
        with torch.no_grad(), torch.autocast(self.mu.device.type, enabled=False):
            tiles, scale = self.kernel.tiles, self.logarithms()[1] * LOG2_E
            if not over_rows:
                tiles, scale = tiles.transposed(), self.logarithms()[0] * LOG2_E
            k = min(k, tiles.shape[1])
            blocks = (tiles.raised(rows, scale) for rows in tiles.blocks)  # one at a time
            found = [b.argmax(1, keepdim=True) if k == 1 else b.topk(k, 1).indices for b in blocks]
            return torch.cat(found) if found else torch.empty(0, 0, dtype=torch.int64, device=scale.device)

    def log_masses(self, near: Tensor, over_rows: bool) -> Tensor:
        """Natural logarithms of the entries ``(N, k)`` at positions ``near`` of each row (or column)."""
        own = torch.arange(len(near), device=near.device)[:, None].expand_as(near)
        i, j = (own, near) if over_rows else (near, own)
        x, *rest = self.kernel.inputs
        if not rest:
            logits = x[i, j]
        else:
            own_side, other_side = (x, rest[0]) if over_rows else (rest[0], x)
            logits = (own_side[:, None] * other_side[near]).sum(2)
        log_a, log_b = self.logarithms()
        return logits / LOG2_E + log_a[i] + log_b[j]


def pad_columns(values: Tensor, size: int) -> Tensor:
    """``(N, size)``, with zeros beyond the given columns."""
    return torch.nn.functional.pad(values, (0, size - values.shape[1]))


def spread(values: Tensor, index: Tensor | None, size: int, empty: float) -> Tensor:
    """Rows of ``values`` put at ``index`` of ``size`` rows that hold ``empty``."""
    if index is None:
        return values
    return values.new_full((size, *values.shape[1:]), empty).index_copy(0, index, values)
