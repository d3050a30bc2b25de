"""PLY, STL and GLB files, through trimesh, with checks of what trimesh takes on trust."""

import json
import struct
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from meshkit.io._mesh import Indices, Parsed, Points


def read_binary(path: Path, limit: int) -> Parsed:
    """PLY, STL and GLB through trimesh."""
    import trimesh

    extension = path.suffix.lower()
    scene = read_scene(path, limit)
    parts = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh | trimesh.PointCloud)]
    if not parts:
        raise ValueError("no mesh in it")
    triangles = [np.asarray(getattr(part, "faces", np.empty((0, 3))), dtype=np.int64) for part in parts]
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    verts = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    faces = np.concatenate([part + offset for part, offset in zip(triangles, offsets, strict=True)])
    if extension == ".stl":
        return Parsed(*_weld(verts, faces))
    return Parsed(verts, faces, _check_ply(path, verts, faces) if extension == ".ply" else 0)


def read_scene(path: Path, limit: int) -> Any:
    """The trimesh scene of a PLY, STL or GLB file, whose meshes in their places take no more than ``limit`` bytes."""
    import trimesh

    extension = path.suffix.lower()
    if extension in (".glb", ".stl"):
        (_check_glb if extension == ".glb" else _check_stl)(path)
    # fix_texture would repeat the vertices of a PLY along its texture seams.
    options: dict[str, Any] = {"fix_texture": False} if extension == ".ply" else {}
    scene = trimesh.load_scene(path, process=False, **options)
    uses = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
    bytes_needed = 24 * sum(len(part.vertices) + len(getattr(part, "faces", ())) for part in uses)
    if bytes_needed > max(limit, 2**20):  # a small file can place one mesh many times
        raise ValueError(f"its {len(uses)} meshes would take {bytes_needed / 2**20:,.0f} MiB, more than max_bytes")
    return scene


def _check_ply(path: Path, verts: Points, faces: Indices) -> int:
    """Compare what was read with the header, since text that ends early is read as far as it goes.

    Returns the number of faces in the header if there were polygons among them, else 0.
    """
    declared = {"vertex": 0, "face": 0}
    with path.open("rb") as stream:
        for line in islice(stream, 1000):
            if line.startswith(b"end_header"):
                break
            words = line.split()
            if words[:1] == [b"element"] and len(words) == 3 and words[1].decode() in declared:
                declared[words[1].decode()] = int(words[2])
    if len(verts) != declared["vertex"] or len(faces) < declared["face"]:
        raise ValueError(
            f"truncated: the header declares {declared['vertex']} vertices and {declared['face']} faces, "
            f"{len(verts)} and {len(faces)} are there"
        )
    return declared["face"] if len(faces) > declared["face"] else 0


def _check_stl(path: Path) -> None:
    """Text is read as far as it goes; the end must be there."""
    with path.open("rb") as stream:
        start = stream.read(1024)
        stream.seek(max(path.stat().st_size - 1024, 0))
        end = stream.read()
    if start.lstrip()[:5].lower() == b"solid" and b"facet" in start and b"endsolid" not in end.lower():
        raise ValueError("truncated: there is no endsolid")


def _check_glb(path: Path) -> None:
    """Refuse arrays that are longer than the file: one without data reads as so many zeros."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(20)
        if len(head) < 20 or head[:4] != b"glTF":
            raise ValueError("it does not start with glTF")
        _, _, length, chunk, kind = struct.unpack("<4sIII4s", head)
        if kind != b"JSON" or length != size or chunk > size:
            raise ValueError(f"damaged or truncated: {size} bytes, its header says {length}")
        tree = json.loads(stream.read(chunk))
    if "KHR_draco_mesh_compression" in tree.get("extensionsRequired", ()):
        raise ValueError("its meshes are compressed with Draco; export it without compression")
    counts = [int(accessor.get("count", 0)) for accessor in tree.get("accessors", ())]
    if max(counts, default=0) > size:
        raise ValueError(f"an array of {max(counts)} elements cannot be in a file of {size} bytes")


def _weld(verts: Points, faces: Indices) -> tuple[Points, Indices]:
    """One vertex per distinct coordinate triple, in order of first appearance."""
    _, first, inverse = np.unique(verts, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return verts[first[order]], rank[inverse.reshape(-1)][faces]
