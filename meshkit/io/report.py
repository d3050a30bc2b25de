"""What there is to know about a mesh before it is used."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from torch import Tensor

from meshkit.io._frame_guess import guess_frame, guess_unit
from meshkit.io._mesh import Indices, area_vectors, as_arrays, components, corner_fans, directed_edges, edge_numbers

__all__ = ["MeshReport", "mesh_report"]

Corner = tuple[float, float, float]


def counted(count: int, thing: str) -> str:
    """A number of things, in the right plural: ``"1 hole"``, ``"2 vertices"``."""
    plural = f"{thing[:-2]}ices" if thing.endswith("ex") else f"{thing}s"
    return f"{count} {thing if count == 1 else plural}"


@dataclass(frozen=True)
class MeshReport:
    """Facts about a mesh, from :func:`mesh_report`; ``print`` it to read them.

    Attributes:
        num_verts, num_faces, num_edges: counts. Edges of degenerate faces are left out.
        components: face counts of the parts that share no vertex, largest first.
        boundary_edges, boundary_loops: edges of one face, and the rings that they form. A seam, along which vertices
            are there twice, as files with texture coordinates have them, counts on both sides.
        seam_edges: boundary edges that have a partner once vertices with the same coordinates are one.
        holes: rings of the boundary edges that have none.
        crowded_edges: edges of more than two faces.
        touching_verts: vertices at which several fans of faces touch.
        flipped_edges: inner edges whose two faces are turned differently.
        degenerate_faces: faces that repeat a corner or have no area to speak of.
        duplicate_faces: faces with the same three corners as an earlier face.
        duplicate_verts: vertices with the same coordinates as an earlier vertex.
        unreferenced_verts: vertices of no face.
        euler: V - E + F over the vertices in use.
        genus: number of handles, for one closed manifold part that can be oriented; else ``None``.
        low, high: corners of the bounding box, in the unit of the file.
        area: of the surface.
        volume: enclosed, negative if the surface is turned inside out; ``None`` if it is not closed.
        up, facing: signed axis, such as ``"+z"`` and ``"-y"``, of a standing body; ``None`` where the shape leaves
            doubt. A guess from symmetry, extent and feet.
        unit: ``"m"``, ``"cm"``, ``"mm"``, ``"in"`` or ``"ft"``: the one that makes the largest extent that of a body;
            ``None`` if none does. A guess.
    """

    num_verts: int
    num_faces: int
    num_edges: int
    components: tuple[int, ...]
    boundary_edges: int
    boundary_loops: int
    seam_edges: int
    holes: int
    crowded_edges: int
    touching_verts: int
    flipped_edges: int
    degenerate_faces: int
    duplicate_faces: int
    duplicate_verts: int
    unreferenced_verts: int
    euler: int
    genus: int | None
    low: Corner
    high: Corner
    area: float
    volume: float | None
    up: str | None
    facing: str | None
    unit: str | None

    @property
    def manifold(self) -> bool:
        """Every edge has one or two faces, and the faces at every vertex form one fan."""
        return self.crowded_edges == 0 and self.touching_verts == 0

    @property
    def watertight(self) -> bool:
        """Every edge has exactly two faces, turned alike."""
        return self.boundary_edges == 0 and self.crowded_edges == 0 and self.flipped_edges == 0

    @property
    def problems(self) -> tuple[str, ...]:
        """What :func:`meshkit.io.clean_mesh` would change or a user should know, in words."""
        size = self.components
        found = {
            counted(self.degenerate_faces, "degenerate face"): self.degenerate_faces,
            counted(self.duplicate_faces, "repeated face"): self.duplicate_faces,
            counted(self.duplicate_verts, "repeated vertex"): self.duplicate_verts,
            f"{counted(self.unreferenced_verts, 'vertex')} in no face": self.unreferenced_verts,
            f"{counted(self.crowded_edges, 'edge')} with more than two faces": self.crowded_edges,
            f"{counted(self.touching_verts, 'vertex')} where fans of faces touch": self.touching_verts,
            f"{counted(self.flipped_edges, 'edge')} whose faces are turned differently": self.flipped_edges,
            f"{len(size)} parts (faces: {', '.join(map(str, size[:5]))}{', ...' if len(size) > 5 else ''})": len(size)
            > 1,
            f"{counted(self.holes, 'hole')} ({counted(self.boundary_edges - self.seam_edges, 'boundary edge')})": (
                self.holes
            ),
            f"{counted(self.seam_edges, 'boundary edge')} along seams of repeated vertices, which clean_mesh welds": (
                self.seam_edges
            ),
            "turned inside out (negative volume)": self.volume is not None and self.volume < 0,
        }
        return tuple(text for text, count in found.items() if count)

    def __str__(self) -> str:
        extent = np.subtract(self.high, self.low)
        kind = "watertight" if self.watertight else "open" if self.boundary_edges else "closed"
        kind = "closed but for seams" if self.boundary_edges and not self.holes else kind
        kind += ", manifold" if self.manifold else ", not manifold"
        if self.genus is not None:
            kind += f", genus {self.genus}"
        lines = [
            f"mesh     {self.num_verts:,} vertices, {self.num_edges:,} edges, {self.num_faces:,} faces",
            f"surface  {kind}, Euler characteristic {self.euler}",
            f"size     {' x '.join(f'{e:.4g}' for e in extent)} (x, y, z)"
            + (f", if this is a body in {self.unit}" if self.unit else ", the size of no body in m, cm, mm, in or ft"),
            f"frame    up {self.up or 'unclear'}, facing {self.facing or 'unclear'} (a guess)",
        ]
        lines += [f"note     {problem}" for problem in self.problems]
        return "\n".join(lines)


def mesh_report(verts: Tensor, faces: Tensor) -> MeshReport:
    """Measure a mesh: counts, parts, manifoldness, defects, size, and guesses of unit and orientation.

    Args:
        verts: (V, 3) floating vertices.
        faces: (F, 3) faces; padding rows (-1, -1, -1) are ignored.

    Raises:
        ValueError: wrong shapes or types, no vertices or faces, an index out of range, coordinates that are not finite.

    Example:
        >>> from meshkit.data import load_humans
        >>> body = load_humans(1000)
        >>> print(mesh_report(body.template, body.faces))
        mesh     1,000 vertices, 2,994 edges, 1,996 faces
        surface  watertight, manifold, genus 0, Euler characteristic 2
        size     ... (x, y, z), if this is a body in m
        frame    up +z, facing -y (a guess)
    """
    points, triangles = as_arrays(verts, faces)
    corners = np.sort(triangles, axis=1)
    distinct = (np.diff(corners, axis=1) > 0).all(1)
    doubled = np.linalg.norm(area_vectors(points, triangles), axis=1)
    ends = directed_edges(triangles)
    longest = ((points[ends[:, 0]] - points[ends[:, 1]]) ** 2).sum(1).reshape(3, -1).max(0)
    degenerate = int((~distinct | (doubled <= 1e-10 * longest)).sum())
    sound = triangles[distinct]
    edges, number = edge_numbers(sound)
    faces_at = np.bincount(number, minlength=len(edges))
    used = np.unique(sound)
    euler = len(used) - len(edges) + len(sound)
    sizes = _parts(sound, len(points))
    forward = directed_edges(sound)
    balance = np.bincount(number, np.sign(forward[:, 1] - forward[:, 0]), len(edges))
    boundary, crowded = int((faces_at == 1).sum()), int((faces_at > 2).sum())
    place = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)
    lone = place[edges[faces_at == 1]]
    seam = _paired(lone)
    flipped = int(((faces_at == 2) & (balance != 0)).sum())
    touching = _touching(sound, len(points))
    closed = len(sound) > 0 and not (boundary or crowded or flipped)
    volume = None
    if closed:
        a, b, c = (points[sound[:, k]] - points.mean(0) for k in range(3))
        volume = float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
    shape = points[used] if len(used) else points
    low, high = shape.min(0), shape.max(0)
    up, facing = guess_frame(shape)
    return MeshReport(
        num_verts=len(points),
        num_faces=len(triangles),
        num_edges=len(edges),
        components=sizes,
        boundary_edges=boundary,
        boundary_loops=_loops(edges[faces_at == 1]),
        seam_edges=int(seam.sum()),
        holes=_loops(lone[~seam]),
        crowded_edges=crowded,
        touching_verts=touching,
        flipped_edges=flipped,
        degenerate_faces=degenerate,
        duplicate_faces=len(triangles) - len(np.unique(corners, axis=0)),
        duplicate_verts=len(points) - int(place.max()) - 1,
        unreferenced_verts=len(points) - len(np.unique(triangles)),
        euler=euler,
        genus=(2 - euler) // 2 if closed and not touching and len(sizes) == 1 else None,
        low=(float(low[0]), float(low[1]), float(low[2])),
        high=(float(high[0]), float(high[1]), float(high[2])),
        area=float(doubled.sum() / 2),
        volume=volume,
        up=up,
        facing=facing,
        unit=guess_unit(float((high - low).max())),
    )


def _parts(triangles: Indices, num_verts: int) -> tuple[int, ...]:
    if len(triangles) == 0:
        return ()
    label = components(directed_edges(triangles), num_verts)[triangles[:, 0]]
    sizes = np.unique(label, return_counts=True)[1]
    return tuple(sorted(sizes.tolist(), reverse=True))


def _paired(edges: Indices) -> npt.NDArray[np.bool_]:
    """(E,) which of the edges (E, 2) have the ends of another one, in either sense."""
    _, number, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[number.reshape(-1)] > 1)


def _loops(edges: Indices) -> int:
    if len(edges) == 0:
        return 0
    ends, rows = np.unique(edges, return_inverse=True)
    return int(components(rows.reshape(-1, 2), len(ends)).max()) + 1


def _touching(triangles: Indices, num_verts: int) -> int:
    """Vertices whose faces form more than one fan."""
    if len(triangles) == 0:
        return 0
    pairs = np.stack([triangles.reshape(-1), corner_fans(triangles).reshape(-1)], axis=1)
    return int((np.bincount(np.unique(pairs, axis=0)[:, 0], minlength=num_verts) > 1).sum())
