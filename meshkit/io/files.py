"""Mesh files in and out, with the order and the number of the vertices kept.

Pose transfer, correspondences and per-vertex errors all rest on the row order of the vertices, so nothing here merges,
reorders or drops a vertex. OBJ, OFF and text PLY have readers of their own for that reason: general readers split an
OBJ by material and repeat vertices along texture seams. Binary PLY, STL and GLB are read through trimesh, between
checks.
"""

import os
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from meshkit.io._glb import read_glb
from meshkit.io._obj import read_obj
from meshkit.io._off import read_off
from meshkit.io._ply import read_ply
from meshkit.io._stl import read_stl
from meshkit.io.atomic import atomic_write
from meshkit.io.report import counted

__all__ = ["MeshFileError", "MeshFileWarning", "load_mesh", "save_mesh"]

_READERS = {".glb": read_glb, ".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl}
_ROWS = 2**16  # rows formatted at a time


class MeshFileError(ValueError):
    """A file that is not a usable mesh; the message names the file and says what is wrong with it."""


class MeshFileWarning(UserWarning):
    """A file was read, but not as it stands: its polygons became triangles."""


def load_mesh(path: str | os.PathLike[str], *, max_bytes: int = 2**28) -> tuple[Tensor, Tensor]:
    """Read a triangle mesh from an OBJ, PLY, OFF, STL or GLB file.

    Vertices keep the order and number of the file, unreferenced and repeated ones included. Polygons become triangles,
    with a :class:`MeshFileWarning`: fans from their first corner, so that equal faces give equal triangles in every
    pose (a polygon that is not convex may overlap itself).
    A file with several meshes (OBJ objects, GLB nodes) is read as one: the meshes are concatenated, each in its place.
    An STL file has no vertices, only loose triangles: corners with equal coordinates become one vertex, in order of
    appearance. Normals, texture coordinates, colours and materials are ignored.

    Args:
        path: the file; its extension names the format.
        max_bytes: larger files are refused, 256 MiB by default. An OBJ or OFF file takes about 5 times its size of
            memory while it is read, the other formats up to 20 times.

    Returns:
        Vertices (V, 3) float32, in the file's unit, and faces (F, 3) int64.

    Raises:
        MeshFileError: the file does not exist, has another extension, is larger than ``max_bytes``, is damaged, has no
            faces, fewer than 3 vertices, a coordinate that is not finite, or a face that refers to a vertex that is not
            there.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "square.obj"
        >>> _ = file.write_text("v 0 0 0\\nv 1 0 0\\nv 1 1 0\\nv 0 1 0\\nf 1 2 3\\nf 1 3 4\\n")
        >>> verts, faces = load_mesh(file)
        >>> verts.shape, faces.tolist()
        (torch.Size([4, 3]), [[0, 1, 2], [0, 2, 3]])
    """
    path = Path(path)
    try:
        extension = _extension(path, "read")
        if not path.is_file():
            raise MeshFileError(f"{path}: no such file")
        if (size := path.stat().st_size) > max_bytes:
            raise MeshFileError(
                f"{path}: {size:,} bytes, more than max_bytes={max_bytes:,}; raise it to read this file"
            )
        verts, faces, polygons = _READERS[extension](path, max_bytes)
    except MeshFileError:
        raise
    except OSError as error:
        raise MeshFileError(f"{path}: it cannot be read ({error.strerror or error})") from error
    except Exception as error:
        raise MeshFileError(f"{path}: not a readable {path.suffix[1:].upper()} mesh ({error})") from error
    with np.errstate(over="ignore"):  # what overflows becomes infinite, and is reported as such
        points = verts.astype(np.float32)
    _check(points, faces, path)
    if polygons:
        message = f"{path}: faces with more than three corners were split into triangles, {len(faces)} faces in all"
        warnings.warn(message, MeshFileWarning, stacklevel=2)
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
    if path.is_dir():
        raise MeshFileError(f"{path}: a folder, not a mesh file")
    if extension not in _READERS:
        raise MeshFileError(f"{path}: extension {path.suffix!r} cannot be {verb}; use one of {', '.join(_READERS)}")
    return extension


def _check(verts: np.ndarray, faces: np.ndarray, name: Path) -> None:
    if len(verts) < 3:
        raise MeshFileError(f"{name}: a mesh needs 3 vertices or more, this one has {len(verts)}")
    if len(faces) == 0:
        raise MeshFileError(f"{name}: no faces; a point cloud must be meshed first")
    bad = np.flatnonzero(~np.isfinite(verts).all(1))
    if len(bad):
        have = "has a NaN or infinite coordinate" if len(bad) == 1 else "have NaN or infinite coordinates"
        raise MeshFileError(
            f"{name}: {counted(len(bad), 'vertex')} {have}, first vertex {bad[0]} (counting from 0); mend the file or "
            "export it again"
        )
    outside = np.flatnonzero(((faces < 0) | (faces >= len(verts))).any(1))
    if len(outside):
        refer = "face refers" if len(outside) == 1 else "faces refer"
        raise MeshFileError(
            f"{name}: {len(outside)} {refer} to vertices outside 0..{len(verts) - 1}, the first is face {outside[0]} "
            f"(counting from 0): {faces[outside[0]].tolist()}; mend the file or export it again"
        )


def _write_text(
    path: Path, header: str, points: np.ndarray, point_format: str, triangles: np.ndarray, face_format: str
) -> None:
    # Nine significant digits are enough to recover any float32.
    with path.open("w", encoding="ascii") as stream:
        stream.write(header)
        for rows, row_format in ((points, point_format), (triangles, face_format)):
            for start in range(0, len(rows), _ROWS):
                block = rows[start : start + _ROWS]
                stream.write(f"{row_format}\n" * len(block) % tuple(block.ravel().tolist()))
