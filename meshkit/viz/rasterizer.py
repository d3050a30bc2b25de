"""An orthographic z-buffer renderer in NumPy: no window, no GPU, the same picture on every machine."""

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from meshkit.viz._mesh import CLAY, GAMMA, Array, as_array, as_mesh, check_colors, check_size, fit_view

__all__ = ["error_colors", "render"]

_CHUNK = 2**16  # candidate pixels expanded at a time; bounds the memory of large pictures, and stays in the cache

# Camera space: x right, y up, z towards the viewer. Direction, strength.
_KEY = ((-0.55, 0.60, 0.58), 0.88)
_FILL = ((0.80, 0.05, 0.60), 0.20)
_AMBIENT = (0.07, 0.24)  # light from below, from above
_INSIDE = 0.45  # brightness of surfaces seen from behind


def render(
    verts: Tensor | ArrayLike,
    faces: Tensor | ArrayLike,
    *,
    size: tuple[int, int] = (320, 320),
    colors: Tensor | ArrayLike | None = None,
    azimuth: float = 20.0,
    elevation: float = 8.0,
    up: Literal["y", "z"] = "z",
    shading: Literal["smooth", "flat", "none"] = "smooth",
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    supersample: int = 2,
    scale: float | None = None,
    bounds: Tensor | ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Draw a triangle mesh with an orthographic camera.

    Azimuth 0 looks at the front of a shipped body (which faces -y when z is up, and +z when y is up), so that its left
    hand is on the right of the picture. The lights move with the camera. Surfaces seen from inside are darkened.

    Args:
        verts: (V, 3) coordinates.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside.
        size: width and height of the picture in pixels.
        colors: (V, 3) RGB in [0, 1] per vertex, interpolated over the faces; a light grey-blue when omitted.
        azimuth: degrees that the camera walks around the body, towards the body's left.
        elevation: degrees that the camera rises above the horizon.
        up: the vertical axis of the coordinates.
        shading: ``smooth`` interpolates vertex normals, ``flat`` uses face normals, ``none`` shows ``colors`` unlit.
        background: RGB in [0, 1].
        supersample: samples per pixel and axis.
        scale: length, in the unit of ``verts``, spanned by the shorter side of the picture. Give the same number to
            several pictures to compare sizes. Fitted to the body, or to ``bounds``, when omitted.
        bounds: (2, 3) lowest and highest corner of a box to frame instead of the body. Give the same box to several
            pictures to compare places as well.

    Returns:
        (height, width, 3) uint8 picture.

    Raises:
        ValueError: empty mesh, wrong shapes, coordinates or colours that are not finite, an index out of range, an
            unknown option.

    Example:
        >>> import torch
        >>> picture = render(torch.eye(3), torch.tensor([[0, 1, 2]]), size=(64, 48))
        >>> picture.shape, picture.dtype
        ((48, 64, 3), dtype('uint8'))
    """
    points, triangles = as_mesh(verts, faces)
    albedo = np.broadcast_to(CLAY, points.shape) if colors is None else as_array(colors)
    check_colors(points, albedo)
    if shading not in {"smooth", "flat", "none"}:
        raise ValueError(f"shading must be 'smooth', 'flat' or 'none', got {shading!r}")
    check_size(size)
    if supersample < 1:
        raise ValueError(f"supersample must be at least 1, got {supersample}")
    paper = as_array(background)
    if paper.shape != (3,) or not ((paper >= 0) & (paper <= 1)).all():
        raise ValueError(f"background must be RGB in [0, 1], got {background}")

    width, height = size[0] * supersample, size[1] * supersample
    view = fit_view(points, (width, height), azimuth=azimuth, elevation=elevation, up=up, scale=scale, bounds=bounds)
    picture = np.tile(paper, (width * height, 1))
    hit, face, barycentric = rasterize(view.project(points), triangles, width, height)
    corner = triangles[face]
    color = np.einsum("pk,pkc->pc", barycentric, albedo[corner])
    if shading != "none":
        face_normals, vertex_normals = _normals(points @ view.axes.T, triangles)
        smooth = np.einsum("pk,pkc->pc", barycentric, vertex_normals[corner])
        color = _shade(color, smooth if shading == "smooth" else face_normals[face], face_normals[face, 2] < 0)
    picture[hit] = color
    blocks = picture.reshape(size[1], supersample, size[0], supersample, 3).mean((1, 3))
    return np.rint(blocks.clip(0, 1) * 255).astype(np.uint8)


def error_colors(error: Tensor | ArrayLike, vmax: float) -> Array:
    """Colour per vertex of a per-vertex error: light cream at 0, dark violet at ``vmax`` and beyond.

    The colours are those of matplotlib's ``magma``, reversed, so that a correct body stays light and shows its shading;
    equal steps of error look equal.

    Args:
        error: (V,) errors, in any unit.
        vmax: the error shown in the last colour, in the same unit.

    Returns:
        (V, 3) RGB in [0, 1].

    Raises:
        ValueError: an error that is not finite, another shape, or ``vmax`` not above 0.

    Example:
        >>> error_colors([0.0, 0.01, 0.02, 0.5], vmax=0.02).mean(1).round(1).tolist()
        [0.9, 0.5, 0.2, 0.2]
    """
    import matplotlib

    values = as_array(error)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise ValueError(f"error must be (V,) finite numbers, got shape {values.shape}")
    if not vmax > 0:
        raise ValueError(f"vmax must be above 0, got {vmax}")
    level = 0.85 * (values / vmax).clip(0, 1)  # the last part of the map is too dark to show shading
    return np.asarray(matplotlib.colormaps["magma_r"](level))[:, :3]


def rasterize(
    points: Array, triangles: NDArray[np.int64], width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Covered pixels (P,), the nearest face at each (P,), and the barycentric coordinates there (P, 3).

    ``points`` are pixels (x right, y down) and depth (larger is nearer). A pixel is covered when its centre lies in the
    closed triangle, so that neighbours leave no crack; among faces at one pixel the nearest wins.
    """
    corner = points[triangles]
    x, y, depth = corner[..., 0], corner[..., 1], corner[..., 2]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    low = np.maximum(np.ceil(corner[..., :2].min(1) - 0.5), 0).astype(np.int64)
    high = np.minimum(np.floor(corner[..., :2].max(1) - 0.5), (width - 1, height - 1)).astype(np.int64)
    box = np.maximum(high - low + 1, 0)
    drawn = np.flatnonzero((box.prod(1) > 0) & (np.abs(area) > 1e-12))
    counts = box[drawn].prod(1)

    nearest = np.full(width * height, -np.inf)
    owner = np.full(width * height, -1, dtype=np.int64)
    weights = np.zeros((width * height, 3))
    ends = np.cumsum(counts)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(ends // _CHUNK)) + 1, [len(drawn)]])
    for first, last in pairwise(starts):
        # One array per coordinate: columns of a (P, 3) array are slow to combine.
        faces, count = drawn[first:last], counts[first:last]
        which = np.repeat(np.arange(len(faces)), count)
        offset = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        row, column = np.divmod(offset, box[faces, 0][which])
        row, column = row + low[faces, 1][which], column + low[faces, 0][which]
        dx = [x[faces, k][which] - (column + 0.5) for k in range(3)]
        dy = [y[faces, k][which] - (row + 0.5) for k in range(3)]
        inverse = (1 / area[faces])[which]
        inner = [(dx[i] * dy[j] - dx[j] * dy[i]) * inverse for i, j in ((1, 2), (2, 0), (0, 1))]
        inside = np.flatnonzero((inner[0] >= -1e-9) & (inner[1] >= -1e-9) & (inner[2] >= -1e-9))
        face, pixel = faces[which[inside]], (row * width + column)[inside]
        inner = [weight[inside] for weight in inner]
        distance = inner[0] * depth[face, 0] + inner[1] * depth[face, 1] + inner[2] * depth[face, 2]
        np.maximum.at(nearest, pixel, distance)
        won = distance == nearest[pixel]
        owner[pixel[won]], weights[pixel[won]] = face[won], np.stack(inner, axis=1)[won]
    hit = np.flatnonzero(owner >= 0)
    return hit, owner[hit], weights[hit]


def _normals(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, Array]:
    """Unit face normals (F, 3) and area-weighted vertex normals (V, 3)."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    sums = [np.bincount(triangles.reshape(-1), np.repeat(axis, 3), len(points)) for axis in cross.T]
    return _unit(cross), _unit(np.stack(sums, axis=1))


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _shade(color: Array, normals: Array, inside: NDArray[np.bool_]) -> Array:
    """Key light, soft fill, light from the sky and a faint highlight, added in linear light."""
    normals = _unit(np.where(inside[:, None], -normals, normals))
    light = _AMBIENT[0] + (_AMBIENT[1] - _AMBIENT[0]) * (0.5 + 0.5 * normals[:, 1])
    for direction, strength in (_KEY, _FILL):
        light = light + strength * (normals @ _unit(np.array(direction))).clip(0)
    light = light * np.where(inside, _INSIDE, 1.0)
    halfway = _unit(_unit(np.array(_KEY[0])) + np.array([0.0, 0.0, 1.0]))
    gloss = 0.05 * (normals @ halfway).clip(0) ** 24 * ~inside
    return np.asarray((color**GAMMA * light[:, None] + gloss[:, None]).clip(0, 1) ** (1 / GAMMA))
