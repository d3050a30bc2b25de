"""Which files of a folder are meshes of a data set, and whose body in which pose each of them is."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from meshkit.io import MeshFileError

__all__ = [
    "RELEASED_SPLITS",
    "MeshEntry",
    "PairSplit",
    "read_test_list",
    "scan_faust",
    "scan_mgn",
    "scan_pose_transfer",
]


@dataclass(frozen=True)
class MeshEntry:
    """One mesh file.

    Args:
        path: the file.
        identity: number of the body.
        pose: number of the pose.
    """

    path: Path
    identity: int
    pose: int


@dataclass(frozen=True)
class PairSplit:
    """Identities and poses that a published experiment trains or tests on."""

    identities: tuple[int, ...]
    poses: range

    def select(self, entries: Iterable[MeshEntry]) -> list[MeshEntry]:
        """The entries of these identities in these poses."""
        return [e for e in entries if e.identity in self.identities and e.pose in self.poses]


_SMAL_TRAIN = (*range(16), 21, 23, 24, *range(26, 32), 34, 35, 38, 39)

RELEASED_SPLITS = MappingProxyType(
    {
        "humans-train": PairSplit(tuple(range(15)), range(200, 600)),  # 3D-CoreNet and X-DualNet
        "humans-test": PairSplit(tuple(range(21, 30)), range(200)),  # X-DualNet
        "npt-train": PairSplit(tuple(range(16)), range(200, 600)),
        "animals-train": PairSplit(_SMAL_TRAIN, range(400)),
        "animals-test": PairSplit(tuple(i for i in range(41) if i not in _SMAL_TRAIN), range(400, 600)),
    }
)
"""Splits of the released code of NPT, 3D-CoreNet and X-DualNet."""


def scan_pose_transfer(folder: str | os.PathLike[str]) -> list[MeshEntry]:
    """Meshes of a pose-transfer data set, by the names that the released code uses.

    ``{identity}_{pose}.obj`` (NPT), ``id{identity}_{pose}.obj`` (3D-CoreNet and X-DualNet, humans) and
    ``toy_{identity}_{pose}.ply`` (animals). Other files are ignored. Name your own files like this to use them: the two
    numbers are free to choose, and .obj, .ply, .off, .stl and .glb are all read.

    Args:
        folder: where the files lie.

    Returns:
        The entries, by identity and pose. :data:`RELEASED_SPLITS` picks the published ones from them.

    Raises:
        MeshFileError: no such folder, none of its files has such a name, or two have the same numbers.
    """
    name = re.compile(r"(?:id|toy_)?(\d+)_(\d+)\.(?:obj|ply|off|stl|glb)")
    return _scan(folder, "*", lambda path: _numbers(name, path.name), "{identity}_{pose}.obj, id1_2.obj or toy_1_2.ply")


def scan_faust(folder: str | os.PathLike[str]) -> list[MeshEntry]:
    """FAUST's training registrations, ``tr_reg_{n}.ply``: body n // 10 in pose n % 10.

    Args:
        folder: ``MPI-FAUST/training/registrations``.

    Raises:
        MeshFileError: as :func:`scan_pose_transfer`.
    """
    name = re.compile(r"tr_reg_(\d{3})()\.ply")

    def numbers(path: Path) -> tuple[int, int] | None:
        found = name.fullmatch(path.name)
        return None if found is None else divmod(int(found[1]), 10)

    return _scan(folder, "*.ply", numbers, "tr_reg_000.ply")


def scan_mgn(folder: str | os.PathLike[str]) -> list[MeshEntry]:
    """The Multi-Garment Net wardrobe: ``{person}/smpl_registered.obj``, clothed people of 27,554 vertices.

    Args:
        folder: the one that holds a folder per person.

    Returns:
        One entry per person, numbered in the order of the folders' names. Each has a pose of their own, which nobody
        shares, so its number is that of the person.

    Raises:
        MeshFileError: as :func:`scan_pose_transfer`.
    """
    paths = sorted(Path(folder).glob("*/smpl_registered.obj"))
    places = {path: (k, k) for k, path in enumerate(paths)}
    return _scan(folder, "*/smpl_registered.obj", places.get, "PERSON/smpl_registered.obj")


def read_test_list(path: str | os.PathLike[str], entries: Iterable[MeshEntry]) -> list[tuple[int, int, int]]:
    """Rows of a published test list, as places in ``entries``.

    Each line names three files, ``identity pose ground_truth``, for example ``id1_2.obj id3_4.obj id1_4.obj``.

    Args:
        path: the list.
        entries: the meshes, as scanned.

    Returns:
        ``(identity, pose, ground_truth)`` per line.

    Raises:
        MeshFileError: no such file, an empty list, a line of other than three names, a mesh that is not there, or one
            of a name that several entries have.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshFileError(f"{path}: {'a folder, not a list' if path.is_dir() else 'no such file'}")
    places: dict[str, int] = {}
    repeated: set[str] = set()
    for k, entry in enumerate(entries):
        if places.setdefault(entry.path.name, k) != k:
            repeated.add(entry.path.name)
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        names = line.split()
        if not names:
            continue
        if len(names) != 3:
            raise MeshFileError(f"{path}: line {number} has {len(names)} names; identity, pose and ground truth are 3")
        missing = [name for name in names if name not in places]
        if missing:
            raise MeshFileError(f"{path}: line {number} names {missing[0]!r}, which none of {len(places)} meshes is")
        if twice := [name for name in names if name in repeated]:
            raise MeshFileError(f"{path}: line {number} names {twice[0]!r}, and several meshes are called that")
        a, b, truth = (places[name] for name in names)
        rows.append((a, b, truth))
    if not rows:
        raise MeshFileError(f"{path}: no pairs in it")
    return rows


def _numbers(name: re.Pattern[str], text: str) -> tuple[int, int] | None:
    found = name.fullmatch(text)
    return None if found is None else (int(found[1]), int(found[2]))


def _scan(
    folder: str | os.PathLike[str], pattern: str, numbers: Callable[[Path], tuple[int, int] | None], example: str
) -> list[MeshEntry]:
    folder = Path(folder)
    if not folder.is_dir():
        raise MeshFileError(f"{folder}: {'a file, not a folder' if folder.exists() else 'no such folder'}")
    try:  # glob finds nothing where it may not look
        os.listdir(folder)
    except OSError as error:
        raise MeshFileError(f"{folder}: it cannot be listed ({error.strerror or error})") from error
    found = {path: place for path in sorted(folder.glob(pattern)) if (place := numbers(path)) is not None}
    if not found:
        raise MeshFileError(f"{folder}: no mesh named like {example} in it")
    first: dict[tuple[int, int], Path] = {}
    for path, place in found.items():
        if place in first:
            raise MeshFileError(f"{path} and {first[place]} are both identity {place[0]} in pose {place[1]}")
        first[place] = path
    return [MeshEntry(path, *place) for place, path in sorted((place, path) for path, place in found.items())]
