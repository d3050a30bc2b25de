"""GLB files, through trimesh, with checks of what trimesh takes on trust."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from meshkit.io._lines import COPY_AGAIN, EMPTY
from meshkit.io._mesh import Parsed
from meshkit.io._trimesh import trimesh_reads

_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # of a component
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_Tree = dict[str, Any]


def read_glb(path: Path, limit: int) -> Parsed:
    """Meshes of a GLB file, concatenated, each in its place."""
    import trimesh

    parts = [g for g in read_scene(path, limit).dump() if isinstance(g, trimesh.Trimesh | trimesh.PointCloud)]
    if not parts:
        raise ValueError("no mesh in it")
    triangles = [np.asarray(getattr(part, "faces", np.empty((0, 3))), dtype=np.int64) for part in parts]
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    verts = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    return Parsed(verts, np.concatenate([part + offset for part, offset in zip(triangles, offsets, strict=True)]))


def read_scene(path: Path, limit: int) -> Any:
    """The trimesh scene of a GLB file, whose meshes in their places take no more than ``limit`` bytes."""
    import trimesh

    _check_tree(*_chunks(path), path.stat().st_size)
    with trimesh_reads():
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
    uses = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
    bytes_needed = 24 * sum(len(part.vertices) + len(getattr(part, "faces", ())) for part in uses)
    if bytes_needed > max(limit, 2**20):  # a small file can place one mesh many times
        raise ValueError(f"its {len(uses)} meshes would take {bytes_needed / 2**20:,.0f} MiB, more than max_bytes")
    return scene


def _chunks(path: Path) -> tuple[_Tree, int]:
    """The JSON of a GLB file, and the size of its data."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(20)
        if head[:4] != b"glTF":
            raise ValueError("it does not start with glTF" if head else EMPTY)
        if len(head) < 20:
            raise ValueError(f"cut short: {size} bytes, its header alone has 20; {COPY_AGAIN}")
        _, version, length, chunk, kind = struct.unpack("<4s4I", head)
        if length != size:
            raise ValueError(f"damaged or truncated: {size:,} bytes, its header says {length:,}; {COPY_AGAIN}")
        if version != 2:
            raise ValueError(f"glTF version {version}, only 2 is read; export it as glTF 2.0")
        if kind != _JSON or chunk > size - 20:
            raise ValueError(f"damaged: no JSON of {chunk:,} bytes after its header; {COPY_AGAIN}")
        try:
            tree = json.loads(stream.read(chunk))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"damaged: its JSON cannot be read, {error}; {COPY_AGAIN}") from None
        data = stream.read(8)
        if not data:
            return tree, 0
        if len(data) < 8 or data[4:] != _BIN.to_bytes(4, "little"):
            raise ValueError(f"damaged: no data after its JSON, at byte {20 + chunk:,}; {COPY_AGAIN}")
        room, left = int.from_bytes(data[:4], "little"), size - 28 - chunk
        if room > left:
            raise ValueError(f"damaged: data of {room:,} bytes, and {left:,} are left in the file; {COPY_AGAIN}")
        return tree, room


