"""What the readers of text share: polygons as triangles, rows in batches, and the line to blame.

Text is read in batches, so that what is held beside the result does not grow with the file. A batch is parsed at once
where its lines are all alike, and line by line where they are not, which also finds the line to blame.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice, pairwise

import numpy as np

from meshkit.io._mesh import Indices, Parsed, Points
from meshkit.io.report import counted

_BATCH_LINES = 2**18
_SHOWN = 60  # characters of a line to blame
_ADVICE = "mend that line, or export the file again"
COPY_AGAIN = "copy or export it again"
TOO_EARLY = f"the file ends too early; {COPY_AGAIN}"
EMPTY = "the file is empty"
VERTEX_IS = "a vertex is three numbers"
_FACE_IS = "a face is its number of corners, three or more, and so many vertex numbers, counted from 0"
Row = tuple[int, bytes]  # the number of a line, and what stands there


def fan(polygons: Indices) -> Indices:
    """Triangles (P * (K - 2), 3) of polygons (P, K): from the first corner to every edge that does not touch it."""
    corners = polygons.shape[1]
    steps = np.arange(1, corners - 1)[:, None] + np.array([-1, 0, 1])
    steps[:, 0] = 0
    return polygons[:, steps].reshape(-1, 3)


def shown(line: bytes) -> str:
    """A line as it is quoted: one line of readable text, cut where it is long."""
    text = line[: 4 * _SHOWN].decode(errors="replace").strip()
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ...")


def blame(number: int, line: bytes, what: str, *, last: bool = False) -> ValueError:
    """What to raise of a line, counted from 1, that cannot be read: the line, what is wrong, and what to do."""
    advice = f"it is the last line, so the file may be cut short: {COPY_AGAIN}" if last else _ADVICE
    return ValueError(f"line {number}, {shown(line)}: {what}; {advice}")


def strange_corners(num_verts: int, num_faces: int, origin: int) -> str:
    """What is wrong where ``num_faces`` faces have a corner that is none of ``num_verts`` vertices."""
    refer = "face refers to others" if num_faces == 1 else "faces refer to others, this one first"
    return f"the file has {counted(num_verts, 'vertex')}, counted from {origin}, and {num_faces} {refer}"


class Growing:
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

    def add_mixed(self, polygons: Sequence[Sequence[int]]) -> None:
        """Polygons of different sizes, kept in order."""
        triangles = [(p[0], second, third) for p in polygons for second, third in pairwise(p[1:])]
        self.faces.append(np.array(triangles, dtype=np.int64).reshape(-1, 3))
        self.polygons += sum(len(p) > 3 for p in polygons)

    def parsed(self) -> Parsed:
        return Parsed(np.concatenate(self.verts), np.concatenate(self.faces), self.polygons)


def outside(faces: Indices, num_verts: int) -> bool:
    """Whether a corner is none of the vertices."""
    return len(faces) > 0 and not 0 <= faces.min() <= faces.max() < num_verts


def table(lines: list[bytes], dtype: type, columns: tuple[int, ...] | None = None) -> np.ndarray:
    """Numbers in lines that are all alike; raises a ``ValueError`` where they are not."""
    text = (line.decode("ascii") for line in lines)
    return np.loadtxt(text, dtype=dtype, comments="#", usecols=columns, ndmin=2)


def read_rows(lines: Iterator[Row], count: int, what: str, read: Callable[[list[Row], bool], None]) -> None:
    """Hand the next ``count`` lines to ``read``, in batches; raises where the file ends before.

    The second argument of ``read`` says that the last line of the batch is the last of the file, too early.
    """
    done = 0
    while done < count:
        wanted = min(count - done, _BATCH_LINES)
        rows = list(islice(lines, wanted))
        if not rows:
            raise ValueError(f"the file ends too early: {done} of {count} {what} are there; {COPY_AGAIN}")
        read(rows, len(rows) < wanted)
        done += len(rows)


def add_verts(rows: list[Row], ends: bool, mesh: Growing, columns: tuple[int, ...] = (0, 1, 2)) -> None:
    """Vertices, one in a line, their coordinates in these columns."""
    try:
        mesh.add_verts(table([row for _, row in rows], float, columns))
    except ValueError:
        verts = []
        for number, row in rows:
            try:
                fields = row.split()
                verts.append([float(fields[column]) for column in columns])
            except (ValueError, IndexError):
                raise blame(number, row, VERTEX_IS, last=ends and number == rows[-1][0]) from None
        mesh.add_verts(np.array(verts))


def _corners(row: bytes) -> list[int]:
    """Corners of a face whose number of corners comes first; raises a ``ValueError`` if it is not one."""
    fields = row.split()
    size, *corners = map(int, fields[: int(fields[0]) + 1] if fields else [])  # a colour may follow
    if not 3 <= size <= len(corners) or max(map(abs, corners)) >= 2**63:
        raise ValueError
    return corners


def add_faces(rows: list[Row], ends: bool, mesh: Growing) -> None:
    """Faces, one in a line, where all vertices have been read before."""
    triangles = None
    try:
        columns = table([row for _, row in rows], np.int64, (0, 1, 2, 3))
        triangles = columns[:, 1:] if (columns[:, 0] == 3).all() else None
    except ValueError:
        pass
    if triangles is not None and not outside(triangles, mesh.count):
        mesh.add_polygons(triangles)
        return
    polygons, strange = [], []
    for number, row in rows:
        try:
            polygons.append(_corners(row))
        except (ValueError, IndexError):
            raise blame(number, row, _FACE_IS, last=ends and number == rows[-1][0]) from None
        if not 0 <= min(polygons[-1]) <= max(polygons[-1]) < mesh.count:
            strange.append((number, row))
    if strange:
        raise blame(*strange[0], strange_corners(mesh.count, len(strange), origin=0))
    mesh.add_mixed(polygons)
