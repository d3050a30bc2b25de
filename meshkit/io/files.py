"""Mesh files in and out, with the order and the number of the vertices kept.

Pose transfer, correspondences and per-vertex errors all rest on the row order of the vertices, so nothing here merges,
reorders or drops a vertex. OBJ and OFF are read line by line for that reason: general readers split an OBJ by material
and repeat vertices along texture seams. PLY, STL and GLB go through trimesh.
"""

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshkit.io.atomic import atomic_write

__all__ = ["MeshFileError", "load_mesh", "save_mesh"]

_EXTENSIONS = (".glb", ".obj", ".off", ".ply", ".stl")


class MeshFileError(ValueError):
    """A file that is not a usable mesh; the message names the file and says what is wrong with it."""


def load_mesh(path: str | os.PathLike[str]) -> tuple[Tensor, Tensor]:
    """Read a triangle mesh from an OBJ, PLY, OFF, STL or GLB file.

    Vertices keep the order and number of the file, unreferenced and repeated ones included. Polygons become triangles.
    A file with several meshes (OBJ objects, GLB nodes) is read as one: the meshes are concatenated, each in its place.
    An STL file has no vertices, only loose triangles: corners with equal coordinates become one vertex, in order of
    appearance. Normals, texture coordinates, colours and materials are ignored.

    Args:
        path: the file; its extension names the format.

    Returns:
        Vertices (V, 3) float32, in the file's unit, and faces (F, 3) int64.

    Raises:
        MeshFileError: the file does not exist, has another extension, is damaged, has no faces, fewer than 3 vertices,
            a coordinate that is not finite, or a face that refers to a vertex that is not there.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "square.obj"
        >>> _ = file.write_text("v 0 0 0\\nv 1 0 0\\nv 1 1 0\\nv 0 1 0\\nf 1 2 3 4\\n")
        >>> verts, faces = load_mesh(file)
        >>> verts.shape, faces.tolist()
        (torch.Size([4, 3]), [[0, 1, 2], [0, 2, 3]])
    """
    path = Path(path)
    extension = _extension(path, "read")
    if not path.is_file():
        raise MeshFileError(f"{path}: {'a folder, not a mesh file' if path.is_dir() else 'no such file'}")
    reader = {".obj": _read_obj, ".off": _read_off}.get(extension, _read_binary)
    try:
        verts, faces = reader(path)
    except Exception as error:
        # trimesh looks for a text decoder when an STL is neither a whole binary file nor plain text.
        reason = "damaged or truncated" if isinstance(error, ImportError) else error
        raise MeshFileError(f"{path}: not a readable {extension[1:].upper()} mesh ({reason})") from error
    with np.errstate(over="ignore"):  # what overflows becomes infinite, and is reported as such
        points = verts.astype(np.float32)
    _check(points, faces, path)
    return torch.from_numpy(points), torch.from_numpy(faces)


def save_mesh(path: str | os.PathLike[str], verts: Tensor, faces: Tensor) -> None:
    """Write a triangle mesh to an OBJ, PLY, OFF, STL or GLB file, whole or not at all.

    Coordinates are written as float32 and come back bit for bit; the parent folder is made if missing. All formats but
    STL, which stores loose triangles, keep the order and number of the vertices.

    Args:
        path: the file; its extension chooses the format.
        verts: (V, 3) coordinates, on any device and of any floating dtype.
        faces: (F, 3) integer vertex indices.

    Raises:
        MeshFileError: unknown extension, wrong shapes, no faces, a coordinate that is not finite, or an index out of
            range.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "triangle.ply"
        >>> save_mesh(file, torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> torch.equal(load_mesh(file)[0], torch.eye(3))
        True
    """
    path = Path(path)
    extension = _extension(path, "written")
    if verts.dim() != 2 or verts.shape[1] != 3 or faces.dim() != 2 or faces.shape[1] != 3:
        raise MeshFileError(
            f"{path}: one mesh is verts (V, 3) and faces (F, 3), got {tuple(verts.shape)} and {tuple(faces.shape)}"
        )
    points = verts.detach().cpu().to(torch.float32).numpy()
    triangles = faces.detach().cpu().to(torch.int64).numpy()
    _check(points, triangles, path)
    with atomic_write(path) as temporary:
        if extension == ".obj":
            _write_text(temporary, "", points, "v %.9g %.9g %.9g", triangles + 1, "f %d %d %d")
        elif extension == ".off":
            header = f"OFF\n{len(points)} {len(triangles)} 0\n"
            _write_text(temporary, header, points, "%.9g %.9g %.9g", triangles, "3 %d %d %d")
        else:
            import trimesh

            trimesh.Trimesh(points, triangles, process=False).export(temporary, file_type=extension[1:])


