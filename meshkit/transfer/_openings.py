"""The openings of a surface: rings of edges that have one face."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from meshkit.io._mesh import components, directed_edges, edge_numbers
from meshkit.io.report import counted
from meshkit.transfer._kinds import surface_area

__all__ = ["Openings", "find_openings", "opening_lengths"]

# Length of a loop, over the square root of the area, from which on something may be cut off. The shipped bodies have no
# loops. Where a hand, an arm, a foot or the head of 8 people was cut off the loop had 0.140 (a hand) or more; at any
# joint of 6 animals 0.138 (a fore paw) or more (tools/measure_openings.py).
_WIDE = 0.1


class Openings(NamedTuple):
    """The boundary loops of a surface.

    Attributes:
        loops: how many; those that touch count as one.
        longest: length of the longest, over the square root of the area of the surface.
    """

    loops: int
    longest: float

    @property
    def doubt(self) -> str:
        """What is to be said of a surface from which something may be cut off; empty if that is not so."""
        if self.longest < _WIDE:
            return ""
        return (
            f"open: {counted(self.loops, 'boundary loop')}, the longest {self.longest:.2f} times the square root of "
            "the area (a person's wrist has 0.14, the neck 0.33; the training bodies are closed): give the whole body "
            "if a part is cut off, as its place is matched wrongly; close the holes of a scan"
        )

    def __str__(self) -> str:
        return f"{counted(self.loops, 'hole')}, longest loop {self.longest:.2g} times the square root of the area"


def find_openings(verts: Tensor, faces: Tensor) -> Openings:
    """The openings of a surface (V, 3), (F, 3)."""
    lengths = opening_lengths(verts, faces)
    longest = float(lengths[0]) / math.sqrt(float(surface_area(verts, faces))) if len(lengths) else 0.0
    return Openings(len(lengths), longest)


def opening_lengths(verts: Tensor, faces: Tensor) -> Tensor:
    """Lengths (K,) of the boundary loops of a surface, the longest first; loops that touch count as one.

    Args:
        verts: (V, 3).
        faces: (F, 3).
    """
    triangles, points = faces.cpu().numpy(), verts.detach().cpu().double().numpy()
    number = edge_numbers(triangles)[1]
    ends = directed_edges(triangles)[np.bincount(number)[number] == 1]
    if len(ends) == 0:
        return torch.empty(0, dtype=torch.float64)
    length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    used, row = np.unique(ends, return_inverse=True)
    row = row.reshape(-1, 2)
    loop = components(row, len(used))[row[:, 0]]
    return torch.from_numpy(np.sort(np.bincount(loop, length))[::-1].copy())
