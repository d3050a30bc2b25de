"""Per-vertex errors painted on a body, seen from several sides, with a colour bar."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from meshkit.viz._mesh import as_array, as_mesh, fit_view
from meshkit.viz.figures import contact_sheet
from meshkit.viz.rasterizer import error_colors, render

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["error_heat_map"]


def error_heat_map(
    verts: Tensor | ArrayLike,
    faces: Tensor | ArrayLike,
    errors: Tensor | ArrayLike,
    *,
    label: str = "error",
    vmax: float | None = None,
    azimuths: Sequence[float] = (20.0, 110.0, 200.0),
    elevation: float = 8.0,
    size: tuple[int, int] = (240, 360),
    titles: Sequence[str] | None = None,
    up: Literal["y", "z"] = "z",
) -> "Image":
    """Paint a body with its per-vertex errors, from light (0) to dark (``vmax`` and beyond), beside a colour bar.

    Args:
        verts: (V, 3) coordinates of the body that is painted.
        faces: (F, 3) vertex indices.
        errors: (V,) error of every vertex, in any unit.
        label: what the colour bar says, with the unit.
        vmax: error of the last colour; the 99th percentile when omitted. Give one number to figures to be compared.
        azimuths: one picture per number, degrees around the body.
        elevation: degrees above the horizon.
        size: width and height of each picture in pixels.
        titles: one per picture; none when omitted.
        up: the vertical axis.

    Returns:
        A Pillow image. All views have one scale.

    Raises:
        ValueError: a bad mesh or bad errors, ``vmax`` not above 0, no view, or another number of titles.

    Example:
        >>> import torch
        >>> figure = error_heat_map(torch.eye(3), [[0, 1, 2]], [0.0, 1.0, 2.0], azimuths=[0, 90], size=(60, 60))
        >>> figure.mode
        'RGB'
    """
    (points, triangles), values = as_mesh(verts, faces), as_array(errors)
    if values.shape != points.shape[:1] or not np.isfinite(values).all():
        raise ValueError(f"errors must be {len(points)} finite numbers, one per vertex, got shape {values.shape}")
    if not azimuths or (titles is not None and len(titles) != len(azimuths)):
        raise ValueError(f"{len(titles or ())} titles for {len(azimuths)} views")
    if vmax is None and values.min() < 0:
        raise ValueError(f"errors must be 0 or more, the least is {values.min():.3g}; give vmax to show it as 0")
    top = float(np.percentile(values, 99)) or float(values.max()) or 1.0 if vmax is None else vmax
    colors = error_colors(values, vmax=top)
    cameras = [
        fit_view(points, size, azimuth=azimuth, elevation=elevation, up=up).pixels_per_unit for azimuth in azimuths
    ]
    scale = min(size) / min(cameras)
    options = {"colors": colors, "elevation": elevation, "up": up, "size": size, "scale": scale, "supersample": 3}
    row = [render(points, triangles, azimuth=azimuth, **options) for azimuth in azimuths]  # type: ignore[arg-type]
    return contact_sheet([row], column_titles=titles or [""] * len(row), colorbar=(0.0, top, label))
