r"""The Gibbs kernel of one sample in blocks of rows, recomputed at every sweep or stored.

Logits are kept to base 2, :math:`K_{ij} = 2^{L_{ij}}`, since ``exp2`` is faster than ``exp``. Every quantity a Sinkhorn
layer needs is a sum over one side of the kernel, scaled by reference potentials where the range of the dtype asks for
it, :math:`2^{L_{ij} + \alpha_i + \beta_j}`; so one block of rows at a time is enough. Gradients with respect to the
logits have the form :math:`K \circ A B^\top` with few columns in A and B, and are contracted with the features in the
same way.
"""

from __future__ import annotations

import importlib.util
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from meshkit.ot.workspace import borrow

__all__: list[str] = []  # internal: meshkit.ot lists what is public

LOG2_E = 1 / math.log(2)
_BLOCK_BYTES = 7 << 20
_RANGE = 36.0
"""Potentials (base 2) this close may share a reference: entries lost to underflow are below 2^-54 of a row."""


class Reference(NamedTuple):
    """Potentials ``(N,)``, ``(M,)`` to base 2 and the factor of the logits: ``2 ** (scale * L + alpha + beta)``."""

    alpha: Tensor
    beta: Tensor
    scale: float = 1.0


class Factors(NamedTuple):
    """A contribution ``K_reference * (left @ right.T)`` to the gradient of the base-2 logits over ln 2."""

    left: Tensor
    right: Tensor
    reference: Reference | None


