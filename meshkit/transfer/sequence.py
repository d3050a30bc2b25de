"""Many poses for one identity: where they come from, and the transfer of each in order."""

import os
import re
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from meshkit.io import MeshFileError, SurfaceBinding
from meshkit.io._arrays import read_arrays
from meshkit.io._glb import read_scene
from meshkit.io.report import counted
from meshkit.transfer._choose import Weights
from meshkit.transfer._frames import among, rotations, turns_about
from meshkit.transfer._kinds import surface_area
from meshkit.transfer._open import Mesh, clean_body, examine, named, read
from meshkit.transfer._orient import find_rotation
from meshkit.transfer._prepare import Prepared
from meshkit.transfer.report import TransferResult
from meshkit.transfer.transfer import PoseTransfer

__all__ = ["UnusablePosesError", "is_sequence", "read_sequence", "transfer_sequence"]

_MAX_BYTES = 2**30  # of the arrays of a file of many poses
_FORMATS = {".obj", ".ply", ".off", ".stl", ".glb"}


class UnusablePosesError(MeshFileError):
    """Some of many poses cannot be used.

    Attributes:
        reasons: what is wrong with each of them, after its name.
    """

    def __init__(self, reasons: Sequence[str], count: int) -> None:
        self.reasons = tuple(map(_folded, reasons))
        advice = "mend or remove them, or leave them out with skip_bad (--skip-bad)"
        if len(reasons) == count:
            advice = "there is nothing to transfer"
        text = f"{len(reasons)} of {counted(count, 'pose')} cannot be used; {advice}:"
        super().__init__("\n  ".join((text, *self.reasons)))


def is_sequence(path: str | os.PathLike[str]) -> bool:
    """Whether a path holds many poses: a folder, an ``.npz`` file, or a ``.glb`` of several meshes with equal faces.

    Raises:
        MeshFileError: a ``.glb`` that cannot be read.
    """
    path = Path(path)
    if path.is_dir() or path.suffix.lower() == ".npz":
        return True
    return path.suffix.lower() == ".glb" and path.is_file() and len(_glb_meshes(path)) > 1


def read_sequence(path: str | os.PathLike[str]) -> list[Mesh]:
    """The pose meshes of a folder, an ``.npz`` or a ``.glb`` file, in order.

    A folder: its mesh files, sorted by name with numbers by value (``pose9`` before ``pose10``). An ``.npz`` file:
    arrays ``verts`` (T, V, 3) and ``faces`` (F, 3). A ``.glb`` file: its meshes, sorted likewise by the names of their
    nodes.

    Raises:
        MeshFileError: there is nothing there, or not what is described here; or poses of more than 1 GiB in one file.
    """
    path = Path(path)
    if path.is_dir():
        listed = [file for file in path.iterdir() if file.suffix.lower() in _FORMATS and not file.name.startswith(".")]
        if not listed:
            raise MeshFileError(f"{path}: no mesh files in this folder ({', '.join(sorted(_FORMATS))})")
        listed.sort(key=lambda file: _natural(file.name))
        return list(listed)
    if not path.is_file():
        raise MeshFileError(f"{path}: no such file or folder")
    if path.suffix.lower() == ".npz":
        return list(_npz_meshes(path))
    if path.suffix.lower() == ".glb":
        meshes = _glb_meshes(path)
        if meshes:
            return list(meshes)
    raise MeshFileError(f"{path}: poses come as a folder of meshes, an .npz file or a .glb file of several meshes")


def _natural(name: str) -> list[Any]:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name)]


def _npz_meshes(path: Path) -> list[tuple[Tensor, Tensor]]:
    try:
        arrays = read_arrays(path, ("verts", "faces"), _MAX_BYTES, limit="")
        if missing := [name for name in ("verts", "faces") if name not in arrays]:
            raise ValueError(f"there is no {' and no '.join(missing)}")
    except ValueError as error:
        raise MeshFileError(f"{path}: not an .npz file with arrays verts and faces ({error})") from error
    verts, faces = arrays["verts"], arrays["faces"]
    good = verts.ndim == 3 and verts.shape[0] > 0 and verts.shape[2] == 3 and verts.dtype.kind == "f"
    if not (good and faces.ndim == 2 and faces.shape[1] == 3 and faces.dtype.kind in "iu"):
        raise MeshFileError(
            f"{path}: expected floating verts (T, V, 3) and integer faces (F, 3), got {verts.dtype} {verts.shape} and "
            f"{faces.dtype} {faces.shape}"
        )
    triangles = torch.from_numpy(faces.astype(np.int64))
    return [(torch.from_numpy(frame.astype(np.float32)), triangles) for frame in verts]


