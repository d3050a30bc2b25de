"""Reader of STL files, binary and text: loose triangles, whose corners with equal coordinates become one vertex."""

from pathlib import Path

import numpy as np

from meshkit.io._lines import COPY_AGAIN, EMPTY, VERTEX_IS, blame
from meshkit.io._mesh import Indices, Parsed, Points
from meshkit.io.report import counted

_HEADER = 84  # bytes before the first triangle
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_PASSED_OVER = {b"solid", b"outer", b"endloop"}


def read_stl(path: Path, _limit: int) -> Parsed:
    """Triangles of an STL file, welded."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        start = stream.read(1024)
    if not size:
        raise ValueError(EMPTY)
    count = int.from_bytes(start[_HEADER - 4 : _HEADER], "little")
    binary = _HEADER + _TRIANGLE.itemsize * count
    if size == binary:
        triangles = np.fromfile(path, _TRIANGLE, offset=_HEADER)["corners"].astype(np.float64)
    elif start.lstrip()[:5].lower() == b"solid" and (b"facet" in start or b"\0" not in start):
        triangles = _text(path)
    else:
        claim = f"a binary STL of {count:,} triangles has {binary:,} bytes, this file {size:,}"
        claim = claim if size >= _HEADER else f"{size} bytes, a binary STL has {_HEADER} or more"
        raise ValueError(f"damaged or cut short: {claim}; {COPY_AGAIN}")
    verts = triangles.reshape(-1, 3)
    return Parsed(*_weld(verts, np.arange(len(verts)).reshape(-1, 3)))


def _text(path: Path) -> Points:
    corners: list[list[float]] = []
    done, ended = 0, False  # triangles that are whole, and whether the last solid is
    with path.open("rb") as stream:
        for number, line in enumerate(stream, 1):
            word, *fields = line.split() or [b""]
            word = word.lower()
            if word == b"vertex":
                try:
                    x, y, z = map(float, fields)
                except ValueError:
                    raise blame(number, line, VERTEX_IS) from None
                corners.append([x, y, z])
            elif word in (b"facet", b"endfacet", b"endsolid"):
                done += word == b"endfacet"
                if len(corners) != 3 * done:
                    raise blame(number, line, f"triangle {done + (word != b'endfacet')} has not three vertices")
            elif word and word not in _PASSED_OVER:
                raise blame(number, line, "no line of an STL file starts like this")
            ended = word == b"endsolid" or (ended and not word)
    if not ended:
        raise ValueError(f"cut short: there is no endsolid after {counted(done, 'triangle')}; {COPY_AGAIN}")
    return np.array(corners).reshape(-1, 3, 3)


def _weld(verts: Points, faces: Indices) -> tuple[Points, Indices]:
    """One vertex per distinct coordinate triple, in order of first appearance."""
    _, first, inverse = np.unique(verts, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return verts[first[order]], rank[inverse.reshape(-1)][faces]
