"""Repair of meshes of unknown origin, with the way back to the original vertices."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from meshkit.io._manifold import edge_manifold, face_components, orient_faces, split_fans, weld_vertices
from meshkit.io._mesh import area_vectors, as_arrays, as_tensors
from meshkit.io.binding import SurfaceBinding

__all__ = ["CleanMesh", "clean_mesh"]


@dataclass(frozen=True)
class CleanMesh:
    """A repaired mesh and where its vertices came from. ``print`` it to read what was changed.

    Attributes:
        verts: (N, 3) vertices, in the order of the original.
        faces: (F, 3) int64 faces.
        source: (N,) int64 row of the original that each vertex was taken from.
        target: (V,) int64 row of ``verts`` that each original vertex became, -1 where it was dropped.
        changes: what was done and how often, in order; empty if the mesh was clean.
        original: (V, 3) vertices that came in.
        kept_area: share of the area of all parts that the kept ones have; 1 unless parts were removed.
    """

    verts: Tensor
    faces: Tensor
    source: Tensor
    target: Tensor
    changes: dict[str, int]
    original: Tensor
    kept_area: float = 1.0

    def carry(self, deformed: Tensor) -> Tensor:
        """Original vertices after the clean mesh was deformed. Not differentiable.

        A vertex that was kept or welded takes the place of its clean vertex; one that was dropped (another component,
        or in no face) follows the surface nearest to it, see :class:`meshkit.io.SurfaceBinding`.

        Args:
            deformed: (N, 3) deformed ``verts``.

        Returns:
            (V, 3), of the dtype and on the device of ``deformed``.

        Raises:
            ValueError: another shape, or coordinates that are not finite where a dropped vertex needs them.
        """
        if deformed.shape != self.verts.shape:
            raise ValueError(f"deformed must be {tuple(self.verts.shape)}, got {tuple(deformed.shape)}")
        target = self.target.to(deformed.device)
        moved = deformed.detach()[target.clamp_min(0)]
        dropped = target < 0
        if bool(dropped.any()):
            moved[dropped] = self._dropped.carry(deformed)
        return moved

    @cached_property
    def _dropped(self) -> SurfaceBinding:
        points = self.original[self.target.to(self.original.device) < 0].cpu()
        loose = torch.arange(len(points), device="cpu")[:, None].expand(-1, 3)  # each on its own: a point as a face
        return SurfaceBinding(points, loose, self.verts, self.faces)

    def __str__(self) -> str:
        size = f"{len(self.verts)} vertices, {len(self.faces)} faces"
        if not self.changes:
            return f"clean as it was: {size}"
        return "; ".join(f"{what}: {count}" for what, count in self.changes.items()) + f"; left: {size}"


def clean_mesh(
    verts: Tensor,
    faces: Tensor,
    *,
    weld: float | None = 1e-6,
    keep_largest: bool = True,
    orient: bool = True,
) -> CleanMesh:
    """Make one clean, oriented, manifold surface out of a triangle mesh.

    In this order: vertices closer than ``weld`` become one; faces that then repeat a corner, and second copies of a
    face, are removed; where more than two faces meet at an edge, the smallest ones are removed until two are left; of
    the parts that are connected by edges only the one with the largest area is kept; a vertex at which several fans of
    faces touch is split; faces are turned to agree with their neighbours, and all of them outward (positive volume);
    vertices of no face are removed. Vertices keep their order. Holes stay open, and a face without area that has three
    different corners stays, since to remove it would open a hole.

    Args:
        verts: (V, 3) floating vertices, in any unit.
        faces: (F, 3) faces; padding rows (-1, -1, -1) are ignored.
        weld: distance under which vertices become one, as a fraction of the diagonal of the bounding box. 0 welds
            vertices of equal coordinates only, ``None`` none at all.
        keep_largest: keep only the part with the largest area.
        orient: turn faces; ``False`` keeps them as they are.

    Returns:
        The clean mesh, of the dtype and on the device of the input, with the maps between its vertices and the
        original ones.

    Raises:
        ValueError: wrong shapes or types, no vertices or faces, an index out of range, coordinates that are not finite,
            a negative ``weld``, or nothing left.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [9, 9, 9]])
        >>> faces = torch.tensor([[0, 2, 1], [4, 1, 3], [1, 2, 3], [2, 0, 3], [0, 4, 1]])
        >>> result = clean_mesh(verts, faces)
        >>> print(result)
        vertices welded: 1; faces with a repeated corner removed: 1; vertices of no face removed: 1; left: 4 vertices, 4 faces
        >>> result.target.tolist()
        [0, 1, 2, 3, 0, -1]
    """  # noqa: E501
    points, triangles = as_arrays(verts, faces)
    if weld is not None and not weld >= 0:
        raise ValueError(f"weld must be 0 or more, or None for no welding, got {weld}")
    changes: dict[str, int] = {}

    def note(what: str, count: int) -> None:
        if count:
            changes[what] = count

    target = weld_vertices(points, weld)
    kept = np.unique(target)
    note("vertices welded", len(points) - len(kept))
    triangles = target[triangles]

    corners = np.sort(triangles, axis=1)
    sound = (np.diff(corners, axis=1) > 0).all(1)
    note("faces with a repeated corner removed", int((~sound).sum()))
    triangles, corners = triangles[sound], corners[sound]
    first = np.sort(np.unique(corners, axis=0, return_index=True)[1])
    note("repeated faces removed", len(triangles) - len(first))
    triangles = triangles[first]
    if len(triangles) == 0:
        raise ValueError("nothing is left: every face repeats a corner, after welding")

    count, kept_area = len(triangles), 1.0
    triangles = edge_manifold(points, triangles)
    note("faces at an edge of more than two removed", count - len(triangles))
    if keep_largest:
        label, count = face_components(triangles), len(triangles)
        areas = np.bincount(label, np.linalg.norm(area_vectors(points, triangles), axis=1))
        note("smaller parts removed", len(areas) - 1)
        if len(areas) > 1 and areas.sum() > 0:
            kept_area = float(areas.max() / areas.sum())
        triangles = triangles[label == areas.argmax()]
        note("faces of smaller parts removed", count - len(triangles))

    fan, triangles = split_fans(triangles, len(points))  # fan: vertex that each row past the original ones copies
    note("vertices split where fans of faces touched", len(fan))
    origin = np.concatenate([np.arange(len(points)), fan])
    if orient:
        turned = orient_faces(points[origin], triangles)
        note("faces turned", int((turned[:, 1] != triangles[:, 1]).sum()))
        triangles = turned

    used = np.unique(triangles)
    note("vertices of no face removed", len(np.setdiff1d(kept, origin[used])))
    row = np.full(len(origin), -1, dtype=np.int64)
    row[used] = np.arange(len(used))
    clean_verts, clean_faces = as_tensors(points[origin[used]], row[triangles], verts, faces)
    source = torch.from_numpy(origin[used]).to(verts.device)
    clean_verts = verts.detach()[source]  # the very numbers that came in
    carried = torch.from_numpy(row[target]).to(verts.device)
    return CleanMesh(clean_verts, clean_faces, source, carried, changes, verts.detach(), kept_area)
