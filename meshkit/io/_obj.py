"""Reader of OBJ files: vertices as they stand in the file, polygons as triangles."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from meshkit.io._lines import VERTEX_IS, Growing, Row, blame, outside, strange_corners, table
from meshkit.io._mesh import Parsed

_BATCH_BYTES = 2**25
_VERTEX = (b"v ", b"v\t")
_FACE = (b"f ", b"f\t")
_SLASHES = re.compile(rb"/\S*")
_FACE_IS = "a face is three or more vertex numbers, counted from 1"


def read_obj(path: Path, _limit: int) -> Parsed:
    """Vertices and faces of an OBJ file; texture, normals, materials and groups are passed over."""
    mesh, number = Growing(), 0
    with path.open("rb") as stream:
        while batch := stream.readlines(_BATCH_BYTES):
            while batch[-1].rstrip().endswith(b"\\") and (more := stream.readline()):
                batch.append(more)
            try:
                _batch(batch, mesh)
            except ValueError:
                _lines(batch, number, mesh, ends=stream.tell() == path.stat().st_size)
            number += len(batch)
    if not mesh.count and not any(map(len, mesh.faces)):
        raise ValueError("no vertices and no faces in it")
    parsed = mesh.parsed()
    if outside(parsed.faces, len(parsed.verts)):
        raise _strange_face(path, len(parsed.verts))
    return parsed


def _batch(batch: list[bytes], mesh: Growing) -> None:
    """All lines at once; leaves ``mesh`` alone and raises where they are not plain."""
    if any(line[:1].isspace() and line.strip() for line in batch) or any(b"\\" in line for line in batch):
        raise ValueError("indented or continued lines")
    vertex = [line[2:] for line in batch if line.startswith(_VERTEX)]
    face = [line[2:] for line in batch if line.startswith(_FACE)]
    verts = table(vertex, float, (0, 1, 2)) if vertex else np.empty((0, 3))
    polygons = np.empty((0, 3), dtype=np.int64)
    if face:
        block = b"".join(face)
        polygons = table((_SLASHES.sub(b"", block) if b"/" in block else block).splitlines(), np.int64)
    if len(verts) != len(vertex) or len(polygons) != len(face):
        raise ValueError("a vertex or a face of nothing, which would shift the indices")
    if polygons.shape[1] < 3 or (len(polygons) and polygons.min() < 1):
        raise ValueError("short faces or relative indices")
    mesh.add_verts(verts)
    mesh.add_polygons(polygons - 1)


def _lines(batch: list[bytes], start: int, mesh: Growing, *, ends: bool) -> None:
    """Line by line; ``start`` lines came before, and ``ends`` says that none come after."""
    verts: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in _joined(batch, start):
        kind, *fields = line.split(b"#")[0].split() or [b""]
        try:
            if kind == b"v":
                x, y, z, *_ = map(float, fields)  # a weight or a colour may follow
                verts.append([x, y, z])
            elif kind == b"f":
                polygons.append(_corners(fields, mesh.count + len(verts)))
        except ValueError:
            what = VERTEX_IS if kind == b"v" else _FACE_IS
            raise blame(number, line, what, last=ends and number == start + len(batch)) from None
    mesh.add_verts(np.array(verts, dtype=float).reshape(-1, 3))
    mesh.add_mixed(polygons)


def _joined(lines: Iterable[bytes], start: int = 0) -> Iterator[Row]:
    """Lines, those that end in a backslash with the next one; each has the number of the last of them."""
    whole, number = b"", start
    for number, line in enumerate(lines, start + 1):
        whole += line.rstrip(b"\r\n")
        if whole.endswith(b"\\"):
            whole = whole[:-1] + b" "
        else:
            yield number, whole
            whole = b""
    if whole:
        yield number, whole


def _corners(fields: list[bytes], count: int) -> list[int]:
    """Vertices of a face, counted from 0; negative numbers count back from the ``count`` vertices read so far."""
    corners = [int(field.split(b"/")[0]) for field in fields]
    if len(corners) < 3 or 0 in corners or max(map(abs, corners)) >= 2**63:
        raise ValueError
    return [i - 1 if i > 0 else count + i for i in corners]


def _strange_face(path: Path, num_verts: int) -> ValueError:
    """What to raise of a file with faces that refer to vertices that are not there; it is read once more."""
    strange: list[Row] = []
    count = 0
    with path.open("rb") as stream:
        for number, line in _joined(stream):
            kind, *fields = line.split(b"#")[0].split() or [b""]
            count += kind == b"v"
            if kind == b"f":
                corners = _corners(fields, count)
                if not 0 <= min(corners) <= max(corners) < num_verts:
                    strange.append((number, line))
    return blame(*strange[0], strange_corners(num_verts, len(strange), origin=1))
