"""What a module prints of itself."""

from __future__ import annotations

from torch import nn


def settings(module: nn.Module, *names: str) -> str:
    """``name=value`` of attributes, for ``extra_repr``."""
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in names)
