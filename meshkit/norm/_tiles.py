"""How the hand-written functions of this package walk over vertices, and when they step aside."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

ROWS = 512  # of a tile on a CPU: a few tiles of 1024 float32 channels stay in the cache between passes


def tiles(x: Tensor) -> Iterator[tuple[int, slice]]:
    """Sample and rows of each tile of ``x (B, N, C)``."""
    rows = _rows(x)
    for sample in range(len(x)):
        for start in range(0, x.shape[1], rows):
            yield sample, slice(start, min(start + rows, x.shape[1]))


def tile_buffer(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Room for one tile, to be used for all of them: fresh memory costs as much as a pass over it."""
    return torch.empty(_rows(x), x.shape[2], dtype=dtype, device=x.device)


def _rows(x: Tensor) -> int:
    """Rows of a tile; other devices than CPUs gain nothing from splitting a sample."""
    return min(ROWS, x.shape[1]) if x.device.type == "cpu" else x.shape[1]


def traced() -> bool:
    """Whether a compiler or an exporter is watching: it fuses plain formulas itself and cannot see into a function."""
    return torch.compiler.is_compiling()
