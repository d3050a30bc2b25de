"""Readers for the art of the game 0 A.D.: compiled meshes (.pmd) and animations (.psa) inside its public.zip."""

import struct
import zipfile
from dataclasses import dataclass

import numpy as np

MESHES = "art/meshes/skeletal/{}.dae.cached.pmd"
ANIMATIONS = "art/animation/quadraped/"
SUFFIX = ".dae.cached.psa"


@dataclass
class GameMesh:
    """A skinned mesh: vertices (V, 3), faces (F, 3), rest places (B, 3) and rotations (B, 3, 3) of its bones."""

    verts: np.ndarray
    faces: np.ndarray
    bones: np.ndarray
    turns: np.ndarray


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of quaternions (..., 4) stored as x, y, z, w."""
    x, y, z, w = np.moveaxis(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def read_mesh(archive: zipfile.ZipFile, name: str) -> GameMesh:
    """A mesh by name, for example ``tiger``."""
    data = archive.read(MESHES.format(name))
    if data[:4] != b"PSMD":
        raise ValueError(f"{name}: not a compiled mesh")
    version, _, count = struct.unpack_from("<III", data, 4)
    place, layers = 16, 1
    if version >= 4:
        (layers,) = struct.unpack_from("<I", data, place)
        place += 4
    vertex = np.dtype(
        [("p", "<f4", 3), ("n", "<f4", 3), ("uv", "<f4", (layers, 2)), ("bones", "u1", 4), ("weights", "<f4", 4)]
    )
    verts = np.frombuffer(data, vertex, count, place)["p"].astype(np.float64)
    place += vertex.itemsize * count
    (count,) = struct.unpack_from("<I", data, place)
    faces = np.frombuffer(data, "<u2", 3 * count, place + 4).reshape(-1, 3).astype(np.int64)
    place += 4 + 6 * count
    (count,) = struct.unpack_from("<I", data, place)
    bones = np.frombuffer(data, "<f4", 7 * count, place + 4).reshape(-1, 7).astype(np.float64)
    return GameMesh(verts, faces, bones[:, :3], rotations(bones[:, 3:]))


def read_animation(archive: zipfile.ZipFile, path: str) -> np.ndarray:
    """Rotations (frames, B, 3, 3) of the bones, in the axes of the game."""
    data = archive.read(path)
    if data[:4] != b"PSSA":
        raise ValueError(f"{path}: not a compiled animation")
    (length,) = struct.unpack_from("<I", data, 12)
    place = 16 + length
    _, bones, frames = struct.unpack_from("<fII", data, place)
    keys = np.frombuffer(data, "<f4", frames * bones * 7, place + 12).reshape(frames, bones, 7)
    return rotations(keys[..., 3:].astype(np.float64))
