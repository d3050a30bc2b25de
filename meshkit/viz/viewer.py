"""Interactive pages: meshes side by side in one HTML file that needs no network."""

import base64
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from meshkit.io import atomic_write
from meshkit.viz._mesh import CLAY, GAMMA, as_array, as_named_mesh, check_angles, check_colors

__all__ = ["save_html"]

MeshLike = tuple[Tensor | ArrayLike, Tensor | ArrayLike]


def save_html(
    path: str | os.PathLike[str],
    meshes: Mapping[str, MeshLike],
    *,
    colors: Mapping[str, Tensor | ArrayLike] | None = None,
    title: str = "meshkit",
    notes: Sequence[str] | None = None,
    azimuth: float = 20.0,
    elevation: float = 8.0,
    up: Literal["y", "z"] = "z",
    wireframe: bool = False,
) -> None:
    """Write one HTML file with meshes to turn, zoom and compare, side by side under one camera and at one scale.

    The file holds its viewer (WebGL 2, no library) and the meshes as one GLB, which a button saves; it opens from disk,
    without a network. Vertex order is kept. About 0.6 MB per body of 6890 vertices.

    Args:
        path: the file to write; its folder is made if missing.
        meshes: name to ``(verts (V, 3), faces (F, 3))``, in reading order.
        colors: name to (V, 3) RGB in [0, 1] per vertex; a light grey-blue for the names that are missing.
        title: heading of the page.
        notes: one short line under each name; the numbers of vertices and faces when omitted.
        azimuth: degrees around the body at first, as in :func:`meshkit.viz.render`.
        elevation: degrees above the horizon at first.
        up: the vertical axis of the coordinates.
        wireframe: show edges at first.

    Raises:
        ValueError: no mesh, a mesh or colours that :func:`meshkit.viz.render` would refuse, colours for an unknown
            name, another number of notes, an unknown ``up``, an angle that is not finite, or another suffix than
            ``.html``.

    Example:
        >>> import tempfile, torch
        >>> file = Path(tempfile.mkdtemp()) / "triangle.html"
        >>> save_html(file, {"a triangle": (torch.eye(3), torch.tensor([[0, 1, 2]]))})
        >>> "a triangle" in file.read_text()
        True
    """
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"a page is written as .html, got {Path(path).name!r}")
    for name, given in (("meshes", meshes), ("colors", colors if colors is not None else {})):
        if not isinstance(given, Mapping):
            raise ValueError(f'{name} must be a dict by name, such as {{"body": ...}}, got {type(given).__name__}')
    if not meshes:
        raise ValueError("nothing to show: meshes is empty")
    if odd := [name for name in meshes if not isinstance(name, str)]:
        raise ValueError(f"the names of meshes must be text, got {odd[0]!r}")
    check_angles(azimuth, elevation)
    if up not in {"y", "z"}:
        raise ValueError(f"up must be 'y' or 'z', got {up!r}")
    unknown = set(colors or ()) - set(meshes)
    if unknown:
        raise ValueError(f"colors for {sorted(unknown)}, but the meshes are {list(meshes)}")
    if notes is not None and (isinstance(notes, str) or len(notes) != len(meshes)):
        raise ValueError(f"notes must be a list with a line for each of {len(meshes)} meshes, got {notes!r}")
    glb, counts = _glb(meshes, colors or {})
    view = {
        "names": list(meshes),
        "notes": list(notes) if notes is not None else counts,
        "azimuth": azimuth,
        "elevation": elevation,
        "up": up,
        "wire": wireframe,
        "flat": False,
    }
    page = (files("meshkit.viz") / "viewer.html").read_text(encoding="utf-8")
    texts = {
        "TITLE": html.escape(title),
        "FILE": html.escape(Path(path).with_suffix(".glb").name),
        "VIEW": json.dumps(view).replace("<", "\\u003c"),  # a name cannot end the script
        "GLB": base64.b64encode(glb).decode("ascii"),
    }
    # In one pass, so that a mark in a name stays as it is.
    page = re.sub("@(TITLE|FILE|VIEW|GLB)@", lambda mark: texts[mark[1]], page)
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _glb(meshes: Mapping[str, MeshLike], colors: Mapping[str, Tensor | ArrayLike]) -> tuple[bytes, list[str]]:
    import trimesh

    scene, counts = trimesh.Scene(), []
    for name, given in meshes.items():
        points, triangles = as_named_mesh(name, given)
        rgb = np.broadcast_to(CLAY, points.shape) if name not in colors else as_array(colors[name])
        check_colors(points, rgb)
        linear = np.rint(255 * rgb**GAMMA).astype(np.uint8)  # GLB keeps colours in linear light
        mesh = trimesh.Trimesh(points, triangles, vertex_colors=linear, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
        counts.append(f"{len(points):,} vertices, {len(triangles):,} faces")
    return scene.export(file_type="glb"), counts
