"""SMPL and SMAL body models, from the files that their licences let you download but nobody pass on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshkit.data._unpickle import Record, read_pickle
from meshkit.data.frames import Y_UP_TO_Z_UP, turn_axes
from meshkit.data.rigged import RiggedModel
from meshkit.io import MeshFileError
from meshkit.io._arrays import read_arrays

__all__ = ["SMAL_FAMILIES", "load_smal", "load_smpl"]

SMAL_FAMILIES = ("felidae", "canidae", "equidae", "bovidae", "hippopotamidae")
"""Families of SMAL's cluster means, in their order."""

MAX_BYTES = 1 << 30

_MODEL = ("v_template", "kintree_table", "f", "shapedirs", "posedirs", "weights", "J_regressor")
_ANIMALS = ("toys_betas", "cluster_means")


def load_smpl(
    path: str | os.PathLike[str], *, num_betas: int | None = 10, z_up: bool = False, max_bytes: int = MAX_BYTES
) -> RiggedModel:
    """Read an SMPL model, or another of its layout, such as SMPL+H.

    Both published forms are read: ``.pkl``, pickled with Python 2 and chumpy, neither of which is needed, and ``.npz``.
    The pickle cannot run code: only arrays, sparse matrices and chumpy's containers are admitted.

    SMPL's frame is kept: metres, y up, facing +z, x towards the body's left, origin near the pelvis. Joints are
    regressed from the shaped vertices, which is linear: ``joint_dirs`` holds the regressed shape directions. Poses are
    the usual 24 x 3 rotation vectors, root first. Tested on synthetic files of the published layout.

    Args:
        path: the model file.
        num_betas: shape directions to keep; ``None`` for all (newer files have 300).
        z_up: turn the body to meshkit's frame (z up, facing -y). Poses must then be turned as well:
            ``vectors @ torch.tensor(Y_UP_TO_Z_UP).T``.
        max_bytes: larger files are refused. Reading takes less than twice the file's size in memory.

    Raises:
        MeshFileError: no such file, another extension, damaged, too large, arrays missing or of other shapes, or a
            pickle that asks for anything but arrays.

    Reference:
        Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015.

    Example:
        >>> body = load_smpl("basicModel_f_lbs_10_207_0_v1.0.0.pkl")  # doctest: +SKIP
        >>> body(torch.zeros(1, 10), torch.zeros(1, 24, 3)).shape  # doctest: +SKIP
        torch.Size([1, 6890, 3])
    """
    path = Path(path)
    content = _read(path, max_bytes, _MODEL)
    template = _array(content, "v_template", path)
    num = len(template)
    table = _array(content, "kintree_table", path)
    if template.ndim != 2 or template.shape[1] != 3 or table.ndim != 2 or len(table) != 2:
        raise MeshFileError(
            f"{path}: v_template and kintree_table must be (V, 3) and (2, J), got {template.shape} and {table.shape}"
        )
    ids = table.astype(np.int64)
    row = {int(joint): k for k, joint in enumerate(ids[1])}
    parents = [-1, *(row.get(int(parent), -1) for parent in ids[0, 1:])]  # the root's entry is 2**32 - 1
    joints = len(parents)
    faces = _array(content, "f", path, (None, 3)).astype(np.int64)
    shapes = _array(content, "shapedirs", path, (num, 3, None))[..., :num_betas]
    correctives = _array(content, "posedirs", path, (num, 3, 9 * (joints - 1)))
    weights = _array(content, "weights", path, (num, joints))
    regressor = _dense(content, "J_regressor", path, (joints, num))
    try:
        model = RiggedModel(
            _tensor(template),
            torch.from_numpy(faces),
            _tensor(shapes.transpose(2, 0, 1)),
            _tensor(regressor @ template),
            _tensor(np.einsum("jv,vck->kjc", regressor, shapes)),
            _tensor(weights),
            torch.tensor(parents, device="cpu"),
            pose_correctives=_tensor(correctives.transpose(2, 0, 1)),
        )
    except ValueError as error:
        raise MeshFileError(f"{path}: {error}") from error
    return turn_axes(model, model.template.new_tensor(Y_UP_TO_Z_UP)) if z_up else model


