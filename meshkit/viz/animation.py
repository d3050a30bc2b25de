"""Moving pictures: bodies that turn, and sequences of frames, as GIF files."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from meshkit.io import atomic_write
from meshkit.viz._mesh import as_mesh, check_angles, check_size
from meshkit.viz.rasterizer import render

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["save_animation", "turntable"]

Picture = NDArray[np.uint8]
_LONGEST = 655.0  # seconds: a GIF counts hundredths in 16 bits


def save_animation(
    path: str | os.PathLike[str], frames: "Sequence[Picture | Image]", *, seconds: float = 0.08, loop: bool = True
) -> None:
    """Write pictures of one size as an animated GIF.

    All frames share one palette of 256 colours, taken from all of them, so that nothing flickers.

    Args:
        path: the file to write, ending in ``.gif``; its folder is made if missing.
        frames: (H, W, 3) uint8 pictures, as :func:`meshkit.viz.render` returns them, or Pillow images.
        seconds: time that each frame is shown, 0.02 to 655.
        loop: begin again at the end.

    Raises:
        ValueError: no frame, frames of unequal size or other type, another suffix, or a time below 0.02 s, which
            viewers slow down, or above 655 s.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "blink.gif"
        >>> save_animation(file, [np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 255, np.uint8)])
        >>> file.read_bytes()[:6]
        b'GIF89a'
    """
    from PIL import Image

    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"an animation is written as .gif, got {Path(path).name!r}")
    if not 0.02 <= seconds <= _LONGEST:
        raise ValueError(f"seconds must be 0.02 or more, and {_LONGEST:g} at most, got {seconds}")
    pictures = [np.asarray(frame) for frame in frames]
    if not pictures:
        raise ValueError("no frames to write")
    first = pictures[0].shape
    if 0 in first or any(p.dtype != np.uint8 or p.shape != first or p.shape[2:] != (3,) for p in pictures):
        kinds = sorted({f"{p.dtype} {p.shape}" for p in pictures})
        raise ValueError(f"frames must be uint8 (H, W, 3) of one size, got {', '.join(kinds)}")
    step = math.ceil(math.sqrt(len(pictures) / 8))  # of rows and columns: the pixels of 8 frames are enough
    seen = np.concatenate([p[::step, ::step] for p in pictures])
    palette = Image.fromarray(seen).quantize(256, method=Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    options: dict[str, Any] = {"loop": 0} if loop else {}
    with atomic_write(path) as temporary:
        images[0].save(
            temporary, save_all=True, append_images=images[1:], duration=round(1000 * seconds), disposal=1, **options
        )


def turntable(
    verts: Tensor | ArrayLike,
    faces: Tensor | ArrayLike,
    *,
    frames: int = 36,
    size: tuple[int, int] = (240, 320),
    azimuth: float = 0.0,
    elevation: float = 8.0,
    up: Literal["y", "z"] = "z",
    **options: Any,
) -> list[Picture]:
    """Pictures of a body that turns once around its vertical axis, for :func:`save_animation`.

    The body keeps its place and size from frame to frame.

    Args:
        verts: (V, 3) coordinates.
        faces: (F, 3) vertex indices.
        frames: number of pictures in one turn.
        size: width and height in pixels.
        azimuth: degrees at which the turn begins; 0 looks at the front.
        elevation: degrees above the horizon.
        up: the vertical axis.
        options: further keywords of :func:`meshkit.viz.render`, such as ``colors`` or ``shading``.

    Returns:
        ``frames`` pictures (height, width, 3) uint8.

    Raises:
        ValueError: a bad mesh or option of :func:`meshkit.viz.render`, or no frame.

    Example:
        >>> import torch
        >>> [picture.shape for picture in turntable(torch.eye(3), torch.tensor([[0, 1, 2]]), frames=2, size=(40, 60))]
        [(60, 40, 3), (60, 40, 3)]
    """
    if frames < 1:
        raise ValueError(f"a turntable needs a frame or more, got {frames}")
    points, triangles = as_mesh(verts, faces)
    check_size(size)
    check_angles(0.0, elevation)
    # The cylinder around the body looks the same from every side.
    low, high = points.min(0), points.max(0)
    middle, flat = (low + high) / 2, [0, 2 if up == "y" else 1]
    upright = 1 if up == "y" else 2
    radius = float(np.linalg.norm((points - middle)[:, flat], axis=1).max())
    rise = np.radians(elevation)
    tall = (high - low)[upright] * np.cos(rise) + 2 * radius * abs(np.sin(rise))
    scale = max(2 * radius / size[0], tall / size[1]) * min(size) * 1.04
    half = np.full(3, radius)
    half[upright] = (high - low)[upright] / 2
    view = {"scale": float(scale) or 1.0, "bounds": np.stack([middle - half, middle + half]), **options}
    return [
        render(points, triangles, azimuth=azimuth + 360 * i / frames, elevation=elevation, up=up, size=size, **view)
        for i in range(frames)
    ]
