"""Large buffers that are used again: the first touch of fresh memory costs as much as computing what goes into it."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from typing import Any

import torch
from torch import Tensor

__all__ = ["clear_workspace"]

_LIMIT = 1 << 30
"""Bytes kept for later calls at most."""
_SMALL = 8 << 20
"""Buffers below this size are left to the allocator, which keeps them itself."""

_returned: deque[Tensor] = deque()
"""Buffers given back by finalizers, which may run at any moment, in the middle of `borrow` too: they take no lock."""
_free: list[Tensor] = []
_lock = threading.Lock()


def borrow(owner: Any, rows: int, columns: int, like: Tensor) -> Tensor:
    """Uninitialised ``(rows, columns)`` memory, handed to the next borrower once ``owner`` is no longer referenced.

    CUDA tensors come from PyTorch's caching allocator, which does the same.
    """
    numel = rows * columns
    if like.device.type != "cpu" or numel * like.element_size() < _SMALL:
        return like.new_empty(rows, columns)
    with _lock:
        _collect()
        fitting = [i for i, b in enumerate(_free) if b.dtype == like.dtype and numel <= b.numel() <= 2 * numel]
        best = min(fitting, key=lambda i: _free[i].numel(), default=None)
        buffer = None if best is None else _free.pop(best)
    if buffer is None:
        # Memory first touched in inference mode could not be written to outside of it.
        with torch.inference_mode(False):
            buffer = torch.empty(numel, dtype=like.dtype, device="cpu")
    weakref.finalize(owner, _give_back, buffer).atexit = False
    return buffer[:numel].view(rows, columns)


def _give_back(buffer: Tensor) -> None:
    _returned.append(buffer)
    # Whoever holds the lock is in `borrow` or `clear_workspace`; the next call of either collects this buffer.
    if _lock.acquire(blocking=False):
        try:
            _collect()
        finally:
            _lock.release()


def _collect() -> None:
    """Take in what was given back, and let go of the oldest beyond the limit."""
    while _returned:
        _free.append(_returned.popleft())
    while sum(b.numel() * b.element_size() for b in _free) > _LIMIT:
        _free.pop(0)


def clear_workspace() -> None:
    """Release the memory that stored kernels leave for the next call (up to 1 GiB of ordinary memory).

    Example:
        >>> clear_workspace()
    """
    with _lock:
        _collect()
        _free.clear()
