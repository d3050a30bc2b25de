"""STL files, binary and text, through trimesh: corners of loose triangles that are equal become one vertex."""

import re
from pathlib import Path

import numpy as np

from meshkit.io._lines import COPY_AGAIN, EMPTY
from meshkit.io._mesh import Indices, Parsed, Points
from meshkit.io._trimesh import trimesh_reads

_HEADER, _TRIANGLE = 84, 50  # bytes of a binary file


def read_stl(path: Path, _limit: int) -> Parsed:
    """Triangles of an STL file, welded."""
    from trimesh.exchange.stl import load_stl

    claim = _check(path)
    with path.open("rb") as stream, trimesh_reads():
        loaded = load_stl(stream)
        solids = loaded.get("geometry", {"": loaded}).values()
        verts = np.concatenate([np.empty((0, 3)), *(solid["vertices"] for solid in solids)])
    if len(verts) != 3 * claim:
        raise ValueError(f"damaged: {claim:,} triangles should be there, with {len(verts):,} corners; {COPY_AGAIN}")
    return Parsed(*_weld(verts, np.arange(len(verts)).reshape(-1, 3)))


def _check(path: Path) -> int:
    """Number of triangles that a file should have, once it is whole."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_HEADER)
    if not head:
        raise ValueError(EMPTY)
    count = int.from_bytes(head[-4:], "little")
    binary = _HEADER + _TRIANGLE * count
    if size == binary:
        return count
    text = path.read_bytes().lower()
    if not text.lstrip().startswith(b"solid") or b"\0" in text:
        claim = f"a binary STL of {count:,} triangles has {binary:,} bytes, this file {size:,}"
        claim = claim if size >= _HEADER else f"{size} bytes, a binary STL has {_HEADER} or more"
        raise ValueError(f"damaged or cut short: {claim}; {COPY_AGAIN}")
    if not text.rstrip().rpartition(b"\n")[2].lstrip().startswith(b"endsolid"):  # trimesh reads as far as it goes
        raise ValueError(f"cut short: there is no endsolid at its end; {COPY_AGAIN}")
    return len(re.findall(rb"\bendloop\s+endfacet\b", text))  # and no name of a solid


def _weld(verts: Points, faces: Indices) -> tuple[Points, Indices]:
    """One vertex per distinct coordinate triple, in order of first appearance."""
    _, first, inverse = np.unique(verts, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return verts[first[order]], rank[inverse.reshape(-1)][faces]
