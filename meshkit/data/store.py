"""Meshes of a folder, parsed once and read from memory maps afterwards."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshkit._checks import check_whole
from meshkit.data._signatures import signatures
from meshkit.data.layouts import MeshEntry
from meshkit.io import MeshFileError, atomic_write, load_mesh

__all__ = ["MeshStore"]

_FORMAT = 3
_DTYPES = {"verts": "float32", "faces": "int32", "descriptors": "float32"}
_DESCRIBED = "descriptors.json"
_HEADER = 64  # bytes of an .npy file before its numbers, at least
_OPEN_MAPS = 64


class MeshStore:
    """Meshes in shards of ``.npy`` files, read through memory maps: any number of them, in little memory.

    :meth:`build` parses the files once, with a progress bar, and writes the shards; later calls with the same files
    (by name, size and time of change) open what is there. Identical face lists are stored once per shard. Meshes are
    spread over the shards at random, always alike, so that a few shards hold many identities and poses.

    Args:
        cache: folder that :meth:`build` filled.

    Attributes:
        entries: the meshes, without files that could not be read.
        identity: ``(P,)`` identity of each.
        pose: ``(P,)`` pose of each.
        num_verts: ``(P,)`` vertex counts.
        num_faces: ``(P,)`` face counts.
        center: ``(P, 3)`` float32 middle of the bounding box of each.
        topology: ``(P,)`` number of the face list: meshes with equal ones are taken to be registered to each other.
        shard: ``(P,)`` shard that holds each.
        skipped: names of files that could not be read, with the reason.
        descriptor_width: numbers per vertex that :meth:`describe` has computed; 0 before it was called.

    Raises:
        MeshFileError: no store of this format in the folder, or shards missing.

    Example:
        >>> import tempfile
        >>> from meshkit.data import MeshPairs, load_humans, scan_pose_transfer
        >>> from meshkit.io import save_mesh
        >>> folder, body = Path(tempfile.mkdtemp()), load_humans()
        >>> for who, how in ((0, 0), (0, 1), (1, 0), (1, 1)):
        ...     save_mesh(folder / f"{who}_{how}.ply", body(torch.tensor([who]), torch.tensor([how]))[0], body.faces)
        >>> store = MeshStore.build(scan_pose_transfer(folder), folder / "cache", progress=False)
        >>> len(store), store.verts(3).shape, store.topology.tolist()
        (4, torch.Size([1000, 3]), [0, 0, 0, 0])
        >>> store.describe(num_signatures=4, progress=False)
        >>> MeshPairs(store)[0, 0].identity_descriptors.shape
        torch.Size([1, 1000, 5])
    """

    def __init__(self, cache: str | os.PathLike[str]) -> None:
        self.cache = Path(cache)
        try:
            index = json.loads((self.cache / "index.json").read_text())
            if index["format"] != _FORMAT:
                raise ValueError(f"format {index['format']}, not {_FORMAT}")
            rows = np.array(index["rows"], dtype=np.int64).reshape(-1, 8)
            names, _, self._key = index["paths"], index["centers"], index["key"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise MeshFileError(f"{self.cache}: no store of meshes in it ({error}); build it") from error
        self.entries = [
            MeshEntry(Path(p), int(i), int(q)) for p, i, q in zip(names, rows[:, 0], rows[:, 1], strict=True)
        ]
        self.skipped: list[tuple[str, str]] = [(name, reason) for name, reason in index["skipped"]]
        self.identity, self.pose, self.topology, self.shard = torch.from_numpy(rows[:, :4].T.copy())
        self._spans = rows[:, 4:]
        self.num_verts = torch.from_numpy(self._spans[:, 1] - self._spans[:, 0])
        self.num_faces = torch.from_numpy(self._spans[:, 3] - self._spans[:, 2])
        self.center = torch.tensor(index["centers"], device="cpu").view(-1, 3)
        self.descriptor_width = 0
        self._maps: OrderedDict[tuple[str, int], Tensor] = OrderedDict()
        for number in self.shard.unique().tolist():
            for kind in ("verts", "faces"):
                path, needed = self._file(kind, number), _HEADER + 12 * self._rows_of(kind, number)
                if not path.is_file() or path.stat().st_size < needed:
                    state = "cut short" if path.exists() else "missing"
                    raise MeshFileError(f"{path}: shard is {state}; delete {self.cache} and build")

    @classmethod
    def build(
        cls,
        entries: Sequence[MeshEntry],
        cache: str | os.PathLike[str],
        *,
        skip_bad: bool = False,
        progress: bool = True,
        shard_bytes: int = 64 << 20,
        max_file_bytes: int = 128 << 20,
    ) -> MeshStore:
        """Parse meshes into ``cache``, unless exactly these files are there already, and open the store.

        In memory at a time: one shard, and one file being parsed. Parsing was measured to take 6 to 13 times the size
        of files from :func:`~meshkit.io.save_mesh`, and 27 times that of a text of single digits: with the defaults,
        at most 4 GiB, and that only for a file as large as ``max_file_bytes``.

        Args:
            entries: the meshes, from :func:`~meshkit.data.scan_pose_transfer` and its like, or made by yourself.
            cache: folder for the shards; made if missing.
            skip_bad: leave out files that cannot be read, and warn at the end how many, naming the first. They are
                listed in ``skipped``. Otherwise the first one is an error.
            progress: show a progress bar.
            shard_bytes: size to which a shard grows; unit of streaming.
            max_file_bytes: larger files count as files that cannot be read.

        Raises:
            MeshFileError: no entries, or none readable; or a file that cannot be read, without ``skip_bad``.
        """
        from tqdm import tqdm

        if not entries:
            raise MeshFileError(f"no meshes to store in {cache}")
        cache = Path(cache)
        key = _fingerprint(entries, skip_bad, shard_bytes, max_file_bytes)
        if _stored_key(cache) == key:
            with suppress(MeshFileError):  # shards that were damaged since are made again
                return cls(cache)
        cache.mkdir(parents=True, exist_ok=True)
        (cache / "index.json").unlink(missing_ok=True)  # without an index, what follows is no store until it is whole
        for stale in (*(path for kind in _DTYPES for path in cache.glob(f"{kind}-*.npy")), cache / _DESCRIBED):
            stale.unlink(missing_ok=True)
        stored: dict[int, tuple[list[int], list[float]]] = {}
        bad: dict[int, tuple[str, str]] = {}
        topologies: dict[bytes, int] = {}
        shard = _Shard(cache, 0)
        order = torch.randperm(len(entries), generator=torch.Generator().manual_seed(0), device="cpu").tolist()
        for k in tqdm(order, desc="meshes", unit="mesh", disable=not progress, dynamic_ncols=True):
            entry = entries[k]
            try:
                verts, faces = _read(entry.path, max_file_bytes)
            except MeshFileError as error:
                if not skip_bad:
                    raise
                bad[k] = (str(entry.path), str(error))
                continue
            digest = hashlib.sha256(faces.tobytes() + len(verts).to_bytes(8, "little")).digest()
            topology = topologies.setdefault(digest, len(topologies))
            row = [entry.identity, entry.pose, topology, shard.number, *shard.add(verts, faces, topology)]
            stored[k] = (row, ((verts.min(0) + verts.max(0)) / 2).tolist())
            if shard.size >= shard_bytes:
                shard.write()
                shard = _Shard(cache, shard.number + 1)
        skipped = [bad[k] for k in sorted(bad)]
        if not stored:
            raise MeshFileError(f"none of the {len(entries)} files could be read, the first: {skipped[0][1]}")
        shard.write()
        places = sorted(stored)  # as the entries came
        first: dict[int, int] = {}
        rows = [stored[k][0] for k in places]
        for row in rows:
            row[2] = first.setdefault(row[2], len(first))
        index = {
            "format": _FORMAT,
            "key": key,
            "rows": rows,
            "paths": [str(entries[k].path) for k in places],
            "centers": [stored[k][1] for k in places],
            "skipped": skipped,
        }
        with atomic_write(cache / "index.json") as temporary:
            temporary.write_text(json.dumps(index))
        if skipped:
            were = "was" if len(skipped) == 1 else "were"
            message = f"{len(skipped)} of {len(entries)} mesh files {were} left out, the first: {skipped[0][1]}"
            warnings.warn(message, stacklevel=2)
        return cls(cache)

    def __len__(self) -> int:
        return len(self.entries)

    def verts(self, k: int) -> Tensor:
        """Vertices ``(N, 3)`` float32 of mesh k, in the order of its file."""
        return self.view("verts", k).clone()

    def faces(self, k: int) -> Tensor:
        """Faces ``(F, 3)`` int64 of mesh k."""
        return self.view("faces", k).long()

    def describe(
        self, *, num_signatures: int = 16, num_eigenpairs: int = 64, workers: int = 1, progress: bool = True
    ) -> None:
        """Compute intrinsic descriptors of every mesh and store them beside it; what is there already is only opened.

        :class:`~meshkit.data.MeshPairs` made afterwards provide them. They are written shard by shard: when stopped,
        the same call goes on with the shard it was at. In memory at a time: those of one shard, twice.

        Args:
            num_signatures: see :func:`~meshkit.descriptors.intrinsic_descriptors`.
            num_eigenpairs: likewise.
            workers: processes; the eigensolver uses one core each. With more than one, a script must keep its work
                under ``if __name__ == "__main__"``, as for any spawned process.
            progress: show a progress bar.

        Raises:
            MeshFileError: a mesh that has no descriptors, with the reason.
            ValueError: a number of signatures or eigenpairs below 1.
        """
        from tqdm import tqdm

        check_whole(num_signatures, "num_signatures")
        check_whole(num_eigenpairs, "num_eigenpairs")
        described = json.dumps([_FORMAT, self._key, num_signatures, num_eigenpairs])
        note = self.cache / _DESCRIBED
        self.descriptor_width = 0  # until all are there: what failed or was stopped has none to give
        for key in [key for key in self._maps if key[0] == "descriptors"]:
            del self._maps[key]
        if not note.is_file() or note.read_bytes() != described.encode():
            for stale in self.cache.glob("descriptors-*.npy"):
                stale.unlink()
            with atomic_write(note) as temporary:
                temporary.write_text(described)
        width = num_signatures + 1
        missing = [number for number in self.shard.unique().tolist() if not self._is_described(number, width)]
        total = int(torch.isin(self.shard, torch.tensor(missing, device="cpu")).sum())
        with tqdm(total=total, desc="descriptors", unit="mesh", disable=not progress, dynamic_ncols=True) as bar:
            for number in missing:
                members = (self.shard == number).nonzero()[:, 0].tolist()
                members.sort(key=lambda k: int(self._spans[k, 0]))  # as their vertices are stored
                computed = signatures(
                    (self.verts(k) for k in members),
                    (self.faces(k) for k in members),
                    num_signatures=num_signatures,
                    num_eigenpairs=num_eigenpairs,
                    workers=workers,
                )
                parts = []
                with closing(computed):  # an error ends the processes and gives the threads back at once
                    for k, result in zip(members, computed, strict=True):
                        if isinstance(result, ValueError):
                            raise MeshFileError(f"{self.entries[k].path}: no descriptors: {result}")
                        parts.append(result)
                        bar.update()
                with atomic_write(self._file("descriptors", number)) as temporary:
                    np.save(temporary, np.concatenate(parts))
        self.descriptor_width = width

    def _is_described(self, number: int, width: int) -> bool:
        try:
            self._load("descriptors", number, width)
        except MeshFileError:  # missing or damaged
            return False
        return True

    def view(self, kind: str, k: int) -> Tensor:
        """``"verts"`` (float32), ``"faces"`` (int32) or ``"descriptors"`` (float32, after :meth:`describe`) of mesh k.

        Not copied: pages of the file, until written to.
        """
        if kind == "descriptors" and not self.descriptor_width:
            raise ValueError(f"{self.cache}: no descriptors yet: call describe() first")
        begin, end = self._spans[k, 2:] if kind == "faces" else self._spans[k, :2]
        return self._map(kind, int(self.shard[k]))[begin:end]

    def _file(self, kind: str, number: int) -> Path:
        return self.cache / f"{kind}-{number:05d}.npy"

    def _rows_of(self, kind: str, number: int) -> int:
        """How many rows a shard must have."""
        spans = self._spans[(self.shard == number).numpy()]
        return int(spans[:, 3 if kind == "faces" else 1].max(initial=0))

    def _load(self, kind: str, number: int, width: int) -> Tensor:
        """A memory map of a shard. What is written to it stays private."""
        path, rows = self._file(kind, number), self._rows_of(kind, number)
        try:
            array = np.load(path, mmap_mode="c")
            if array.dtype != _DTYPES[kind] or array.shape[1:] != (width,) or len(array) < rows:
                raise ValueError(f"{array.dtype} {array.shape}, {rows} rows of {width} {_DTYPES[kind]} were written")
        except (OSError, ValueError, EOFError) as error:
            raise MeshFileError(f"{path}: shard is damaged ({error}); delete {self.cache} and build") from error
        return torch.from_numpy(array)

    def _map(self, kind: str, number: int) -> Tensor:
        """A shard, of which a limited number are kept open."""
        if (kind, number) not in self._maps:
            width = self.descriptor_width if kind == "descriptors" else 3
            self._maps[kind, number] = self._load(kind, number, width)
            if len(self._maps) > _OPEN_MAPS:
                self._maps.popitem(last=False)
        self._maps.move_to_end((kind, number))
        return self._maps[kind, number]

    def __getstate__(self) -> dict[str, Any]:
        # A pickled memory map would carry its whole content to the worker.
        return {**self.__dict__, "_maps": OrderedDict()}


class _Shard:
    """What is gathered for one pair of files."""

    def __init__(self, cache: Path, number: int) -> None:
        self.cache, self.number, self.size = cache, number, 0
        self.verts: list[np.ndarray] = []
        self.faces: list[np.ndarray] = []
        self.ends = [0, 0]
        self.places: dict[int, tuple[int, int]] = {}

    def add(self, verts: np.ndarray, faces: np.ndarray, topology: int) -> tuple[int, int, int, int]:
        """First and last row of the vertices and of the faces."""
        begin = self.ends[0]
        self.ends[0] += len(verts)
        self.verts.append(verts)
        self.size += verts.nbytes
        if topology not in self.places:
            self.places[topology] = (self.ends[1], self.ends[1] + len(faces))
            self.ends[1] += len(faces)
            self.faces.append(faces)
            self.size += faces.nbytes
        return (begin, self.ends[0], *self.places[topology])

    def write(self) -> None:
        if self.verts:
            for kind, parts in (("verts", self.verts), ("faces", self.faces)):
                with atomic_write(self.cache / f"{kind}-{self.number:05d}.npy") as temporary:
                    np.save(temporary, np.concatenate(parts))


def _read(path: Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    size = path.stat().st_size if path.is_file() else 0
    if size > max_bytes:
        raise MeshFileError(f"{path}: {size:,} bytes, more than the {max_bytes:,} allowed (max_file_bytes)")
    verts, faces = load_mesh(path, max_bytes=max_bytes)
    return verts.numpy(), faces.numpy().astype(np.int32)


def _fingerprint(entries: Sequence[MeshEntry], *options: object) -> str:
    """Changes with the files' names, sizes and times, with what they are said to be, and with the options."""
    total = hashlib.sha256(repr((_FORMAT, options)).encode())
    for entry in entries:
        stat = entry.path.stat() if entry.path.is_file() else None
        known = (0, 0) if stat is None else (stat.st_size, stat.st_mtime_ns)
        total.update(repr((str(entry.path), entry.identity, entry.pose, known)).encode())
    return total.hexdigest()


def _stored_key(cache: Path) -> str | None:
    try:
        return json.loads((cache / "index.json").read_text())["key"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