def load_smal(
    path: str | os.PathLike[str],
    data_path: str | os.PathLike[str] | None = None,
    *,
    num_betas: int | None = None,
    max_bytes: int = MAX_BYTES,
) -> RiggedModel:
    """Read a SMAL animal model, with the shapes of the toys it was learned from and the means of its families.

    With ``data_path``, ``identities`` holds the coefficients of the toys, so that index i is toy i (as in files named
    ``toy_{i}_{pose}.ply``), and after them the means of the families, in the order of :data:`SMAL_FAMILIES`;
    ``identity_names`` says ``toy_0``, ..., ``felidae``, .... The frame of the file is kept: see
    :func:`~meshkit.data.turn_axes`. Tested on synthetic files of the published layout.

    Args:
        path: the model file, for example ``smal_CVPR2017.pkl``.
        data_path: the data file, for example ``smal_CVPR2017_data.pkl``; without it there is no table of identities.
        num_betas: shape directions to keep; ``None`` for all.
        max_bytes: larger files are refused.

    Raises:
        MeshFileError: as :func:`load_smpl`; or the data file has no usable ``cluster_means`` or ``toys_betas``.

    Reference:
        Zuffi et al., "3D Menagerie: Modeling the 3D Shape and Pose of Animals", 2017.

    Example:
        >>> animals = load_smal("smal_CVPR2017.pkl", "smal_CVPR2017_data.pkl")  # doctest: +SKIP
        >>> animals(torch.tensor([0]), torch.zeros(1, animals.num_joints, 3)).shape  # doctest: +SKIP
        torch.Size([1, 3889, 3])
    """
    model = load_smpl(path, num_betas=num_betas, max_bytes=max_bytes)
    if data_path is None:
        return model
    path = Path(data_path)
    content, count = _read(path, max_bytes, _ANIMALS), len(model.shape_dirs)
    toys = _rows(content, "toys_betas", path, count)
    means = _rows(content, "cluster_means", path, count)
    families = [SMAL_FAMILIES[k] if k < len(SMAL_FAMILIES) else f"family_{k}" for k in range(len(means))]
    model.identities = torch.from_numpy(np.concatenate([toys, means]))
    model.identity_names = (*(f"toy_{k}" for k in range(len(toys))), *families)
    return model


def _read(path: Path, max_bytes: int, wanted: tuple[str, ...]) -> dict[str, Any]:
    """What is in a file; of an ``.npz`` only what is wanted, as the rest may be objects that cannot be read."""
    if not path.is_file():
        raise MeshFileError(f"{path}: {'a folder, not a model file' if path.is_dir() else 'no such file'}")
    if path.suffix == ".pkl":
        return read_pickle(path, max_bytes=max_bytes)
    if path.suffix != ".npz":
        raise MeshFileError(f"{path}: extension {path.suffix!r} cannot be read; use .pkl or .npz")
    try:
        return dict(read_arrays(path, wanted, max_bytes))
    except (OSError, ValueError) as error:
        raise MeshFileError(f"{path}: not a readable .npz of arrays ({error})") from error


def _array(content: dict[str, Any], key: str, path: Path, shape: tuple[int | None, ...] | None = None) -> np.ndarray:
    if key not in content:
        raise MeshFileError(f"{path}: no {key!r} in it; it has {', '.join(sorted(map(str, content)))[:200]}")
    value = content[key]
    if isinstance(value, Record):  # chumpy keeps a variable's value in x
        value = value.state.get("x")
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise MeshFileError(f"{path}: {key!r} is not an array of numbers")
    if shape and (value.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True))):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise MeshFileError(f"{path}: {key!r} must have shape ({wanted}), got {value.shape}")
    if not np.isfinite(value).all():
        raise MeshFileError(f"{path}: {key!r} has values that are NaN or infinite")
    return value


def _dense(content: dict[str, Any], key: str, path: Path, shape: tuple[int, int]) -> np.ndarray:
    """A matrix that may be stored compressed by columns or, with ``indptr`` one longer than the rows, by rows."""
    value = content.get(key)
    if not isinstance(value, Record) or "indptr" not in value.state:
        return _array(content, key, path, shape)
    parts = {name: _array(value.state, name, path) for name in ("data", "indices", "indptr")}
    stored = tuple(int(n) for n in value.state.get("_shape", value.state.get("shape", ())))
    pointers, indices = parts["indptr"].astype(np.int64), parts["indices"].astype(np.int64)
    by_column = len(pointers) == shape[1] + 1
    if (
        stored != shape
        or len(pointers) != (shape[1] if by_column else shape[0]) + 1
        or pointers[0] != 0
        or (np.diff(pointers) < 0).any()
        or not pointers[-1] == len(indices) == len(parts["data"])
        or (len(indices) and not 0 <= indices.min() <= indices.max() < (shape[0] if by_column else shape[1]))
    ):
        raise MeshFileError(f"{path}: {key!r} is not a sparse matrix of shape {shape}, its shape is {stored}")
    along = np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
    matrix = np.zeros(shape)
    np.add.at(matrix, (indices, along) if by_column else (along, indices), parts["data"])
    return matrix


def _rows(content: dict[str, Any], key: str, path: Path, count: int) -> np.ndarray:
    """Rows of coefficients, cut or filled with zeros to ``count`` columns."""
    value = content.get(key)
    if isinstance(value, list) and value and all(isinstance(row, np.ndarray) for row in value):
        if len({row.shape for row in value}) != 1:
            raise MeshFileError(f"{path}: the entries of {key!r} differ in shape")
        content = {**content, key: np.stack(value)}
    rows = _array(content, key, path, (None, None)).astype(np.float32)
    return np.pad(rows[:, :count], ((0, 0), (0, max(0, count - rows.shape[1]))))


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