def _glb_meshes(path: Path) -> list[tuple[Tensor, Tensor]]:
    """The meshes of a scene by the names of their nodes, if all have equal faces; else none."""
    import trimesh

    if (size := path.stat().st_size) > _MAX_BYTES:
        raise MeshFileError(f"{path}: {size:,} bytes, more than the {_MAX_BYTES:,} allowed")
    try:
        scene = read_scene(path, _MAX_BYTES)
        nodes = sorted(scene.graph.nodes_geometry, key=_natural)
        placed = [(scene.geometry[geometry], place) for place, geometry in map(scene.graph.get, nodes)]
        parts = [part.copy().apply_transform(place) for part, place in placed if isinstance(part, trimesh.Trimesh)]
    except Exception as error:  # trimesh raises what its readers raise
        raise MeshFileError(f"{path}: not a readable GLB file ({error})") from error
    if not parts or any(not np.array_equal(part.faces, parts[0].faces) for part in parts):
        return []
    faces = torch.from_numpy(np.asarray(parts[0].faces, dtype=np.int64))
    return [(torch.from_numpy(np.asarray(part.vertices, dtype=np.float32)), faces) for part in parts]


def transfer_sequence(
    identity: Mesh,
    poses: str | os.PathLike[str] | Iterable[Mesh],
    *,
    weights: Weights = "auto",
    refine: bool | float = True,
    frame: Literal["pose", "identity"] = "pose",
    identity_up: str | None = None,
    identity_facing: str | None = None,
    identity_unit: str | None = None,
    pose_up: str | None = None,
    pose_facing: str | None = None,
    pose_unit: str | None = None,
    skip_bad: bool = False,
    device: torch.device | str | None = None,
) -> Iterator[TransferResult]:
    """Give one identity many poses, one after the other and in their order.

    Work on the identity mesh is done once. Where the pose meshes share their faces, so is the cleaning and simplifying
    of the first one, and the others' vertices follow it; then also unit and size are those of the first. The
    orientation of each is sought among the previous one's and the quarter turns next to it, so that a body may turn
    around during a sequence; an axis that was given holds for all. It stays that of the first where ``pose_up`` and
    ``pose_facing`` are both given, or the weights have no matching to find it with. Every pose is transferred by
    itself: nothing is smoothed over time.

    All poses are read and checked before the first transfer, one at a time, so that a damaged file among them is found
    at once; only those of an iterator, which cannot be gone through twice, are checked as they come.

    Args:
        identity: the mesh that gives the body; see :func:`transfer_pose`.
        poses: a folder, an ``.npz`` or a ``.glb`` file (see :func:`read_sequence`), or meshes.
        weights: see :class:`PoseTransfer`, as all that follows.
        refine: keep the identity's local shape.
        frame: ``"pose"`` or ``"identity"``.
        identity_up: of the identity file; found if ``None``.
        identity_facing: likewise.
        identity_unit: likewise.
        pose_up: of every pose; found if ``None``.
        pose_facing: likewise.
        pose_unit: of the first pose; guessed if ``None``.
        skip_bad: leave out poses that cannot be read or are no body, and warn which. Otherwise they are an error.
        device: where to compute.

    Yields:
        A :class:`TransferResult` for each pose.

    Raises:
        MeshFileError: a file is missing, damaged or no mesh. Of poses that were checked before the first transfer it is
            an :class:`UnusablePosesError`, which lists all that cannot be used; with ``skip_bad`` only if none can.
        ValueError: unknown weights or options, or a mesh that cannot be used.

    Example:
        >>> from meshkit.data import load_humans
        >>> from meshkit.models import pretrained_names
        >>> body = load_humans()
        >>> moves = [(v, body.faces) for v in body(torch.tensor([5, 5]), torch.tensor([10, 11]))]
        >>> if "xdualnet-humans" in pretrained_names():
        ...     results = list(transfer_sequence((body.template, body.faces), moves, weights="xdualnet-humans"))
        ...     assert len(results) == 2
    """
    meshes = read_sequence(poses) if isinstance(poses, str | os.PathLike) else poses
    transfer = PoseTransfer(
        identity,
        weights=weights,
        refine=refine,
        frame=frame,
        identity_up=identity_up,
        identity_facing=identity_facing,
        identity_unit=identity_unit,
        device=device,
    )
    check = _Check()
    bad = _bad_ones(meshes, check, skip_bad) if isinstance(meshes, Sequence) else None
    first: Prepared | None = None
    before: Prepared | None = None
    follower: _Follower | None = None
    for number, mesh in enumerate(meshes):
        if bad is not None and number in bad:
            continue
        if bad is None and skip_bad and (why := check(number, mesh)):
            warnings.warn(f"a pose is left out: {_folded(why)}", stacklevel=2)
            continue
        start = time.perf_counter()
        name, verts, faces, notes = read(mesh, f"pose {number}")
        if follower is not None and before is not None and follower.fits(verts, faces):
            current = follower.follow(transfer, name, verts, before)
        else:
            opened = examine(name, verts, faces, notes)
            current = transfer.prepare(opened, unit=pose_unit, up=pose_up, facing=pose_facing)
            follower = _Follower(current, verts, allowed=rotations(pose_up, pose_facing))
        first = first or current
        before = current
        with torch.no_grad():
            yield transfer.apply(current, start, up=first.up)


