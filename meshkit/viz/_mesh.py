"""What every kind of picture shares: checked arrays, the camera, the projection to pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

Array = NDArray[np.float64]

CLAY = (0.69, 0.77, 0.88)
GAMMA = 2.2
_MARGIN = 1.08  # picture side over the extent of the body, when neither scale nor bounds is given


def as_array(values: Tensor | ArrayLike) -> Array:
    try:
        return np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"an array of numbers is needed, got {type(values).__name__}: {error}") from None


def as_mesh(verts: Tensor | ArrayLike, faces: Tensor | ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    """One checked mesh as arrays."""
    points, corners = as_array(verts), as_array(faces)
    if not (np.isfinite(corners) & (np.abs(corners) < 2**53)).all() or (corners % 1).any():
        raise ValueError("faces must be whole numbers: the vertices at their corners, counted from 0")
    triangles = corners.astype(np.int64)
    check_mesh(points, triangles)
    return points, triangles


def as_named_mesh(name: str, given: Any) -> tuple[Array, NDArray[np.int64]]:
    """A checked mesh of several, which errors name."""
    if isinstance(given, Tensor) or not isinstance(given, Sequence) or len(given) != 2:
        raise ValueError(f"mesh {name!r} must be (verts, faces), got {type(given).__name__}")
    try:
        return as_mesh(*given)
    except ValueError as error:
        raise ValueError(f"mesh {name!r}: {error}") from None


def check_size(size: tuple[int, int]) -> None:
    if not isinstance(size, Sequence) or len(size) != 2 or not all(isinstance(n, int | np.integer) for n in size):
        raise ValueError(f"size must be the width and height in pixels, two whole numbers, got {size!r}")
    if min(size) < 1:
        raise ValueError(f"size must be at least 1, got {size}")


def check_angles(azimuth: float, elevation: float) -> None:
    if not np.isfinite([azimuth, elevation]).all():
        raise ValueError(f"azimuth and elevation must be finite degrees, got {azimuth} and {elevation}")


def check_mesh(points: Array, triangles: NDArray[np.int64]) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"one mesh is verts (V, 3) and faces (F, 3), got {points.shape} and {triangles.shape}")
    if len(points) == 0 or len(triangles) == 0:
        raise ValueError(f"nothing to draw: {len(points)} vertices and {len(triangles)} faces")
    bad = int((~np.isfinite(points)).any(1).sum())
    if bad:
        raise ValueError(f"{bad} of {len(points)} vertices {'has' if bad == 1 else 'have'} NaN or infinite coordinates")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(
            f"face indices run from {triangles.min()} to {triangles.max()}, but there are {len(points)} vertices; "
            "remove the padding first"
        )


def check_colors(points: Array, colors: Array) -> None:
    """Raise unless there is one RGB colour per vertex."""
    if colors.shape != points.shape or not ((colors >= 0) & (colors <= 1)).all():
        raise ValueError(f"colors must be (V, 3) = {points.shape} with values in [0, 1], got shape {colors.shape}")


@dataclass(frozen=True)
class View:
    """An orthographic camera over a picture of ``size`` (width, height) pixels."""

    axes: Array  # rows right, up, backward
    center: Array  # point shown in the middle, in camera axes
    pixels_per_unit: float
    size: tuple[int, int]

    def project(self, points: Array) -> Array:
        """Pixels x to the right, y down, and depth in pixels, larger nearer: (V, 3)."""
        pixels = (points @ self.axes.T - self.center) * self.pixels_per_unit
        pixels[:, 0] += self.size[0] / 2
        pixels[:, 1] = self.size[1] / 2 - pixels[:, 1]
        return np.asarray(pixels)


def fit_view(
    points: Array,
    size: tuple[int, int],
    *,
    azimuth: float,
    elevation: float,
    up: str,
    scale: float | None = None,
    bounds: Tensor | ArrayLike | None = None,
) -> View:
    """Camera that shows all points, or ``scale`` units along the shorter side, or the box ``bounds``."""
    if up not in {"y", "z"}:
        raise ValueError(f"up must be 'y' or 'z', got {up!r}")
    check_size(size)
    check_angles(azimuth, elevation)
    if scale is not None and not 0 < scale < np.inf:
        raise ValueError(f"scale must be a length above 0, got {scale}")
    axes = _camera(azimuth, elevation, up)
    framed = (points if bounds is None else _box_corners(bounds)) @ axes.T
    low, high = framed.min(0), framed.max(0)
    if scale is None:
        extent = (high - low)[:2] * min(size) / np.array(size)
        scale = float(extent.max()) * _MARGIN or 1.0
    return View(axes, (low + high) / 2, min(size) / scale, size)


def _box_corners(bounds: Tensor | ArrayLike) -> Array:
    box = as_array(bounds)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
        raise ValueError(f"bounds must be a finite (2, 3) lowest and highest corner, got {box.tolist()}")
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)


def _camera(azimuth: float, elevation: float, up: str) -> Array:
    """Rotation whose rows are the camera's right, up and backward axes in the coordinates of the mesh."""
    turn, rise = np.radians(azimuth), np.radians(elevation)
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    backward = np.array([np.sin(turn) * np.cos(rise), -np.cos(turn) * np.cos(rise), np.sin(rise)])
    axes = np.stack([right, np.cross(backward, right), backward])
    if up == "y":  # (x, y, z) with y up is (x, -z, y) with z up
        axes = axes @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return axes
