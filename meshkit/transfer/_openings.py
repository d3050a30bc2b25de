"""The openings of a surface: rings of edges that have one face."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from meshkit.io._mesh import area_vectors, components, directed_edges, edge_numbers
from meshkit.io.report import counted
from meshkit.transfer._kinds import surface_area

__all__ = ["Loops", "Openings", "boundary_loops", "find_openings"]

# Width of a loop, over the square root of the area. The shipped bodies have no loops. Where a hand, an arm, a foot or
# the head of 8 people was cut off the loop had 0.106 (a hand) or more; at any joint of 6 animals 0.099 (the tip of the
# tail) or more (tools/measure_openings.py --loops).
_NARROW = 0.095
# From here on a loop is a cut however the surface goes on around it: a haunch or shoulder of an animal is as flat as
# the rim of a hole, and wider than this.
_WIDE = 0.25
# Below, the rim tells a cut from a hole: along a limb its faces look across the loop, around a hole as a patch would.
_HOLE = 0.6


class Loops(NamedTuple):
    """The boundary loops of a surface, the longest first; loops that touch are one.

    Attributes:
        length: (K,) of each.
        width: (K,) circumference of a circle of the area that it spans. A jagged edge makes a loop longer, not wider.
        facing: (K,) how far the faces at the loop are turned as a patch over it would be: 1 around a hole in a plane, 0
            around the end of a tube, -1 around a sheet.
    """

    length: Tensor
    width: Tensor
    facing: Tensor


class Openings(NamedTuple):
    """The openings of a surface.

    Attributes:
        loops: how many; those that touch count as one.
        longest: length of the longest, over the square root of the area of the surface.
        cut: width of the widest at which something may be cut off, over the same; 0 if there is none.
    """

    loops: int
    longest: float
    cut: float = 0.0

    @property
    def doubt(self) -> str:
        """What is to be said of a surface from which something may be cut off; empty if that is not so."""
        if not self.cut:
            return ""
        return (
            f"open: {counted(self.loops, 'boundary loop')}, one as wide as a cut, {self.cut:.2f} times the square root "
            "of the area (a person's wrist has 0.11, the neck 0.28; the training bodies are closed): give the whole "
            "body if a part is cut off, as its place is matched wrongly; close the holes of a scan"
        )

    def __str__(self) -> str:
        return f"{counted(self.loops, 'hole')}, longest loop {self.longest:.2g} times the square root of the area"


def find_openings(verts: Tensor, faces: Tensor) -> Openings:
    """The openings of a surface (V, 3), (F, 3)."""
    loops = boundary_loops(verts, faces)
    if len(loops.length) == 0:
        return Openings(0, 0.0)
    size = math.sqrt(float(surface_area(verts, faces)))
    width = loops.width / size
    cuts = width[(width >= _WIDE) | ((width >= _NARROW) & (loops.facing < _HOLE))]
    return Openings(len(width), float(loops.length[0]) / size, float(cuts.max()) if len(cuts) else 0.0)


def boundary_loops(verts: Tensor, faces: Tensor) -> Loops:
    """The boundary loops of a surface.

    Args:
        verts: (V, 3).
        faces: (F, 3), turned alike.
    """
    triangles, points = faces.cpu().numpy(), verts.detach().cpu().double().numpy()
    number = edge_numbers(triangles)[1]
    ends = directed_edges(triangles)[np.bincount(number)[number] == 1]
    used, row = np.unique(ends, return_inverse=True)
    if len(used) == 0:
        return Loops(*torch.empty(3, 0, dtype=torch.float64, device="cpu"))
    row = row.reshape(-1, 2)
    label = components(row, len(used))
    loop, count = label[row[:, 0]], int(label.max()) + 1
    start, end = (points[used] - points[used].mean(0))[row.T]
    length = np.bincount(loop, np.linalg.norm(end - start, axis=1), count)
    spanned = _sums(loop, np.cross(start, end), count)  # twice the area, against the normal of a patch
    of_vertex = np.full(len(points), -1)
    of_vertex[used] = label
    of_face = of_vertex[triangles].max(1)
    normals = area_vectors(points, triangles)[of_face >= 0]
    rim = _sums(of_face[of_face >= 0], normals, count)
    around = np.bincount(of_face[of_face >= 0], np.linalg.norm(normals, axis=1), count)
    area = np.linalg.norm(spanned, axis=1)
    facing = -(rim * spanned).sum(1) / np.maximum(area * around, np.finfo(float).tiny)
    found = np.stack([length, np.sqrt(2 * math.pi * area), facing])
    return Loops(*torch.from_numpy(found[:, np.argsort(-length)]))


def _sums(group: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, 3) of the rows (R, 3) of each group."""
    return np.stack([np.bincount(group, column, count) for column in rows.T], axis=1)
