"""The same pictures by pyvista (VTK), for large meshes and interactive windows; needs the ``viz`` extra."""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from meshkit.viz._mesh import CLAY, as_array, as_mesh, check_colors, fit_view

__all__ = ["render_pyvista"]


def render_pyvista(
    verts: Tensor | ArrayLike,
    faces: Tensor | ArrayLike,
    *,
    size: tuple[int, int] = (320, 320),
    colors: Tensor | ArrayLike | None = None,
    azimuth: float = 20.0,
    elevation: float = 8.0,
    up: Literal["y", "z"] = "z",
    shading: Literal["smooth", "flat"] = "smooth",
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    scale: float | None = None,
    bounds: Tensor | ArrayLike | None = None,
    window: bool = False,
) -> NDArray[np.uint8]:
    """Draw a triangle mesh with VTK, framed pixel by pixel as :func:`meshkit.viz.render` frames it.

    Faster than the NumPy renderer beyond some 100,000 vertices. It needs OpenGL; without a display VTK draws off screen
    through EGL or Mesa.

    Args:
        verts: (V, 3) coordinates.
        faces: (F, 3) vertex indices.
        size: width and height in pixels.
        colors: (V, 3) RGB in [0, 1] per vertex; a light grey-blue when omitted.
        azimuth: degrees around the body.
        elevation: degrees above the horizon.
        up: the vertical axis.
        shading: ``smooth`` or ``flat``.
        background: RGB in [0, 1].
        scale: length spanned by the shorter side.
        bounds: (2, 3) box to frame instead of the body.
        window: open a window to turn the mesh in, and return the picture when it is closed.

    Returns:
        (height, width, 3) uint8 picture.

    Raises:
        ImportError: pyvista is not installed.
        ValueError: as :func:`meshkit.viz.render`.
    """
    points, triangles = as_mesh(verts, faces)
    albedo = np.broadcast_to(CLAY, points.shape) if colors is None else as_array(colors)
    check_colors(points, albedo)
    if shading not in {"smooth", "flat"}:
        raise ValueError(f"shading must be 'smooth' or 'flat', got {shading!r}")
    view = fit_view(points, size, azimuth=azimuth, elevation=elevation, up=up, scale=scale, bounds=bounds)
    pyvista = _pyvista()
    plotter = pyvista.Plotter(off_screen=not window, window_size=size, lighting="none")
    try:
        mesh = pyvista.PolyData.from_regular_faces(points, triangles)
        mesh["rgb"] = np.rint(albedo * 255).astype(np.uint8)
        plotter.add_mesh(
            mesh, scalars="rgb", rgb=True, smooth_shading=shading == "smooth", ambient=0.25, diffuse=0.75, specular=0.08
        )
        center = view.center @ view.axes
        reach = float(np.linalg.norm(points - center, axis=1).max()) or 1.0
        for direction, strength in (((-0.55, 0.60, 0.58), 0.95), ((0.80, 0.05, 0.60), 0.25)):
            light = pyvista.Light(light_type="camera light", intensity=strength)
            light.position, light.focal_point = direction, (0.0, 0.0, 0.0)
            plotter.add_light(light)
        plotter.camera.parallel_projection = True
        plotter.camera.position = center + 3 * reach * view.axes[2]
        plotter.camera.focal_point = center
        plotter.camera.up = view.axes[1]
        plotter.camera.parallel_scale = size[1] / 2 / view.pixels_per_unit
        plotter.camera.clipping_range = (0.5 * reach, 6 * reach)
        plotter.set_background(background)
        plotter.enable_anti_aliasing("ssaa")
        picture = plotter.show(screenshot=True, return_img=True) if window else plotter.screenshot(return_img=True)
        return np.ascontiguousarray(picture[..., :3])
    finally:
        plotter.close()


def _pyvista() -> Any:
    try:
        import pyvista
    except ImportError as error:
        raise ImportError(f'pyvista cannot be loaded ({error}): pip install "meshkit-torch[viz]"') from error
    return pyvista
