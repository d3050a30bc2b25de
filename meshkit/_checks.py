"""What the layers ask of the features they are given; the messages say what came and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import torch
from torch import Tensor, nn


def check_whole(value: Any, name: str, *, least: int = 1) -> None:
    """Check that a number of something is a whole number, not less than ``least``."""
    if not isinstance(value, Integral) or int(value) < least:
        raise ValueError(f"{name} must be a whole number, at least {least}, got {value!r}")


def check_widths(widths: Any, name: str = "widths") -> None:
    """Check that the widths of layers are one or more positive whole numbers."""
    some = isinstance(widths, Sequence) and len(widths) > 0
    if not some or not all(isinstance(width, Integral) and int(width) > 0 for width in widths):
        given = tuple(widths) if isinstance(widths, Sequence) else widths
        raise ValueError(f"{name} must be at least one positive whole number of channels, as (64, 128), got {given!r}")


def check_features(x: Any, *, name: str = "x", layout: str = "(B, N, C)") -> None:
    """Check that ``x`` is a batch of vertex features.

    Raises:
        TypeError: no tensor.
        ValueError: not three dimensions.
    """
    if not isinstance(x, Tensor):
        hint = "; convert it with torch.from_numpy" if type(x).__module__ == "numpy" else ""
        raise TypeError(f"{name} must be a tensor {layout}, got {'None' if x is None else type(x).__name__}{hint}")
    if x.dim() != 3:
        one = f", or {name}[:, None] if each row is of one sample" if name == "cond" else ""
        hint = f"; add the batch dimension with {name}[None]{one}" if x.dim() == 2 else ""
        raise ValueError(f"{name} must have shape {layout}, got {tuple(x.shape)}{hint}")


def check_channels(x: Tensor, channels: int, *, name: str = "x") -> None:
    """Check the last dimension of features ``(B, N, C)``."""
    if x.shape[2] != channels:
        first = x.shape[1] == channels
        hint = f"; the channels come last here: transpose it with {name}.mT" if first else ""
        raise ValueError(f"expected {name} with {channels} channels (B, N, {channels}), got {tuple(x.shape)}{hint}")


def check_descriptors(descriptors: Tensor | None, positions: Tensor, channels: int) -> None:
    """Check what comes beside positions ``(B, N, 3)``: descriptors of so many channels, or none for 0."""
    if descriptors is not None:
        check_features(descriptors, name="descriptors", layout="(B, N, D)")
        if descriptors.shape[:2] != positions.shape[:2]:
            raise ValueError(
                f"descriptors (B, N, D) and positions (B, N, 3) must agree in B and N, got "
                f"{tuple(descriptors.shape)} and {tuple(positions.shape)}"
            )
    given = 0 if descriptors is None else descriptors.shape[2]
    if given != channels:
        raise ValueError(
            f"this extractor takes {channels} descriptor channels, got {given}"
            + ("" if given else ": compute them with meshkit.descriptors.intrinsic_descriptors")
        )


def check_dtype(x: Tensor, module: nn.Module, *, name: str = "x") -> None:
    """Check that features and parameters have one dtype; autocast converts them itself."""
    own = next(module.parameters(), None)
    if own is not None and own.dtype != x.dtype and not torch.is_autocast_enabled(x.device.type):
        raise TypeError(
            f"{name} is {x.dtype}, but the parameters of {type(module).__name__} are {own.dtype}: convert one of them, "
            f"as with {name}.to({own.dtype})"
        )