class _Check:
    """Says of one pose after the other whether it can be used; it keeps no mesh but the faces of one."""

    def __init__(self) -> None:
        self._shape, self._faces = torch.Size(), torch.empty(0, device="cpu")

    def __call__(self, number: int, mesh: Mesh) -> str | None:
        """What is wrong with a pose, after its name; ``None`` if nothing is."""
        try:
            name, verts, faces, _ = read(mesh, f"pose {number}")
            if verts.shape == self._shape and torch.equal(faces, self._faces):
                _check_follower(name, verts, faces)
            else:
                clean_body(name, verts, faces)
                self._shape, self._faces = verts.shape, faces
        except OSError as error:  # a file that may not be read, or a folder with the name of one
            return f"{error.filename or mesh}: {error.strerror or error}"
        except ValueError as error:
            return str(error)
        return None


def _bad_ones(meshes: Sequence[Mesh], check: _Check, skip_bad: bool) -> set[int]:
    """Numbers of the poses that are left out."""
    bad = {number: why for number, mesh in enumerate(meshes) if (why := check(number, mesh))}
    if bad and (not skip_bad or len(bad) == len(meshes)):
        raise UnusablePosesError(tuple(bad.values()), len(meshes))
    if bad:
        told = (f"{len(bad)} of {len(meshes)} poses are left out:", *map(_folded, bad.values()))
        warnings.warn("\n  ".join(told), stacklevel=3)
    return set(bad)


def _check_follower(name: str, verts: Tensor, faces: Tensor) -> None:
    """The vertices of a mesh whose faces are known to be sound."""
    if not bool(torch.isfinite(verts).all()):
        raise ValueError(f"{name}: vertices are NaN or infinite")
    if not float(surface_area(verts, faces[faces[:, 0] >= 0])) > 0:
        raise ValueError(f"{name}: the mesh has no surface area")


def _folded(text: str) -> str:
    return " ".join(text.split())


class _Follower:
    """Later poses of the mesh that was prepared first: the same cleaning and the same simple vertices."""

    def __init__(self, first: Prepared, verts: Tensor, *, allowed: Tensor) -> None:
        self._first, self._shape, self._allowed = first, verts.shape, allowed
        clean, simple = first.clean, first.simple
        self._binding = SurfaceBinding(simple.verts, simple.faces, clean.verts, clean.faces)

    def fits(self, verts: Tensor, faces: Tensor) -> bool:
        return verts.shape == self._shape and torch.equal(faces.cpu(), self._first.faces.cpu())

    def follow(self, transfer: PoseTransfer, name: str, verts: Tensor, before: Prepared) -> Prepared:
        first = self._first
        _check_follower(name, verts, self._first.faces)
        scaled = (verts * first.scale.factor).to(first.clean.verts)
        clean = replace(first.clean, verts=scaled[first.clean.source.to(scaled.device)], original=scaled)
        small = clean.verts if first.simple.method == "none" else self._binding.carry(clean.verts)
        simple = replace(first.simple, verts=small, original=clean.verts)
        descriptors = named(name, lambda: transfer.net.describe(small, simple.faces))
        rotation, clear, rest = before.rotation, before.clear, transfer.rest
        if len(self._allowed) > 1 and rest is not None and rest.can_match:
            rotation, clear = named(
                name,
                lambda: find_rotation(
                    rest,
                    small,
                    simple.faces,
                    descriptors=descriptors,
                    candidates=self._candidates(before.rotation),
                    usual=before.rotation[None],
                ),
            )
        current = replace(first, opened=replace(first.opened, name=name), clean=clean, simple=simple)
        return replace(current, descriptors=descriptors, clear=clear, rotation=rotation.to(small))

    def _candidates(self, before: Tensor) -> Tensor:
        """The rotation before and those a quarter turn away, without what contradicts the axes that were given."""
        turns = turns_about(before)
        return turns[among(turns, self._allowed)]
