"""How the hand-written functions of this package walk over vertices, and when they step aside."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from meshkit._numerics import launch_bound

ROWS = 512  # of a tile on a CPU: a few tiles of 1024 float32 channels stay in the cache between passes


def samples_per_tile(x: Tensor) -> int:
    """How many whole samples a tile on a CPU spans; 0 if a sample fills at least one by itself."""
    together = ROWS // max(1, x.shape[1])
    return together if together > 1 and len(x) > 1 else 0


def tiles(x: Tensor) -> Iterator[tuple[int | slice, slice]]:
    """Samples and rows of each tile of ``x (B, N, C)``.

    On a CPU a tile is some rows of one sample, ``(R, C)``, or, where these are few, some whole samples ``(S, N, C)``,
    since starting an operation then costs more than running it. Elsewhere each operation costs a launch and there is no
    cache to stay in: the only tile is the batch, ``(B, N, C)``.
    """
    if launch_bound(x):
        yield slice(None), slice(None)
        return
    if together := samples_per_tile(x):
        for start in range(0, len(x), together):
            yield slice(start, min(start + together, len(x))), slice(None)
        return
    for sample in range(len(x)):
        for start in range(0, x.shape[1], ROWS):
            yield sample, slice(start, min(start + ROWS, x.shape[1]))


def tile_buffer(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Room for one tile, to be used for all of them: fresh memory costs as much as a pass over it."""
    shape: tuple[int, ...] = x.shape
    if not launch_bound(x):
        together = samples_per_tile(x)
        shape = (min(together, len(x)), *x.shape[1:]) if together else (min(ROWS, x.shape[1]), x.shape[2])
    return torch.empty(shape, dtype=dtype, device=x.device)


def fill(buffer: Tensor, x: Tensor) -> Tensor:
    """The part of a tile's buffer that a tile as large as ``x`` takes."""
    return buffer[: len(x)]


def traced() -> bool:
    """Whether a compiler or an exporter is watching: it fuses plain formulas itself and cannot see into a function."""
    return torch.compiler.is_compiling()
