"""Fewer vertices for a mesh, with the way back to all of them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from meshkit.io._mesh import Indices, Points, as_arrays, as_tensors, edge_numbers
from meshkit.io.binding import SurfaceBinding

__all__ = ["SimpleMesh", "simplify"]

_TRIES = 8

Decimate = Callable[[Points, Indices, int], tuple[Points, Indices]]


@dataclass(frozen=True)
class SimpleMesh:
    """A mesh with fewer vertices, and the original it stands for.

    Attributes:
        verts: (N, 3) vertices.
        faces: (G, 3) int64 faces.
        original: (V, 3) vertices that came in.
        original_faces: (F, 3) faces that came in.
        method: what made it, ``"libigl"`` or ``"pymeshlab"``; ``"none"`` if the mesh was small enough already.
    """

    verts: Tensor
    faces: Tensor
    original: Tensor
    original_faces: Tensor
    method: str

    @cached_property
    def binding(self) -> SurfaceBinding:
        """The original bound to the simple mesh; made when first used."""
        return SurfaceBinding(self.original, self.original_faces, self.verts, self.faces)

    @property
    def source(self) -> Tensor:
        """(N,) int64 original vertex nearest to each simple vertex: reads a per-vertex quantity at the simple mesh."""
        from scipy.spatial import cKDTree

        tree = cKDTree(self.original.detach().cpu().numpy())
        return torch.from_numpy(tree.query(self.verts.detach().cpu().numpy())[1]).to(self.verts.device)

    def carry(self, deformed: Tensor) -> Tensor:
        """Original vertices after the simple mesh was deformed, see :class:`meshkit.io.SurfaceBinding`.

        Args:
            deformed: (N, 3) deformed ``verts``.

        Returns:
            (V, 3), of the dtype and on the device of ``deformed``. Not differentiable.

        Raises:
            ValueError: another shape, or coordinates that are not finite.
        """
        if self.method == "none" and deformed.shape == self.verts.shape:
            return deformed.detach().clone()
        return self.binding.carry(deformed)


def simplify(
    verts: Tensor, faces: Tensor, n: int, *, method: Literal["auto", "libigl", "pymeshlab"] = "auto"
) -> SimpleMesh:
    """Collapse edges, the least costly by the quadric error first, until ``n`` vertices are left.

    Args:
        verts: (V, 3) floating vertices, in any unit.
        faces: (F, 3) faces of a manifold surface, with or without boundary; :func:`meshkit.io.clean_mesh` makes one.
        n: number of vertices wanted, 4 or more. It is met exactly where the topology allows; on open meshes it may be
            missed by a few.
        method: ``"libigl"`` needs nothing but the core installation; ``"pymeshlab"`` (the ``remesh`` extra) keeps
            boundaries better and takes meshes that are not manifold. ``"auto"`` is libigl where the mesh is manifold,
            on every machine, and pymeshlab where it is not.

    Returns:
        The simple mesh, in the dtype and on the device of the input; its ``carry`` brings a deformation back to all
        vertices. A mesh of ``n`` or fewer vertices comes back as it is.

    Raises:
        ValueError: wrong shapes or types, no vertices or faces, an index out of range, coordinates that are not finite,
            ``n`` below 4, an unknown method, or a mesh that libigl cannot take.
        ImportError: pymeshlab is needed, and it or its system libraries are missing; the message names them.

    Reference:
        Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics".

    Example:
        >>> from meshkit.data import load_humans
        >>> body = load_humans(1000)
        >>> small = simplify(body.template, body.faces, 500)
        >>> small.verts.shape, small.faces.shape
        (torch.Size([500, 3]), torch.Size([996, 3]))
        >>> small.carry(small.verts * 2).shape
        torch.Size([1000, 3])
    """
    points, triangles = as_arrays(verts, faces)
    if n < 4:
        raise ValueError(f"n must be 4 or more, got {n}")
    if method not in ("auto", "libigl", "pymeshlab"):
        raise ValueError(f"method must be 'auto', 'libigl' or 'pymeshlab', got {method!r}")
    if n >= len(points):
        return SimpleMesh(verts.detach(), faces, verts.detach(), faces, "none")
    flaw = _why_not_libigl(points, triangles)
    if method == "libigl" and flaw:
        raise ValueError(f"libigl cannot simplify this mesh: {flaw}; use clean_mesh first, or method='pymeshlab'")
    chosen = "pymeshlab" if method == "pymeshlab" or (method == "auto" and flaw) else "libigl"
    if chosen == "pymeshlab":
        from meshkit.io._pymeshlab import decimate, load_pymeshlab

        try:
            load_pymeshlab()
        except ImportError as error:
            if flaw and method == "auto":
                raise ImportError(f"{flaw}: use clean_mesh first, or pymeshlab, but {error}") from error
            raise
    else:
        decimate = _decimate_libigl
    small, small_faces = _reach(decimate, points, triangles, n)
    small_verts, small_triangles = as_tensors(small, small_faces, verts, faces)
    return SimpleMesh(small_verts, small_triangles, verts.detach(), faces, chosen)


def _why_not_libigl(points: Points, triangles: Indices) -> str:
    import igl

    repeated = int((np.diff(np.sort(triangles, axis=1), axis=1) == 0).any(1).sum())
    if repeated:
        return f"{repeated} faces repeat a corner"
    crowded = int((np.bincount(edge_numbers(triangles)[1]) > 2).sum())
    if crowded:
        return f"{crowded} edges have more than two faces"
    loose = len(points) - len(np.unique(triangles))
    if loose:
        return f"{loose} vertices belong to no face"
    if not np.asarray(igl.is_vertex_manifold(triangles)).all():
        return "fans of faces touch at a vertex"
    return ""


def _decimate_libigl(points: Points, triangles: Indices, num_faces: int) -> tuple[Points, Indices]:
    import igl

    small, small_faces, *_ = igl.qslim(points, triangles, num_faces)
    return np.ascontiguousarray(small), np.asarray(small_faces, dtype=np.int64)


def _reach(decimate: Decimate, points: Points, triangles: Indices, n: int) -> tuple[Points, Indices]:
    """Decimate to ``n`` vertices with a function that counts faces.

    A collapse removes one vertex and two faces, one face at the boundary: a closed surface needs one try, an open one a
    search between the last number of faces that left too few vertices and the last that left too many.
    """
    few, many = 2, len(triangles)
    num_faces = max(len(triangles) - 2 * (len(points) - n), few)
    tried: dict[int, tuple[Points, Indices]] = {}
    for _ in range(_TRIES):
        tried[num_faces] = decimate(points, triangles, num_faces)
        excess = len(tried[num_faces][0]) - n
        if excess == 0:
            break
        few, many = (num_faces, many) if excess < 0 else (few, num_faces)
        guess = num_faces - 2 * excess
        num_faces = guess if few < guess < many else (few + many) // 2
        if num_faces in tried:
            break
    return min(tried.values(), key=lambda mesh: abs(len(mesh[0]) - n))
