"""Figures of correspondences: colours carried from one body to another, and lines between matching points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from meshkit.viz._mesh import Array, View, as_array, as_named_mesh, fit_view
from meshkit.viz.rasterizer import rasterize, render

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["correspondence_figure", "position_colors", "transfer_colors"]

_WRONG = (200, 40, 40)
_SHARP = 3  # lines are drawn at this multiple of the picture and reduced
_ALIKE = 3.0  # bodies whose sizes differ by more are not drawn at one scale
MeshLike = tuple[Tensor | ArrayLike, Tensor | ArrayLike]


def position_colors(verts: Tensor | ArrayLike) -> Array:
    """A colour per vertex that says where it is.

    Hue runs along the longest axis; along the second one, left to right for a standing body, colours grow pale, and
    along the third they grow bright. So a match that confuses left and right shows.

    Args:
        verts: (V, 3) coordinates.

    Returns:
        (V, 3) RGB in [0, 1], smooth over the surface.

    Raises:
        ValueError: another shape, no vertex, or coordinates that are not finite.

    Example:
        >>> position_colors([[0, 0, 0], [1, 2, 3]]).shape
        (2, 3)
    """
    points = as_array(verts)
    if points.ndim != 2 or points.shape[1:] != (3,) or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"verts must be finite (V, 3) coordinates of a vertex or more, got shape {points.shape}")
    along, across, deep = np.argsort(-np.ptp(points, axis=0), kind="stable")
    # Ranks tell a left leg from a right one, which lie close together within the span of the arms.
    hue = 0.70 * _share(points[:, along]) + 0.12 * _rank(points[:, across])
    base = 0.5 + 0.5 * np.cos(2 * np.pi * (hue[:, None] - np.array([0.0, 1 / 3, 2 / 3])))
    white = (0.05 + 0.60 * _rank(points[:, across]))[:, None]
    bright = (0.72 + 0.28 * _rank(points[:, deep]))[:, None]
    return np.asarray(bright * ((1 - white) * base + white)).clip(0, 1)


def transfer_colors(colors: Tensor | ArrayLike, matches: Tensor | ArrayLike) -> Array:
    """Colours carried along a correspondence: each vertex takes the colour of the vertex that it matches.

    Args:
        colors: (M, 3) colours of the vertices matched to.
        matches: (N,) the match of every vertex, as the ``argmax`` of a plan gives it; or (N, M) weights, whose rows are
            normalised, for soft matches. A row without weight is grey.

    Returns:
        (N, 3) RGB.

    Raises:
        ValueError: shapes that do not fit, an index out of range, or weights that are negative or not finite.

    Example:
        >>> transfer_colors([[1.0, 0, 0], [0, 0, 1]], [1, 1, 0]).tolist()
        [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    """
    palette, weights = as_array(colors), as_array(matches)
    if palette.ndim != 2 or palette.shape[1] != 3:
        raise ValueError(f"colors must be (M, 3), got {palette.shape}")
    if weights.ndim == 2:
        if weights.shape[1] != len(palette) or not (np.isfinite(weights).all() and (weights >= 0).all()):
            raise ValueError(f"soft matches must be (N, {len(palette)}) weights of 0 or more, got {weights.shape}")
        total = weights.sum(1, keepdims=True)
        return np.where(total > 0, weights @ palette / np.where(total > 0, total, 1), 0.5)
    return palette[_match_indices(weights, len(palette))]


def correspondence_figure(
    source: MeshLike,
    target: MeshLike,
    matches: Tensor | ArrayLike,
    *,
    correct: Tensor | ArrayLike | None = None,
    colors: Tensor | ArrayLike | None = None,
    lines: int = 30,
    size: tuple[int, int] = (360, 480),
    azimuth: float = 20.0,
    elevation: float = 8.0,
    up: Literal["y", "z"] = "z",
    titles: Sequence[str] | None = None,
) -> "Image":
    """Two bodies side by side, the left one in the colours of its matches on the right one, and lines between them.

    They are drawn at one scale; where one is more than three times the other's size, as bodies of different units are,
    each is drawn at its own.

    A good correspondence paints both bodies alike and its lines do not cross without reason. The lines start at points
    spread evenly over the part of the source that is seen, whose matches are seen as well.

    Args:
        source: ``(verts (N, 3), faces)`` of the body on the left.
        target: ``(verts (M, 3), faces)`` of the body on the right.
        matches: (N,) vertex of the target that each vertex of the source matches.
        correct: (N,) which matches are right; the lines of the others are red. All count as right when omitted.
        colors: (M, 3) RGB of the target; :func:`position_colors` when omitted.
        lines: number of lines, at most; 0 for none.
        size: width and height in pixels of each of the two pictures.
        azimuth: degrees around the bodies, see :func:`meshkit.viz.render`.
        elevation: degrees above the horizon.
        up: the vertical axis.
        titles: a title for each of the two bodies.

    Returns:
        A Pillow image.

    Raises:
        ValueError: bad meshes or colours, matches of another number or out of range, ``correct`` of another number,
            fewer than 0 lines, or not two titles.

    Example:
        >>> import torch
        >>> triangle = (torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> correspondence_figure(triangle, triangle, [0, 1, 2], size=(60, 80)).size
        (120, 80)
    """
    from PIL import Image

    from meshkit.viz.figures import paste_title

    (points, faces), (other, other_faces) = as_named_mesh("source", source), as_named_mesh("target", target)
    index = _match_indices(as_array(matches), len(other))
    right = np.ones(len(points), dtype=bool) if correct is None else as_array(correct).astype(bool)
    if len(index) != len(points) or right.shape != (len(points),):
        raise ValueError(f"{len(points)} source vertices, but {len(index)} matches and correct of shape {right.shape}")
    if lines < 0 or (titles is not None and len(titles) != 2):
        raise ValueError(f"lines must be 0 or more and titles two, got {lines} and {titles}")
    palette = position_colors(other) if colors is None else as_array(colors)

    camera = {"azimuth": azimuth, "elevation": elevation, "up": up}
    views = [fit_view(p, size, azimuth=azimuth, elevation=elevation, up=up) for p in (points, other)]
    scales = [min(size) / view.pixels_per_unit for view in views]
    if max(scales) <= _ALIKE * min(scales):
        scales = [max(scales)] * 2
    views = [
        fit_view(p, size, azimuth=azimuth, elevation=elevation, up=up, scale=scale)
        for p, scale in zip((points, other), scales, strict=True)
    ]
    pictures = [
        render(p, f, colors=c, size=size, scale=scale, supersample=3, **camera)  # type: ignore[arg-type]
        for p, f, c, scale in ((points, faces, palette[index], scales[0]), (other, other_faces, palette, scales[1]))
    ]
    room = round(0.07 * size[1]) if titles else 0
    sheet = Image.new("RGB", (2 * size[0], size[1] + room), "white")
    for side, picture in enumerate(pictures):
        sheet.paste(Image.fromarray(picture), (side * size[0], room))
    seen = _visible(points, faces, views[0]) & _visible(other, other_faces, views[1])[index]
    chosen = _spread(points, np.flatnonzero(seen), lines)
    starts = views[0].project(points[chosen])[:, :2] + [0, room]
    ends = views[1].project(other[index[chosen]])[:, :2] + [size[0], room]
    ink = np.where(right[chosen, None], np.rint(200 * palette[index[chosen]]), _WRONG).astype(int)
    _draw_lines(sheet, starts, ends, ink)
    for side, title in enumerate(titles or ()):
        paste_title(sheet, title, (side * size[0] + size[0] // 2, room // 2 + 2), round(0.55 * room), size[0])
    return sheet


def _share(values: Array) -> Array:
    """Values between their smallest, 0, and their largest, 1."""
    return (values - values.min()) / max(float(np.ptp(values)), 1e-300)


def _rank(values: Array) -> Array:
    """Share of the values that lie below each, equal for equal values."""
    ordered = np.sort(values)
    below = np.searchsorted(ordered, values, "left") + np.searchsorted(ordered, values, "right") - 1
    return np.asarray(below / (2 * max(len(values) - 1, 1)))


def _match_indices(matches: Array, count: int) -> NDArray[np.int64]:
    if matches.ndim != 1 or (matches != np.floor(matches)).any() or ((matches < 0) | (matches >= count)).any():
        raise ValueError(f"matches must be (N,) vertex numbers in [0, {count}), got shape {matches.shape}")
    return matches.astype(np.int64)


def _visible(points: Array, faces: NDArray[np.int64], view: View) -> NDArray[np.bool_]:
    """Vertices that no face hides, up to a pixel and a half of depth."""
    width, height = view.size
    pixels = view.project(points)
    hit, face, weights = rasterize(pixels, faces, width, height)
    depth = np.full(width * height, -np.inf)
    depth[hit] = (pixels[faces[face], 2] * weights).sum(1)
    column, row = (np.floor(pixels[:, k]).astype(int).clip(0, side - 1) for k, side in enumerate(view.size))
    return np.asarray(pixels[:, 2] >= depth[row * width + column] - 1.5)


def _spread(points: Array, candidates: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Up to ``count`` of the candidates, each as far as possible from those before it."""
    if count == 0 or len(candidates) == 0:
        return candidates[:0]
    place = points[candidates]
    chosen = [int(place[:, np.argmax(np.ptp(place, axis=0))].argmax())]
    distance = np.full(len(place), np.inf)
    while len(chosen) < min(count, len(place)):
        distance = np.minimum(distance, ((place - place[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distance.argmax()))
    return candidates[chosen]


def _draw_lines(sheet: "Image", starts: Array, ends: Array, ink: NDArray[np.int64]) -> None:
    """Smooth, half transparent lines with a dot at each end."""
    from PIL import Image, ImageDraw

    layer = Image.new("RGBA", (sheet.width * _SHARP, sheet.height * _SHARP), (255, 255, 255, 0))
    draw = ImageDraw.Draw(layer)
    width = max(_SHARP, round(sheet.height / 480 * _SHARP))
    for start, end, color in zip(starts * _SHARP, ends * _SHARP, ink.tolist(), strict=True):
        draw.line((*start, *end), fill=(*color, 190), width=width)
    for spots in (starts, ends):
        for (x, y), color in zip(spots * _SHARP, ink.tolist(), strict=True):
            draw.circle((x, y), 2 * width, fill=(*color, 255), outline=(255, 255, 255, 255), width=max(1, width // 2))
    premultiplied = layer.convert("RGBa").resize(sheet.size, Image.Resampling.BOX).convert("RGBA")
    sheet.paste(premultiplied, (0, 0), premultiplied)