def _check_tree(tree: _Tree, room: int, file_size: int) -> None:
    """Refuse what points at nothing: numbers of things that are not there, and arrays longer than their data."""
    if not isinstance(tree, dict):
        raise ValueError(f"damaged: its JSON is no object; {COPY_AGAIN}")
    if "KHR_draco_mesh_compression" in tree.get("extensionsRequired", ()):
        raise ValueError("its meshes are compressed with Draco; export it without compression")
    sizes = [_whole(buffer, "byteLength", "buffer") for buffer in _things(tree, "buffers")]
    if sizes and "uri" not in tree["buffers"][0] and sizes[0] > room:
        raise ValueError(f"damaged: its buffer has {sizes[0]:,} bytes, its data {room:,}; {COPY_AGAIN}")
    views, accessors = _things(tree, "bufferViews"), _things(tree, "accessors")
    for number, view in enumerate(views):
        end = _whole(view, "byteOffset", "bufferView", 0) + _whole(view, "byteLength", "bufferView")
        _fits(f"bufferView {number}", end, sizes[_index(view, "buffer", sizes, "bufferView")], "buffer")
    for number, accessor in enumerate(accessors):
        _check_accessor(number, accessor, views, file_size)
    for primitive in (p for mesh in _things(tree, "meshes") for p in _things(mesh, "primitives")):
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            raise ValueError(f"damaged: a primitive has no attributes; {COPY_AGAIN}")
        used = [accessors[_index(attributes, "POSITION", accessors, "primitive.attributes")]]
        if used[0]["type"] != "VEC3" or used[0].get("normalized"):
            raise ValueError("its positions are not plain triples; export it without quantization")
        if "indices" in primitive:
            used.append(accessors[_index(primitive, "indices", accessors, "primitive")])
        if any("sparse" in accessor for accessor in used):
            raise ValueError("it has sparse arrays, which are not read; export it without them")
    _check_nodes(_things(tree, "nodes"), _things(tree, "meshes"))


def _check_accessor(number: int, accessor: _Tree, views: list[_Tree], file_size: int) -> None:
    count = _whole(accessor, "count", "accessor")
    if count > file_size:  # one without a bufferView is so many zeros
        raise ValueError(f"damaged: an array of {count} elements cannot be in a file of {file_size} bytes")
    size = _BYTES.get(_whole(accessor, "componentType", "accessor"))
    width = _WIDTH.get(str(accessor.get("type")))
    if size is None or width is None:
        raise ValueError(f"damaged: accessor {number} is of an unknown type; {COPY_AGAIN}")
    if "bufferView" not in accessor:
        return
    view = views[_index(accessor, "bufferView", views, "accessor")]
    stride = _whole(view, "byteStride", "bufferView", 0) or size * width
    begin = _whole(accessor, "byteOffset", "accessor", 0)
    _fits(f"accessor {number}", begin + max(count - 1, 0) * stride + size * width, view["byteLength"], "bufferView")


def _check_nodes(nodes: list[_Tree], meshes: list[_Tree]) -> None:
    parent: dict[int, int] = {}
    for number, node in enumerate(nodes):
        if "mesh" in node:
            _index(node, "mesh", meshes, "node")
        for value in node.get("children", ()):
            child = _index({"children": value}, "children", nodes, "node")
            if child in parent:
                raise ValueError(f"damaged: node {child} has two parents; {COPY_AGAIN}")
            parent[child] = number
    seen: set[int] = set()  # nodes whose chain of parents ends
    for start in range(len(nodes)):
        chain: set[int] = set()
        at = start
        while at in parent and at not in seen:
            if at in chain:
                raise ValueError(f"damaged: node {at} is below itself; {COPY_AGAIN}")
            chain.add(at)
            at = parent[at]
        seen |= chain


def _things(tree: _Tree, key: str) -> list[_Tree]:
    things = tree.get(key, [])
    if not isinstance(things, list) or not all(isinstance(thing, dict) for thing in things):
        raise ValueError(f"damaged: its {key} are no list of objects; {COPY_AGAIN}")
    return things


def _whole(thing: _Tree, key: str, what: str, default: int | None = None) -> int:
    value = thing.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"damaged: {what}.{key} is {value!r}, not a whole number; {COPY_AGAIN}")
    return value


def _index(thing: _Tree, key: str, things: list[Any], what: str) -> int:
    value = _whole(thing, key, what)
    if value >= len(things):
        raise ValueError(f"damaged: {what}.{key} is {value}, and there are {len(things)}, counted from 0; {COPY_AGAIN}")
    return value


def _fits(what: str, end: int, room: int, inside: str) -> None:
    if end > room:
        raise ValueError(f"damaged: {what} ends at byte {end:,} of a {inside} of {room:,}; {COPY_AGAIN}")
