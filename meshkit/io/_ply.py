"""Reader of PLY files, text and binary: vertices as they stand in the file, polygons as triangles.

What the header claims is held against the bytes that are there before any of them is read.
"""

import struct
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshkit.io._lines import (
    COPY_AGAIN,
    Growing,
    add_faces,
    add_verts,
    corners_of,
    read_rows,
)
from meshkit.io._mesh import Parsed
from meshkit.io._ply_header import Element, read_header
from meshkit.io.report import counted

_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}  # of struct
_CORNERS = ("vertex_indices", "vertex_index")


def read_ply(path: Path, _limit: int) -> Parsed:
    """Vertices and faces of a PLY file; all else in it is passed over."""
    with path.open("rb") as stream:
        order, elements, number = read_header(stream)
        by_name = {element.name: element for element in elements}
        if len(by_name) < len(elements):
            raise ValueError("its header names an element twice")
        columns = _columns(by_name.get("vertex"))
        face = by_name.get("face")
        if face and not any(p.name in _CORNERS and p.size and p.kind[0] in "iu" for p in face.properties):
            raise ValueError(f"its faces have no list of integers {' or '.join(_CORNERS)}")
        if not face and "tristrips" in by_name:
            raise ValueError("its faces are triangle strips; export it with triangles")
        mesh = Growing()
        if order:
            _binary(stream, order, elements, mesh)
        else:
            _text(stream, elements, mesh, columns, number)
    return mesh.parsed()


def _columns(vertex: Element | None) -> tuple[int, ...]:
    if vertex is None:
        raise ValueError("its header has no element vertex")
    names = [p.name for p in vertex.properties]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise ValueError(f"its vertices have no property {', '.join(missing)}; they have {', '.join(names) or 'none'}")
    if vertex.lists:
        raise ValueError("its vertices have properties that are lists, which are not read")
    return tuple(names.index(axis) for axis in "xyz")


def _text(stream: BinaryIO, elements: list[Element], mesh: Growing, columns: tuple[int, ...], number: int) -> None:
    lines = ((n, content) for n, line in enumerate(stream, number + 1) if (content := line.strip()))
    for element in elements:
        if element.name == "vertex":
            read_rows(lines, element.rows, "vertices", partial(add_verts, mesh=mesh, columns=columns))
        elif element.name == "face":
            plain = element.properties[0].name in _CORNERS
            corners = corners_of if plain else partial(_corners_after, element)
            read_rows(lines, element.rows, "faces", partial(add_faces, mesh=mesh, corners=corners))
        elif element.properties:
            read_rows(lines, element.rows, f"rows of {element.name}", lambda rows, ends: None)


def _corners_after(element: Element, row: bytes) -> list[int]:
    """Corners of a face that has other properties before them."""
    fields = row.split()
    at = 0
    for item in element.properties:
        if item.name in _CORNERS:
            break
        at += 1 + (int(fields[at]) if item.size else 0)
    return corners_of(b" ".join(fields[at:]))


def _binary(stream: BinaryIO, order: str, elements: list[Element], mesh: Growing) -> None:
    at = 0
    start = stream.tell()
    data = stream.read()
    for element in elements:
        what = {"vertex": "vertices", "face": "faces"}.get(element.name, f"rows of {element.name}")
        smallest = sum(int((p.size or p.kind)[1]) for p in element.properties)
        if at + smallest * element.rows > len(data):
            end = f"{start + at + smallest * element.rows:,}{' or later' * element.lists}"
            raise ValueError(
                f"cut short: the {what} end at byte {end}, the file at {start + len(data):,}; {COPY_AGAIN}"
            )
        alike = _alike(element, order, data, at)
        if alike is not None:
            if element.name == "vertex":
                mesh.add_verts(np.stack([alike[axis].astype(np.float64) for axis in "xyz"], axis=1))
            elif element.name == "face":
                name = next(n for n in _CORNERS if n in (alike.dtype.names or ()))
                mesh.add_polygons(alike[name].astype(np.int64))
            at += alike.nbytes
        else:
            polygons, at = _walk(element, order, data, at, start)
            if element.name == "face":
                mesh.add_mixed(polygons)


def _alike(element: Element, order: str, data: bytes, at: int) -> np.ndarray | None:
    """Rows whose lists are as long as those of the first, as a structured array; ``None`` if they are not alike."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    place, sizes = at, {}
    for name, kind, size in element.properties:
        if size and element.rows:
            long = int(np.frombuffer(data, order + size, 1, place)[0]) if place + int(size[1]) <= len(data) else -1
            if not 0 <= long <= 255 or (name in _CORNERS and long < 3):
                return None
            fields += [(f"{name} size", order + size), (name, order + kind, (long,))]
            sizes[f"{name} size"] = long
            place += int(size[1]) + long * int(kind[1])
        else:
            fields.append((name, order + kind, (3,)) if size else (name, order + kind))
            place += int(kind[1])
    row = np.dtype(fields)
    if row.itemsize * element.rows > len(data) - at or (not row.itemsize and element.rows):
        return None
    rows = np.frombuffer(data, row, element.rows, at)
    return rows if all((rows[name] == size).all() for name, size in sizes.items()) else None


def _walk(element: Element, order: str, data: bytes, at: int, start: int) -> tuple[list[tuple[int, ...]], int]:
    """Corners of rows of different lengths, and where they end."""
    polygons: list[tuple[int, ...]] = []
    for row in range(element.rows if element.properties else 0):
        begin = at
        try:
            for name, kind, size in element.properties:
                long = 1
                if size:
                    (long,) = struct.unpack_from(order + _CODES[size], data, at)
                    at += int(size[1])
                end = at + long * int(kind[1])
                if not at <= end <= len(data):
                    raise ValueError(
                        f"a list of {long:,} entries ends at byte {start + end:,} of {start + len(data):,}"
                    )
                if element.name == "face" and name in _CORNERS:
                    if long < 3:
                        raise ValueError(f"it has {counted(long, 'corner')}, three or more are needed")
                    polygons.append(struct.unpack_from(f"{order}{long}{_CODES[kind]}", data, at))
                at = end
        except (ValueError, struct.error) as error:
            reason = "the file ends there" if isinstance(error, struct.error) else error
            raise ValueError(
                f"{element.name} {row} (counting from 0, at byte {start + begin:,}): {reason}; {COPY_AGAIN}"
            ) from None
    return polygons, at
