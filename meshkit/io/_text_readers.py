"""Readers of OBJ and OFF files: vertices as they stand in the file, polygons as triangles.

Text is read in batches, so that what is held beside the result does not grow with the file. A batch is parsed at once
where its lines are all alike, and line by line where they are not, which also finds the line to blame.
"""

import re
from collections.abc import Callable, Iterator
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from meshkit.io._mesh import Indices, Parsed, Points

_BATCH_BYTES = 2**25
_BATCH_LINES = 2**18
_VERTEX = (b"v ", b"v\t")
_FACE = (b"f ", b"f\t")
_SLASHES = re.compile(rb"/\S*")
_SHOWN = 60  # characters of a line to blame
_ADVICE = "mend that line, or export the file again"
_VERTEX_IS = "a vertex is three numbers"
_OBJ_FACE_IS = "a face is three or more vertex numbers, counted from 1"
_OFF_FACE_IS = "a face is its number of corners, three or more, and so many vertex numbers, counted from 0"
_TOO_EARLY = "the file ends too early"
_Row = tuple[int, bytes]  # the number of a line, and what stands there


def fan(polygons: Indices) -> Indices:
    """Triangles (P * (K - 2), 3) of polygons (P, K): from the first corner to every edge that does not touch it."""
    corners = polygons.shape[1]
    steps = np.arange(1, corners - 1)[:, None] + np.array([-1, 0, 1])
    steps[:, 0] = 0
    return polygons[:, steps].reshape(-1, 3)


def _blame(number: int, line: bytes, what: str, *, last: bool = False) -> ValueError:
    """What to raise of a line, counted from 1, that cannot be read: the line, what is wrong, and what to do."""
    text = line.decode(errors="replace").strip()
    text = text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."
    advice = "it is the last line, so the file may be cut short: copy or export it again" if last else _ADVICE
    return ValueError(f"line {number}, {text!r}: {what}; {advice}")


class _Growing:
    """Arrays that grow batch by batch."""

    def __init__(self) -> None:
        self.verts: list[Points] = [np.empty((0, 3))]
        self.faces: list[Indices] = [np.empty((0, 3), dtype=np.int64)]
        self.count = 0
        self.polygons = 0

    def add_verts(self, verts: Points) -> None:
        self.verts.append(verts)
        self.count += len(verts)

    def add_polygons(self, polygons: Indices) -> None:
        self.faces.append(fan(polygons))
        self.polygons += len(polygons) * (polygons.shape[1] > 3)

    def add_mixed(self, polygons: list[list[int]]) -> None:
        """Polygons of different sizes, kept in order."""
        triangles = [(p[0], second, third) for p in polygons for second, third in pairwise(p[1:])]
        self.faces.append(np.array(triangles, dtype=np.int64).reshape(-1, 3))
        self.polygons += sum(len(p) > 3 for p in polygons)

    def parsed(self) -> Parsed:
        return Parsed(np.concatenate(self.verts), np.concatenate(self.faces), self.polygons)


def _table(lines: list[bytes], dtype: type, columns: tuple[int, ...] | None = None) -> np.ndarray:
    text = (line.decode("ascii") for line in lines)
    return np.loadtxt(text, dtype=dtype, comments="#", usecols=columns, ndmin=2)


def read_obj(path: Path, _limit: int) -> Parsed:
    """Vertices and faces of an OBJ file; texture, normals, materials and groups are passed over."""
    mesh, number = _Growing(), 0
    with path.open("rb") as stream:
        while batch := stream.readlines(_BATCH_BYTES):
            while batch[-1].rstrip().endswith(b"\\") and (more := stream.readline()):
                batch.append(more)
            try:
                _obj_batch(batch, mesh)
            except ValueError:
                _obj_lines(batch, number, mesh, ends=stream.tell() == path.stat().st_size)
            number += len(batch)
    if not mesh.count and not any(map(len, mesh.faces)):
        raise ValueError("no vertices and no faces in it")
    return mesh.parsed()