def _extension(path: Path, verb: str) -> str:
    extension = path.suffix.lower()
    if extension not in _EXTENSIONS:
        raise MeshFileError(f"{path}: extension {path.suffix!r} cannot be {verb}; use one of {', '.join(_EXTENSIONS)}")
    return extension


def _check(verts: np.ndarray, faces: np.ndarray, name: Path) -> None:
    if len(verts) < 3:
        raise MeshFileError(f"{name}: a mesh needs 3 vertices or more, this one has {len(verts)}")
    if len(faces) == 0:
        raise MeshFileError(f"{name}: no faces; a point cloud must be meshed first")
    bad = np.flatnonzero(~np.isfinite(verts).all(1))
    if len(bad):
        raise MeshFileError(
            f"{name}: {len(bad)} vertices have NaN or infinite coordinates, first vertex {bad[0]} (counting from 0)"
        )
    outside = np.flatnonzero(((faces < 0) | (faces >= len(verts))).any(1))
    if len(outside):
        raise MeshFileError(
            f"{name}: {len(outside)} faces refer to vertices outside 0..{len(verts) - 1}, the first is face "
            f"{outside[0]}: {faces[outside[0]].tolist()}"
        )


def _fan(polygon: list[int]) -> list[tuple[int, int, int]]:
    """Triangles from the first corner to every edge that does not touch it."""
    return [(polygon[0], second, third) for second, third in pairwise(polygon[1:])]


def _arrays(verts: list[Any], faces: list[tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray]:
    return np.array(verts, dtype=np.float64).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    verts: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), start=1):
        kind, *fields = line.split("#")[0].split() or [""]
        try:
            if kind == "v":
                x, y, z, *_ = map(float, fields)  # a weight or a colour may follow
                verts.append([x, y, z])
            elif kind == "f":
                corners = [int(field.split("/")[0]) for field in fields]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError("a face lists three or more vertices, counted from 1")
                # Negative indices count back from the vertices read so far.
                faces += _fan([i - 1 if i > 0 else len(verts) + i for i in corners])
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    if not verts and not faces:
        raise ValueError("no vertices and no faces in it")
    return _arrays(verts, faces)


def _read_off(path: Path) -> tuple[np.ndarray, np.ndarray]:
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = iter(fields for line in text.splitlines() if (fields := line.split("#")[0].split()))
    try:
        keyword, *counts = next(lines)
        if keyword not in {"OFF", "COFF", "NOFF", "CNOFF"}:
            raise ValueError(f"the first word is {keyword[:20]!r}, not OFF")
        vertex_count, face_count, *_ = map(int, counts or next(lines))  # the counts may follow the keyword
        verts = [[float(x) for x in next(lines)[:3]] for _ in range(vertex_count)]
        faces: list[tuple[int, int, int]] = []
        for _ in range(face_count):
            size, *corners = map(int, next(lines))
            if not 3 <= size <= len(corners):
                raise ValueError(f"face {len(faces)} lists {len(corners)} of its {size} vertices")
            faces += _fan(corners[:size])
    except StopIteration:
        raise ValueError("the file ends too early") from None
    return _arrays(verts, faces)


def _read_binary(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    # fix_texture would repeat the vertices of a PLY along its texture seams.
    options: dict[str, Any] = {"fix_texture": False} if path.suffix.lower() == ".ply" else {}
    scene = trimesh.load_scene(path, process=False, **options)
    parts = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh | trimesh.PointCloud)]
    if not parts:
        raise ValueError("no mesh in it")
    triangles = [np.asarray(getattr(part, "faces", np.empty((0, 3))), dtype=np.int64) for part in parts]
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    verts = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    faces = np.concatenate([part + offset for part, offset in zip(triangles, offsets, strict=True)])
    if path.suffix.lower() == ".stl":
        return _weld(verts, faces)
    return verts, faces


def _weld(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One vertex per distinct coordinate triple, in order of first appearance."""
    _, first, inverse = np.unique(verts, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return verts[first[order]], rank[inverse.reshape(-1)][faces]


def _write_text(
    path: Path, header: str, points: np.ndarray, point_format: str, triangles: np.ndarray, face_format: str
) -> None:
    # Nine significant digits are enough to recover any float32.
    with path.open("w", encoding="ascii") as stream:
        stream.write(header)
        np.savetxt(stream, points, fmt=point_format)
        np.savetxt(stream, triangles, fmt=face_format)
