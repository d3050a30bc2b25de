"""PLY files: binary ones through trimesh, with checks of what trimesh takes on trust."""

import re
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshkit.io._lines import COPY_AGAIN, EMPTY, TOO_EARLY, Growing, shown
from meshkit.io._mesh import Parsed
from meshkit.io._ply_text import Types, read_text
from meshkit.io._trimesh import trimesh_reads

_FORMATS = [[b"format", kind, b"1.0"] for kind in (b"ascii", b"binary_little_endian", b"binary_big_endian")]
_CORNERS = ("vertex_indices", "vertex_index")
_INTEGERS = re.compile(r"list \w+ u?(char|short|int)\d*")
_ALIKE = "copy it again, or export it with triangles: in binary all faces must have as many corners as the first"
_BYTES = (
    dict.fromkeys(("char", "uchar", "int8", "uint8"), 1)
    | dict.fromkeys(("short", "ushort", "int16", "uint16"), 2)
    | dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4)
    | dict.fromkeys(("double", "float64"), 8)
)


def read_ply(path: Path, _limit: int) -> Parsed:
    """Vertices as they stand in a PLY file, and its polygons as triangles; all else in it is passed over."""
    from trimesh.exchange.ply import load_ply

    with path.open("rb") as stream:
        binary, length, claims, types = _header(stream)
        name = _corners(claims, types)
        if not binary:
            return read_text(enumerate(stream, length + 1), claims, types, name)
        claim = sum(rows * _least(types[element]) for element, rows in claims.items())
        _hold("bytes or more", claim, path.stat().st_size - stream.tell())
    with _Header(path.open("rb", buffering=0)) as stream, trimesh_reads(_ALIKE):  # type: ignore[type-var]
        # The rows, for the mesh of trimesh has quads after triangles; fix_texture would repeat vertices along seams.
        rows = load_ply(stream, fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]
        verts = np.column_stack([np.ravel(rows["vertex"]["data"][axis]) for axis in "xyz"]).astype(np.float64)
        corners = rows["face"]["data"][name]
        sizes, corners = (corners[key] for key in corners.dtype.names)
        lengths = np.array([len(polygon) for polygon in corners])
    _hold("vertices", claims["vertex"], len(verts))
    _hold("faces", claims["face"], len(corners))
    if min(lengths) < 3:
        raise ValueError(f"damaged: it has faces with fewer than three corners; {_ALIKE}")
    if (wrong := np.flatnonzero(lengths != sizes)).size:  # trimesh takes all lists to be as long as the first
        first = wrong[0]
        raise ValueError(f"face {first} says it has {sizes[first]} corners, trimesh reads {lengths[first]}; {_ALIKE}")
    mesh = Growing()
    mesh.add_verts(verts)
    if corners.ndim == 2:
        mesh.add_polygons(corners.astype(np.int64))
    else:
        mesh.add_mixed([polygon.tolist() for polygon in corners])
    return mesh.parsed()


class _Header(BufferedReader):
    """A file whose lines, those of the header, are ASCII: trimesh takes them for UTF-8, and comments may be neither."""

    def readline(self, size: int | None = -1) -> bytes:
        return super().readline(size).decode("ascii", "replace").encode("ascii", "replace")


def _header(stream: BinaryIO) -> tuple[bool, int, dict[str, int], Types]:
    """Whether the data are binary, the header's lines, the numbers of rows, and the types."""
    if not (first := stream.readline()):
        raise ValueError(EMPTY)
    if first.strip() != b"ply":
        raise ValueError(f"the first line is {shown(first)}, not ply")
    if (second := stream.readline()).split() not in _FORMATS:  # trimesh looks nowhere else for it
        raise ValueError(f"the second line is {shown(second)}; its format, as 'format ascii 1.0', should stand there")
    rows: dict[str, int] = {}
    types: Types = {}
    element = ""
    for length, line in enumerate(stream, 3):
        match line.decode(errors="replace").split():
            case ["end_header"]:
                return b"ascii" not in second, length, rows, types
            case ["comment" | "obj_info", *words] if "end_header" not in words:  # where trimesh would stop
                pass
            case ["element", element, count] if element not in rows and re.fullmatch("[0-9]{1,15}", count):
                rows[element], types[element] = int(count), {}
            case ["property", "list", size, kind, name] if (
                name not in types.get(element, name) and {size, kind} <= _BYTES.keys()
            ):
                types[element][name] = f"list {size} {kind}"
            case ["property", kind, name] if name not in types.get(element, name) and kind in _BYTES:
                types[element][name] = kind
            case _:
                raise ValueError(f"{shown(line)} is no line of the header of a PLY file; {COPY_AGAIN}")
    raise ValueError(f"{TOO_EARLY}: there is no end_header")


def _corners(claims: dict[str, int], types: Types) -> str:
    """The property with the corners of the faces; raises where there is no mesh."""
    missing = [axis for axis in "xyz" if types.get("vertex", {}).get(axis, "list").startswith("list")]
    if missing or not claims["vertex"]:
        raise ValueError(f"it has no vertices{' with ' * bool(missing)}{', '.join(missing)}")
    if not claims.get("face"):
        strips = "its faces are triangle strips; export it with triangles"
        raise ValueError(strips if "tristrips" in claims else "no faces; a point cloud must be meshed first")
    for name in _CORNERS:
        if _INTEGERS.fullmatch(types["face"].get(name, "")):
            return name
    raise ValueError(f"its faces have no list of integers {' or '.join(_CORNERS)}")


def _least(kinds: dict[str, str]) -> int:
    """Bytes of a row in binary, where its lists are empty."""
    return sum(_BYTES[kind.removeprefix("list ").split()[0]] for kind in kinds.values())


def _hold(what: str, claim: int, there: int) -> None:
    """Hold a claim of the header against what there is."""
    if there < claim:
        raise ValueError(f"cut short: its header claims {claim:,} {what} and {there:,} are there; {COPY_AGAIN}")