def _obj_batch(batch: list[bytes], mesh: _Growing) -> None:
    """All lines at once; leaves ``mesh`` alone and raises where they are not plain."""
    if any(line[:1].isspace() and line.strip() for line in batch) or any(b"\\" in line for line in batch):
        raise ValueError("indented or continued lines")
    vertex = [line[2:] for line in batch if line.startswith(_VERTEX)]
    face = [line[2:] for line in batch if line.startswith(_FACE)]
    verts = _table(vertex, float, (0, 1, 2)) if vertex else np.empty((0, 3))
    polygons = np.empty((0, 3), dtype=np.int64)
    if face:
        block = b"".join(face)
        polygons = _table((_SLASHES.sub(b"", block) if b"/" in block else block).splitlines(), np.int64)
    if len(verts) != len(vertex) or len(polygons) != len(face):
        raise ValueError("a vertex or a face of nothing, which would shift the indices")
    if polygons.shape[1] < 3 or (len(polygons) and polygons.min() < 1):
        raise ValueError("short faces or relative indices")
    mesh.add_verts(verts)
    mesh.add_polygons(polygons - 1)


def _obj_lines(batch: list[bytes], start: int, mesh: _Growing, *, ends: bool) -> None:
    """Line by line; ``start`` lines came before, and ``ends`` says that none come after."""
    whole = b""
    verts: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(batch, start + 1):
        whole += line.rstrip(b"\r\n")
        if whole.endswith(b"\\"):
            whole = whole[:-1] + b" "
            continue
        kind, *fields = whole.split(b"#")[0].split() or [b""]
        read, whole = whole, b""
        try:
            if kind == b"v":
                x, y, z, *_ = map(float, fields)  # a weight or a colour may follow
                verts.append([x, y, z])
            elif kind == b"f":
                corners = [int(field.split(b"/")[0]) for field in fields]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError
                # Negative indices count back from the vertices read so far.
                polygons.append([i - 1 if i > 0 else mesh.count + len(verts) + i for i in corners])
        except (ValueError, OverflowError):
            what = _VERTEX_IS if kind == b"v" else _OBJ_FACE_IS
            raise _blame(number, read, what, last=ends and number == start + len(batch)) from None
    mesh.add_verts(np.array(verts, dtype=float).reshape(-1, 3))
    mesh.add_mixed(polygons)


def read_off(path: Path, _limit: int) -> Parsed:
    """Vertices and faces of an OFF file, with or without colours and normals."""
    mesh = _Growing()
    with path.open("rb") as stream:
        lines = ((n, content) for n, line in enumerate(stream, 1) if (content := line.split(b"#")[0].strip()))
        number, first = next(lines, (0, b""))
        header = first.split()
        if not header:
            raise ValueError(_TOO_EARLY)
        if header[0] not in {b"OFF", b"COFF", b"NOFF", b"CNOFF"}:
            raise ValueError(f"the first word is {header[0][:20].decode(errors='replace')!r}, not OFF")
        counts = header[1:]
        if not counts:  # they may follow the keyword
            number, first = next(lines, (0, b""))
            counts = first.split()
        if len(counts) < 2:
            raise ValueError(_TOO_EARLY)
        try:
            vertex_count, face_count, *_ = map(int, counts)
        except ValueError:
            raise _blame(number, first, "the numbers of vertices and of faces should stand there") from None
        _off_rows(lines, vertex_count, lambda rows: _off_verts(rows, mesh))
        _off_rows(lines, face_count, lambda rows: _off_faces(rows, mesh))
    return mesh.parsed()


def _off_rows(lines: Iterator[_Row], count: int, read: Callable[[list[_Row]], None]) -> None:
    done = 0
    while done < count:
        rows = list(islice(lines, min(count - done, _BATCH_LINES)))
        if not rows:
            raise ValueError(f"{_TOO_EARLY}: {done} of {count} rows are there; copy or export it again")
        read(rows)
        done += len(rows)


def _off_verts(rows: list[_Row], mesh: _Growing) -> None:
    try:
        mesh.add_verts(_table([row for _, row in rows], float, (0, 1, 2)))
    except ValueError:
        for number, row in rows:
            try:
                _, _, _, *_ = map(float, row.split())
            except ValueError:
                raise _blame(number, row, _VERTEX_IS) from None
        raise


def _off_faces(rows: list[_Row], mesh: _Growing) -> None:
    try:
        table = _table([row for _, row in rows], np.int64, (0, 1, 2, 3))
        if (table[:, 0] == 3).all():
            mesh.add_polygons(table[:, 1:])
            return
    except ValueError:
        pass
    polygons = []
    for number, row in rows:
        fields = row.split()
        try:
            size, *corners = map(int, fields[: int(fields[0]) + 1])  # a colour may follow
            if not 3 <= size <= len(corners):
                raise ValueError
        except ValueError:
            raise _blame(number, row, _OFF_FACE_IS) from None
        polygons.append(corners)
    mesh.add_mixed(polygons)
