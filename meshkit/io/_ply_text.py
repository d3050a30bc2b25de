"""The data of text PLY files: one row in a line, as the header names its numbers and lists."""

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np

from meshkit.io._lines import Growing, Row, add_verts, blame, read_rows, table
from meshkit.io._mesh import Indices, Parsed

Types = dict[str, dict[str, str]]  # of the properties of each element


def read_text(lines: Iterable[Row], claims: dict[str, int], types: Types, name: str) -> Parsed:
    """Vertices and polygons from the numbered lines after the header; lines without anything are passed over.

    Args:
        lines: of the file.
        claims: the number of rows of each element, in their order.
        types: of the properties of each.
        name: the property of a face that lists its corners.
    """
    rows = ((number, content) for number, line in lines if (content := line.strip()))
    mesh = Growing()
    for element, count in claims.items():
        if element == "vertex":
            order, kinds = list(types[element]), list(types[element].values())
            columns = tuple(map(order.index, "xyz"))
            if any(kind.startswith("list") for kind in kinds[: max(columns)]):
                raise ValueError("its vertices have a list before x, y or z; export it without")
            width = None if any(kind.startswith("list") for kind in kinds) else len(kinds)
            read_rows(rows, count, "vertices", partial(_add_verts, mesh=mesh, columns=columns, width=width))
        elif element == "face":
            face = _Face(types[element], name)
            read_rows(rows, count, "faces", partial(face.add, mesh=mesh))
        elif types[element]:
            read_rows(rows, count, f"rows of {element!r}", lambda *_: None)
    return mesh.parsed()


def _add_verts(rows: list[Row], ends: bool, mesh: Growing, columns: tuple[int, ...], width: int | None) -> None:
    """Vertices, one in a line, of as many numbers as the header names, if that is known."""
    add_verts(rows, ends, mesh, columns)
    for number, line in rows:
        if width is not None and (there := len(line.split())) != width:
            raise blame(number, line, f"the header names {width} numbers of a vertex, here are {there}")


class _Face(NamedTuple):
    """What stands in the line of a face."""

    types: dict[str, str]
    name: str

    def add(self, rows: list[Row], ends: bool, mesh: Growing) -> None:
        """Add the polygons of a batch of lines: at once where they are alike, else one by one."""
        if (alike := self.alike(rows)) is not None:
            mesh.add_polygons(alike)
            return
        polygons = []
        for number, line in rows:
            try:
                polygons.append(self.corners(line.split()))
            except (ValueError, IndexError):
                raise blame(number, line, self.meant(), last=ends and number == rows[-1][0]) from None
        mesh.add_mixed(polygons)

    def alike(self, rows: list[Row]) -> Indices | None:
        """Polygons (P, K) of lines that have K corners and no other list; ``None`` where they are not so."""
        if sum(kind.startswith("list") for kind in self.types.values()) != 1:
            return None
        try:
            columns = table([line for _, line in rows], float)
        except ValueError:
            return None
        place, size = list(self.types).index(self.name), columns.shape[1] - len(self.types)
        polygons = columns[:, place + 1 : place + 1 + size]
        if size < 3 or (columns[:, place] != size).any() or not (abs(polygons) < 2**53).all():
            return None
        whole = polygons.astype(np.int64)
        return whole if (whole == polygons).all() else None

    def corners(self, fields: list[bytes]) -> list[int]:
        """The corners in one line; raises where it is not what the header says."""
        place, found = 0, list[int]()
        for name, kind in self.types.items():
            size = int(fields[place]) if kind.startswith("list") else 0
            if size < 0:
                raise ValueError
            if name == self.name:
                found = list(map(int, fields[place + 1 : place + 1 + size]))
            place += 1 + size
        if len(found) < 3 or place != len(fields) or max(map(abs, found)) >= 2**63:
            raise ValueError
        return found

    def meant(self) -> str:
        what = f"a face is its {'list' if len(self.types) == 1 else 'numbers and lists'} {', '.join(self.types)}"
        return f"{what}, a list its length and so many numbers, three corners or more"
