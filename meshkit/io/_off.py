"""Reader of OFF files: vertices as they stand in the file, polygons as triangles."""

from functools import partial
from pathlib import Path

from meshkit.io._lines import TOO_EARLY, Growing, add_faces, add_verts, blame, read_rows, shown
from meshkit.io._mesh import Parsed

_COUNTS_ARE = "the numbers of vertices and of faces should stand there"


def read_off(path: Path, _limit: int) -> Parsed:
    """Vertices and faces of an OFF file, with or without colours and normals."""
    mesh = Growing()
    with path.open("rb") as stream:
        lines = ((n, content) for n, line in enumerate(stream, 1) if (content := line.split(b"#")[0].strip()))
        number, first = next(lines, (0, b""))
        header = first.split()
        if not header:
            raise ValueError(TOO_EARLY)
        if header[0] not in {b"OFF", b"COFF", b"NOFF", b"CNOFF"}:
            raise ValueError(f"the first word is {shown(header[0][:20])}, not OFF")
        counts = header[1:]
        if not counts:  # they may follow the keyword
            number, first = next(lines, (0, b""))
            counts = first.split()
        if not counts:
            raise ValueError(TOO_EARLY)
        try:
            num_verts, num_faces, *_ = map(int, counts)
            if min(num_verts, num_faces) < 0:
                raise ValueError
        except ValueError:
            raise blame(number, first, _COUNTS_ARE) from None
        read_rows(lines, num_verts, "vertices", partial(add_verts, mesh=mesh))
        read_rows(lines, num_faces, "faces", partial(add_faces, mesh=mesh))
    return mesh.parsed()
