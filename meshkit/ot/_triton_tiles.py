"""The sweeps of a Sinkhorn layer as Triton kernels, for features on a GPU.

A program takes a block of rows and walks over the columns, as attention kernels do: logits live in registers for as
long as they are needed. Columns are divided among several programs where rows alone would leave multiprocessors idle;
their partial results are joined in a fixed order, so that results do not change from run to run. Sums over rows are
sums over columns with the sets of features exchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from meshkit.ot.tiles import Factors, FeatureTiles, Reference, grouped, log2_sum

_PROGRAMS = 8
"""Programs per multiprocessor: it holds two to four at a time, and the last of them should end together."""
_DEPTH = 32
"""Features taken into a block of logits at a time."""
_RANK = 16
"""Columns of the factors taken into a block at a time; products on tensor cores need 16."""
_ROWS = _COLUMNS = 64
"""Size of a block of logits."""
_WIDTH = 128
"""Largest number of columns summed up by one program: more would not fit into its registers."""
_SIZES = ["n", "m", "rank"]
"""Kernels are compiled once for all values of these: meshes of a batch differ in size."""


@triton.jit
def _inner_products(
    left: tl.tensor,
    right: tl.tensor,
    i: tl.tensor,
    j: tl.tensor,
    n: tl.tensor,
    m: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    DEPTH: tl.constexpr,
    PRECISION: tl.constexpr,
) -> tl.tensor:
    """Block ``(ROWS, COLUMNS)`` of ``left @ right.T`` for row-major ``(n, width)`` and ``(m, width)``."""
    k = tl.arange(0, DEPTH)
    lefts = left + i.to(tl.int64)[:, None] * width + k[None, :]
    rights = right + j.to(tl.int64)[None, :] * width + k[:, None]
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for start in range(0, width, DEPTH):
        within = start + k < width
        a = tl.load(lefts + start, mask=(i < n)[:, None] & within[None, :], other=0.0)
        b = tl.load(rights + start, mask=(j < m)[None, :] & within[:, None], other=0.0)
        total = tl.dot(a, b, total, input_precision=PRECISION)
    return total


@triton.jit(do_not_specialize=_SIZES)
def _log_sums(
    x: tl.tensor,
    y: tl.tensor,
    beta: tl.tensor,
    out: tl.tensor,
    n: tl.tensor,
    m: tl.tensor,
    d: tl.tensor,
    scale: tl.tensor,
    span: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    DEPTH: tl.constexpr,
    PRECISION: tl.constexpr,
) -> None:
    """``out[s, i] = log2 sum_j 2 ** (scale * x_i . y_j + beta_j)`` over the s-th ``span`` of columns."""
    i = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    first = tl.program_id(1) * span
    largest = tl.full([ROWS], float("-inf"), tl.float32)
    total = tl.zeros([ROWS], tl.float32)
    for start in range(first, tl.minimum(first + span, m), COLUMNS):
        j = start + tl.arange(0, COLUMNS)
        shift = tl.load(beta + j, mask=j < m, other=float("-inf"))
        logits = _inner_products(x, y, i, j, n, m, d, ROWS, COLUMNS, DEPTH, PRECISION) * scale + shift[None, :]
        higher = tl.maximum(largest, tl.max(logits, 1))
        origin = tl.where(higher == float("-inf"), 0.0, higher)
        total = total * tl.exp2(largest - origin) + tl.sum(tl.exp2(logits - origin[:, None]), 1)
        largest = higher
    origin = tl.where(largest == float("-inf"), 0.0, largest)
    tl.store(out + tl.program_id(1) * n + i, origin + tl.log2(total), mask=i < n)


@triton.jit(do_not_specialize=_SIZES)
def _products(
    x: tl.tensor,
    y: tl.tensor,
    alpha: tl.tensor,
    beta: tl.tensor,
    left: tl.tensor,
    right: tl.tensor,
    values: tl.tensor,
    out: tl.tensor,
    n: tl.tensor,
    m: tl.tensor,
    d: tl.tensor,
    rank: tl.tensor,
    c: tl.tensor,
    scale: tl.tensor,
    span: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    DEPTH: tl.constexpr,
    RANK: tl.constexpr,
    WIDTH: tl.constexpr,
    PRECISION: tl.constexpr,
) -> None:
    """``out[s] = (K * (left @ right.T)) @ values`` over the s-th ``span`` of columns, without factors if RANK is 0.

    K is ``2 ** (scale * x_i . y_j + alpha_i + beta_j)``, ``values`` are ``(m, c)``, ``WIDTH`` columns to a program.
    """
    i = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    k = tl.program_id(2) * WIDTH + tl.arange(0, WIDTH)
    first = tl.program_id(1) * span
    offset = tl.load(alpha + i, mask=i < n, other=0.0)
    total = tl.zeros([ROWS, WIDTH], tl.float32)
    for start in range(first, tl.minimum(first + span, m), COLUMNS):
        j = start + tl.arange(0, COLUMNS)
        shift = tl.load(beta + j, mask=j < m, other=float("-inf"))
        logits = _inner_products(x, y, i, j, n, m, d, ROWS, COLUMNS, DEPTH, PRECISION) * scale
        entries = tl.exp2(logits + shift[None, :] + offset[:, None])
        if RANK > 0:
            entries *= _inner_products(left, right, i, j, n, m, rank, ROWS, COLUMNS, RANK, PRECISION)
        places = values + j.to(tl.int64)[:, None] * c + k[None, :]
        block = tl.load(places, mask=(j < m)[:, None] & (k < c)[None, :], other=0.0)
        if WIDTH == 1:
            total += tl.sum(entries * tl.trans(block), 1)[:, None]
        else:
            total = tl.dot(entries, block, total, input_precision=PRECISION)
    places = out + (tl.program_id(1) * n + i).to(tl.int64)[:, None] * c + k[None, :]
    tl.store(places, total, mask=(i < n)[:, None] & (k < c)[None, :])


class TritonTiles(FeatureTiles):
    """Logits ``L = x @ y.T`` of float32 features, computed again at every sweep and never stored.

    Args:
        x: ``(N, D)``.
        y: ``(M, D)``.
        precision: of products: ``"ieee"``, ``"tf32"`` or ``"tf32x3"`` (three products on tensor cores, close to
            float32). What PyTorch's settings allow its own products by default.
    """

    log_only = True

    def __init__(self, x: Tensor, y: Tensor, *, precision: str | None = None) -> None:
        super().__init__(x, y, "none")
        self.precision = matmul_precision() if precision is None else precision

    def apply(self, columns: Tensor, reference: Reference | None = None) -> Tensor:
        """``K @ columns`` for ``(M, C)``."""
        return self._product(self._side(reference), columns)

    def apply_transpose(self, columns: Tensor, reference: Reference | None = None) -> Tensor:
        """``K.T @ columns`` for ``(N, C)``."""
        return self._product(self._side(reference).flipped(), columns)

    def log_sum_rows(self, beta: Tensor, scale: float = 1.0) -> Tensor:
        """``log2 sum_j 2 ** (scale * L_ij + beta_j)``, ``(N,)``."""
        return self._log_sums(self.x, self.y, beta, scale)

    def log_sum_columns(self, alpha: Tensor, scale: float = 1.0, columns: Tensor | None = None) -> Tensor:
        """``log2 sum_i 2 ** (scale * L_ij + alpha_i)`` of all columns or some."""
        return self._log_sums(self.y if columns is None else self.y[columns], self.x, alpha, scale)

    def log_sweep(self, beta: Tensor, log_mu: Tensor, power: float, scale: float) -> tuple[Tensor, Tensor]:
        """A whole iteration in the log domain; columns have maxima of their own, so that none is starved."""
        row_sums = self.log_sum_rows(beta, scale)
        return row_sums, self.log_sum_columns(power * (log_mu - row_sums), scale)

    def pullback(self, factors: Sequence[Factors]) -> tuple[Tensor, ...]:
        """Gradients of x and y."""
        grad_x, grad_y = torch.zeros_like(self.x), torch.zeros_like(self.y)
        for left, right, reference in grouped(factors):
            side = self._side(reference)
            grad_x += self._product(side, self.y, (left, right))
            grad_y += self._product(side.flipped(), self.x, (right, left))
        return grad_x, grad_y

    def _side(self, reference: Reference | None) -> _Side:
        if reference is None:
            return _Side(self.x, self.y, self.x.new_zeros(self.shape[0]), self.x.new_zeros(self.shape[1]), 1.0)
        return _Side(self.x, self.y, *reference)

    def _log_sums(self, x: Tensor, y: Tensor, beta: Tensor, scale: float) -> Tensor:
        n, m, d = len(x), len(y), x.shape[1]
        splits, span = divide(n, m, x.device)
        out = x.new_empty(splits, n)
        with torch.cuda.device_of(x):
            _log_sums[triton.cdiv(n, _ROWS), splits](
                x,
                y,
                beta.contiguous(),
                out,
                n,
                m,
                d,
                scale,
                span,
                ROWS=_ROWS,
                COLUMNS=_COLUMNS,
                DEPTH=_DEPTH,
                PRECISION=self.precision,
                num_warps=4,
            )
        return out[0] if splits == 1 else log2_sum(out, 0)

    def _product(self, side: _Side, values: Tensor, factors: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """``(K * (left @ right.T)) @ values`` as the given side sees it."""
        n, m, d, c = len(side.x), len(side.y), side.x.shape[1], values.shape[1]
        splits, span = divide(n, m, side.x.device)
        out = side.x.new_empty(splits, n, c)
        left, right = (t.contiguous() for t in factors or (side.x, side.y))
        # Up to 16 columns cost the same, except that a single one needs no product.
        width = 1 if c == 1 else min(_WIDTH, max(16, triton.next_power_of_2(c)))
        with torch.cuda.device_of(side.x):
            _products[triton.cdiv(n, _ROWS), splits, triton.cdiv(c, width)](
                side.x,
                side.y,
                side.alpha.contiguous(),
                side.beta.contiguous(),
                left,
                right,
                values.contiguous(),
                out,
                n,
                m,
                d,
                left.shape[1],
                c,
                side.scale,
                span,
                ROWS=_ROWS,
                COLUMNS=_COLUMNS,
                DEPTH=_DEPTH,
                RANK=0 if factors is None else _RANK,
                WIDTH=width,
                PRECISION=self.precision,
                num_warps=8 if width > 32 else 4,
                num_stages=2 if width > 32 else 3,  # a third would spill registers
            )
        return out[0] if splits == 1 else out.sum(0)


class _Side(NamedTuple):
    """A kernel ``2 ** (scale * x @ y.T + alpha + beta)``, as its rows see it."""

    x: Tensor
    y: Tensor
    alpha: Tensor
    beta: Tensor
    scale: float

    def flipped(self) -> _Side:
        """The transposed kernel."""
        return _Side(self.y, self.x, self.beta, self.alpha, self.scale)


def divide(rows: int, columns: int, device: torch.device) -> tuple[int, int]:
    """Among how many programs to divide the columns of a block of rows, and how many columns each takes."""
    processors = torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 1
    blocks = triton.cdiv(columns, _COLUMNS)
    splits = max(1, min(blocks, _PROGRAMS * processors // triton.cdiv(rows, _ROWS)))
    span = triton.cdiv(blocks, splits) * _COLUMNS
    return triton.cdiv(columns, span), span


def matmul_precision() -> str:
    """``"tf32"`` where PyTorch may use it for products of float32 matrices on a GPU, ``"ieee"`` otherwise."""
    settings = torch.backends.cuda.matmul
    # The newer setting must be preferred: once it was used, the older one can no longer be read.
    tf32 = settings.fp32_precision == "tf32" if hasattr(settings, "fp32_precision") else settings.allow_tf32
    return "tf32" if tf32 else "ieee"