class Tiles(ABC):
    """Base-2 logits ``(N, M)`` of one sample, in blocks of rows.

    Args:
        shape: ``(N, M)``.
        like: tensor that gives dtype and device.
        store: ``"none"`` recomputes blocks, ``"kernel"`` keeps their powers of 2, ``"logits"`` keeps them as they are.
    """

    log_only = False
    """Whether iterations on the logarithm are at least as fast as on the kernel itself, so that there is no choice."""

    def __init__(self, shape: tuple[int, int], like: Tensor, store: str) -> None:
        self.shape = shape
        rows = max(1, _BLOCK_BYTES // (64 * like.element_size() * max(1, shape[1]))) * 64
        self.blocks = [slice(start, min(start + rows, shape[0])) for start in range(0, shape[0], rows)]
        self.store = store
        self.stored = None if store == "none" else borrow(self, *shape, like)
        self._filled = 0

    @abstractmethod
    def logits(self, rows: slice) -> Tensor:
        """A fresh block ``(R, M)``."""

    @abstractmethod
    def pullback(self, factors: Sequence[Factors]) -> tuple[Tensor, ...]:
        """Gradients of what the logits are computed from."""

    @abstractmethod
    def transposed(self) -> Tiles:
        """The same logits with rows and columns exchanged, not stored."""

    def kernel(self, rows: slice) -> Tensor:
        """``2 ** L``; not to be written to."""
        if self.stored is None:
            return self.logits(rows).exp2_()
        if self._filled < rows.stop:
            torch.exp2(self.logits(rows), out=self.stored[rows])
            self._filled = rows.stop
        return self.stored[rows]

    def scaled(self, rows: slice, reference: Reference) -> Tensor:
        """``2 ** (scale * L + alpha + beta)``, a fresh block."""
        block = self.raised(rows, reference.beta, reference.scale)
        return block.add_(reference.alpha[rows, None]).exp2_()

    def raised(self, rows: slice, beta: Tensor, scale: float = 1.0) -> Tensor:
        """``scale * L + beta``, a fresh block."""
        if self.store != "logits":
            block = self.logits(rows)
            return (block if scale == 1.0 else block.mul_(scale)).add_(beta)
        assert self.stored is not None
        if self._filled < rows.stop:
            self.stored[rows] = self.logits(rows)
            self._filled = rows.stop
        return torch.add(beta, self.stored[rows], alpha=scale)

    def entries(self, reference: Reference | None) -> Iterator[tuple[slice, Tensor]]:
        """Blocks of the kernel under a reference, with their rows."""
        for rows in self.blocks:
            yield rows, self.kernel(rows) if reference is None else self.scaled(rows, reference)

    def apply(self, columns: Tensor, reference: Reference | None = None) -> Tensor:
        """``K @ columns`` for ``(M, C)``."""
        out = columns.new_empty(self.shape[0], columns.shape[1])
        flat = columns.mT.contiguous()
        for rows, block in self.entries(reference):
            if len(flat) == 1:
                torch.mv(block, flat[0], out=out[rows, 0])
            else:
                out[rows] = (flat @ block.mT).mT
        return out

    def apply_transpose(self, columns: Tensor, reference: Reference | None = None) -> Tensor:
        """``K.T @ columns`` for ``(N, C)``."""
        flat = columns.mT.contiguous()
        out = columns.new_zeros(columns.shape[1], self.shape[1])
        for rows, block in self.entries(reference):
            add_transposed_product(out, block, flat[:, rows])
        return out.mT

    def log_sum_rows(self, beta: Tensor, scale: float = 1.0) -> Tensor:
        """``log2 sum_j 2 ** (scale * L_ij + beta_j)``, ``(N,)``."""
        return torch.cat([log2_sum(self.raised(rows, beta, scale), 1) for rows in self.blocks])

    def log_sum_columns(self, alpha: Tensor, scale: float = 1.0, columns: Tensor | None = None) -> Tensor:
        """``log2 sum_i 2 ** (scale * L_ij + alpha_i)`` of all columns or some."""
        beta = alpha.new_zeros(self.shape[1])
        total = alpha.new_full((self.shape[1] if columns is None else len(columns),), -math.inf)
        for rows in self.blocks:
            block = self.raised(rows, beta, scale)
            block = (block if columns is None else block[:, columns]).add_(alpha[rows, None])
            total = log2_sum(torch.stack([total, log2_sum(block, 0)]), 0)
        return total

    def log_sweep(self, beta: Tensor, log_mu: Tensor, power: float, scale: float) -> tuple[Tensor, Tensor]:
        """A whole iteration in the log domain: :meth:`log_sum_rows`, and :meth:`log_sum_columns` of what it leads to.

        With row sums r, the column sums are those at ``alpha = power * (log_mu - r)``. Rows are shifted by their
        largest entry, so nothing overflows. The column sums come from the shifted rows, whose entries underflow only
        where a row prefers other columns by far; columns that every row shuns are done again.
        """
        row_sums, gathered = torch.empty_like(log_mu), torch.zeros_like(beta)
        for rows in self.blocks:
            block = self.raised(rows, beta, scale)
            largest = block.amax(1, keepdim=True)
            block.sub_(largest).exp2_()
            row_sums[rows] = block.sum(1).log2_().add_(largest[:, 0])
            alpha = power * (log_mu[rows] - row_sums[rows])
            gathered.addmv_(block.mT, (alpha + largest[:, 0]).exp2_())
        column_sums = gathered.log2() - beta
        starved = ~((gathered > 1e-30) & (gathered < 1e30))
        if bool(starved.any()):
            chosen = starved.nonzero()[:, 0]
            column_sums[chosen] = self.log_sum_columns(power * (log_mu - row_sums), scale, chosen)
        return row_sums, column_sums


class FeatureTiles(Tiles):
    """Logits that are inner products of two sets of features, ``L = x @ y.T``."""

    def __init__(self, x: Tensor, y: Tensor, store: str) -> None:
        self.x, self.y = x.detach().contiguous(), y.detach().contiguous()
        super().__init__((len(x), len(y)), self.x, store)

    def logits(self, rows: slice) -> Tensor:
        """A fresh block ``(R, M)``."""
        return outer_product(self.x[rows], self.y)

    def transposed(self) -> Tiles:
        """Tiles of ``y @ x.T``."""
        return FeatureTiles(self.y, self.x, "none")

    def pullback(self, factors: Sequence[Factors]) -> tuple[Tensor, ...]:
        """Gradients of x and y."""
        grad_x, grad_y = torch.empty_like(self.x), torch.zeros_like(self.y)
        groups = grouped(factors)
        for rows in self.blocks:
            block = gradient_block(self, rows, groups)
            torch.mm(block, self.y, out=grad_x[rows])
            grad_y.addmm_(block.mT, self.x[rows])
        return grad_x, grad_y


class MatrixTiles(Tiles):
    """Logits given as a matrix."""

    def __init__(self, matrix: Tensor, store: str) -> None:
        self.matrix = matrix.detach()
        # The matrix itself is there, so only its powers are worth keeping.
        super().__init__((matrix.shape[0], matrix.shape[1]), self.matrix, "kernel" if store == "kernel" else "none")

    def logits(self, rows: slice) -> Tensor:
        """A fresh block ``(R, M)``."""
        return self.matrix[rows].clone()

    def transposed(self) -> Tiles:
        """Tiles of the transposed matrix."""
        return MatrixTiles(self.matrix.mT, "none")

    def pullback(self, factors: Sequence[Factors]) -> tuple[Tensor, ...]:
        """Gradient of the matrix."""
        gradient = torch.empty_like(self.matrix)
        groups = grouped(factors)
        for rows in self.blocks:
            gradient[rows] = gradient_block(self, rows, groups)
        return (gradient,)


def feature_tiles(x: Tensor, y: Tensor, store: str) -> FeatureTiles:
    """Tiles of ``x @ y.T``: where they run, Triton kernels, which store nothing; otherwise torch operations."""
    if not usable(x):
        return FeatureTiles(x, y, store)
    from meshkit.ot._triton_tiles import TritonTiles

    return TritonTiles(x, y)


def usable(x: Tensor) -> bool:
    """Whether Triton kernels can process features: float32 on a GPU that Triton knows (Ampere or newer).

    The environment variable ``MESHKIT_TRITON`` switches them off if it is 0; if it is 1, they run on the CPU as well
    in Triton's interpreter (``TRITON_INTERPRET=1``), to be tested.
    """
    switch = os.environ.get("MESHKIT_TRITON")
    if x.dtype != torch.float32 or x.numel() == 0 or switch == "0" or importlib.util.find_spec("triton") is None:
        return False
    if x.is_cuda:
        return torch.cuda.get_device_capability(x.device) >= (8, 0)
    return switch == "1" and os.environ.get("TRITON_INTERPRET") == "1"


def gradient_block(tiles: Tiles, rows: slice, groups: Sequence[Factors]) -> Tensor:
    """Rows of the gradient of the base-2 logits, ``ln 2 * sum K_reference * (left @ right.T)``."""
    total = low_rank_block(tiles, rows, groups[0])
    for group in groups[1:]:
        total += low_rank_block(tiles, rows, group)
    return total


def low_rank_block(tiles: Tiles, rows: slice, group: Factors) -> Tensor:
    """Rows of ``K_reference * (left @ right.T)``."""
    block = outer_product(group.left[rows], group.right)
    return block.mul_(tiles.kernel(rows) if group.reference is None else tiles.scaled(rows, group.reference))


def grouped(factors: Sequence[Factors]) -> list[Factors]:
    """Join contributions whose references differ little into one product each; ln 2 goes into the left factor."""
    groups: list[tuple[Reference | None, list[Tensor], list[Tensor]]] = []
    for left, right, reference in factors:
        for base, lefts, rights in groups:  # noqa: B007 (the lists of the group found, or new ones)
            if base is reference:
                break
            if base is None or reference is None:
                continue
            shift_a, shift_b = reference.alpha - base.alpha, reference.beta - base.beta
            if base.scale == reference.scale and _within(shift_a, shift_b):
                left, right = left * shift_a.exp2()[:, None], right * shift_b.exp2()[:, None]
                break
        else:
            lefts, rights = [], []
            groups.append((reference, lefts, rights))
        lefts.append(left / LOG2_E)
        rights.append(right)
    return [Factors(torch.cat(lefts, 1), torch.cat(rights, 1), base) for base, lefts, rights in groups]


def _within(*shifts: Tensor) -> bool:
    return bool((torch.stack([shift.abs().amax() for shift in shifts]) < _RANGE).all())


def log2_sum(values: Tensor, dim: int) -> Tensor:
    """``log2`` of the sum of ``2 ** values``, -inf where all values are; ``values`` may be overwritten."""
    largest = values.amax(dim, keepdim=True)
    largest = torch.where(largest == -math.inf, 0.0, largest)
    return values.sub_(largest).exp2_().sum(dim).log2_().add_(largest.squeeze(dim))


def add_transposed_product(out: Tensor, block: Tensor, flat: Tensor) -> None:
    """``out += flat @ block`` for ``flat (C, R)``; a few columns are fastest one by one."""
    if len(flat) > 8:
        out.addmm_(flat, block)
    else:
        for row, vector in zip(out, flat, strict=True):
            row.addmv_(block.mT, vector)


# oneDNN's single-precision product is 1.3 (Zen 3) to 2.7 times (Zen 5) as fast as MKL's on AMD processors.
_onednn_product = getattr(torch.ops.mkldnn, "_linear_pointwise", None) if torch.backends.mkldnn.is_available() else None


def outer_product(left: Tensor, right: Tensor) -> Tensor:
    """``left @ right.T``, a fresh tensor."""
    if _onednn_product is not None and left.device.type == "cpu" and left.dtype == torch.float32 and len(left) >= 64:
        return _onednn_product(left, right, None, "none", [], "")
    return left @ right.mT
