"""PLY files, text and binary, through trimesh, with checks of what trimesh takes on trust."""

import re
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshkit.io._lines import COPY_AGAIN, EMPTY, TOO_EARLY, Growing, shown
from meshkit.io._mesh import Indices, Parsed
from meshkit.io._trimesh import trimesh_reads

_FORMATS = [[b"format", kind, b"1.0"] for kind in (b"ascii", b"binary_little_endian", b"binary_big_endian")]
_CORNERS = ("vertex_indices", "vertex_index")
_INTEGERS = re.compile(r"list \w+ u?(char|short|int)\d*")
_ALIKE = "copy it again, or export it with triangles: in binary all faces must have as many corners as the first"
_BYTES = (
    dict.fromkeys(("short", "ushort", "int16", "uint16"), 2)
    | dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4)
    | dict.fromkeys(("double", "float64"), 8)
)
_Types = dict[str, dict[str, str]]  # of the properties of each element


def read_ply(path: Path, _limit: int) -> Parsed:
    """Vertices as they stand in a PLY file, and its polygons as triangles; all else in it is passed over."""
    from trimesh.exchange.ply import load_ply

    with path.open("rb") as stream:
        binary, claims, types = _header(stream)
        name = _corners(claims, types)
        if binary:
            claim = sum(rows * _least(types[element]) for element, rows in claims.items())
            _hold("bytes or more", claim, path.stat().st_size - stream.tell())
        else:
            firsts = _first_numbers(stream, claims)
    remedy = _ALIKE if binary else COPY_AGAIN
    with path.open("rb") as stream, trimesh_reads(remedy):
        # The rows, for the mesh of trimesh has quads after triangles; fix_texture would repeat vertices along seams.
        rows = load_ply(stream, fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]
        verts = np.column_stack([np.ravel(rows["vertex"]["data"][axis]) for axis in "xyz"]).astype(np.float64)
        corners = rows["face"]["data"][name]
        sizes, corners = (corners[key] for key in corners.dtype.names) if binary else (firsts, corners)
        lengths = np.array([len(polygon) for polygon in corners])
    _hold("vertices", claims["vertex"], len(verts))
    _hold("faces", claims["face"], len(corners))
    if min(lengths) < 3:
        raise ValueError(f"damaged: it has faces with fewer than three corners; {remedy}")
    # trimesh takes the lists of binary data, and of lines with as many numbers, to be as long as the first.
    if (binary or next(iter(types["face"])) == name) and (wrong := np.flatnonzero(lengths != sizes)).size:
        first = wrong[0]
        raise ValueError(f"face {first} says it has {sizes[first]} corners, trimesh reads {lengths[first]}; {remedy}")
    mesh = Growing()
    mesh.add_verts(verts)
    if corners.ndim == 2:
        mesh.add_polygons(corners.astype(np.int64))
    else:
        mesh.add_mixed([polygon.tolist() for polygon in corners])
    return mesh.parsed()


def _header(stream: BinaryIO) -> tuple[bool, dict[str, int], _Types]:
    """Whether the data are binary, the numbers of rows, and the types; refused where trimesh would guess."""
    if not (first := stream.readline()):
        raise ValueError(EMPTY)
    if first.strip() != b"ply":
        raise ValueError(f"the first line is {shown(first)}, not ply")
    if (second := stream.readline()).split() not in _FORMATS:  # trimesh looks nowhere else for it
        raise ValueError(f"the second line is {shown(second)}; its format, as 'format ascii 1.0', should stand there")
    rows: dict[str, int] = {}
    types: _Types = {}
    element = ""
    for line in stream:
        match line.decode(errors="replace").split():
            case ["end_header"]:
                return b"ascii" not in second, rows, types
            case ["comment" | "obj_info", *words] if "end_header" not in words:  # where trimesh would stop
                pass
            case ["element", element, count] if element not in rows and re.fullmatch("[0-9]{1,15}", count):
                rows[element], types[element] = int(count), {}
            case ["property", "list", size, kind, name] if name not in types.get(element, name):
                types[element][name] = f"list {size} {kind}"
            case ["property", kind, name] if name not in types.get(element, name):
                types[element][name] = kind
            case _:
                raise ValueError(f"{shown(line)} is no line of the header of a PLY file; {COPY_AGAIN}")
    raise ValueError(f"{TOO_EARLY}: there is no end_header")


def _corners(claims: dict[str, int], types: _Types) -> str:
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
    return sum(_BYTES.get(kind.removeprefix("list ").split()[0], 1) for kind in kinds.values())


def _first_numbers(stream: BinaryIO, claims: dict[str, int]) -> Indices:
    """What the lines of faces start with in text, -1 if it is no number; the lines of all elements must be there."""
    before = sum(claims[element] for element in list(claims)[: list(claims).index("face")])
    starts = [line[:99].split()[:1] for line in islice(stream, sum(claims.values()))]
    _hold("lines, none of them empty,", sum(claims.values()), sum(map(bool, starts)))
    faces = starts[before : before + claims["face"]]
    return np.array([int(start) if start.isdigit() and len(start) < 10 else -1 for (start,) in faces])


def _hold(what: str, claim: int, there: int) -> None:
    """Hold a claim of the header against what there is."""
    if there < claim:
        raise ValueError(f"cut short: its header claims {claim:,} {what} and {there:,} are there; {COPY_AGAIN}")
