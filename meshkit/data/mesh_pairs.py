"""Pairs of meshes from files, of any vertex counts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.utils.data import Dataset

from meshkit.batching import center
from meshkit.data.batch import PairBatch
from meshkit.data.sampler import addresses_of, seeded
from meshkit.data.store import MeshStore

__all__ = ["MeshPairs"]


class MeshPairs(Dataset[PairBatch]):
    """Random pairs of the meshes in a store; the counterpart of :class:`~meshkit.data.PosePairs` for files.

    Addressed, reproducible, centred and shuffled alike: an item depends on ``(epoch, i)`` and on nothing else. Meshes
    of a batch may differ in vertices and faces; they are padded, with masks, and faces with -1.

    With ground truth, the identity mesh is any mesh, the pose one that its identity is stored in, and the pose mesh any
    mesh in that pose: on a complete grid of identities and poses, two draws as in the released loaders, but that the
    pose is not the identity mesh's own, and the pose mesh is not the ground truth, wherever there are others. Where
    files are missing from the grid, only pairs whose ground truth exists are drawn. Without, the two are different
    meshes of the store.

    Args:
        store: the meshes; with their descriptors, 0 in the padding, if :meth:`MeshStore.describe` was called before.
        length: pairs per epoch.
        seed: of everything random.
        resample: draw new pairs each epoch, instead of one fixed set in new vertex orders.
        shuffle: permute the vertices.
        listed: rows (identity mesh, pose mesh, ground truth) of places in the store, as from
            :func:`~meshkit.data.read_test_list`: these instead of random ones.
        ground_truth: provide the ground truth.
        pose_noise: standard deviation of normal noise on the pose mesh, in the unit of the files, before centring.
        window: stream: draw each part of an epoch from this many shards, in an order that changes from epoch to epoch.
            Memory then holds these shards and disks are read in sequence, however large the store; give
            :class:`~meshkit.data.PairSampler` ``shuffle=False``, so that parts follow each other. A part in which no
            two meshes share a pose gives only pairs whose pose mesh is the ground truth, with a warning.

    Raises:
        ValueError: a length or window below 1, noise that is negative or beside descriptors, less than two meshes, no
            ground truth in the store, meshes of one identity that differ in vertex count, or listed places that are
            not there.
        TypeError: indexed with anything but addresses.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from meshkit.data import MeshEntry, load_humans
        >>> from meshkit.io import save_mesh
        >>> folder, entries = Path(tempfile.mkdtemp()), []
        >>> for who, num in ((0, 1000), (1, 2000)):
        ...     body = load_humans(num)
        ...     for how in (0, 1):
        ...         entries.append(MeshEntry(folder / f"{who}_{how}.ply", who, how))
        ...         save_mesh(entries[-1].path, body(torch.tensor([who]), torch.tensor([how]))[0], body.faces)
        >>> pairs = MeshPairs(MeshStore.build(entries, folder / "cache", progress=False))
        >>> batch = pairs[[(0, i) for i in range(8)]]
        >>> batch.identity.shape, batch.identity_mask.sum(1).unique().tolist()
        (torch.Size([8, 2000, 3]), [1000, 2000])
    """

    def __init__(
        self,
        store: MeshStore,
        *,
        length: int = 6400,
        seed: int = 0,
        resample: bool = True,
        shuffle: bool = True,
        listed: Sequence[tuple[int, int, int]] | None = None,
        ground_truth: bool = True,
        pose_noise: float = 0.0,
        window: int | None = None,
    ) -> None:
        if not length >= 1 or not pose_noise >= 0 or (window is not None and not window >= 1):
            raise ValueError(
                f"need length >= 1, pose_noise >= 0 and window >= 1, got {length}, {pose_noise} and {window}"
            )
        if pose_noise > 0 and store.descriptor_width:
            raise ValueError(f"descriptors are of clean meshes: pose_noise must be 0 beside them, got {pose_noise}")
        if len(store) < 2 and listed is None:
            raise ValueError(f"pairs need at least 2 meshes, the store has {len(store)}")
        self.store, self.seed, self.resample, self.shuffle = store, seed, resample, shuffle
        self.ground_truth, self.pose_noise, self.window = ground_truth, pose_noise, window
        self.descriptor_width = store.descriptor_width
        self.listed = None if listed is None else list(listed)
        self.length = length if self.listed is None else len(self.listed)
        self.num_shards = int(store.shard.max()) + 1
        self._choice: tuple[tuple[int, int] | None, _Choice] = (
            None,
            _Choice(store, torch.arange(len(store), device="cpu")),
        )
        if self.listed is not None:
            self._check_listed()
        elif ground_truth:
            _check_counts(store)
            if not self._choice[1].has_pairs():
                raise ValueError(
                    "no pose in the store is shared by two identities, so no ground truth is known: use "
                    "ground_truth=False"
                )

    def __len__(self) -> int:
        return self.length

    @torch.no_grad()
    def __getitem__(self, address: tuple[int, int] | Sequence[tuple[int, int]]) -> PairBatch:
        """The pairs at one or several ``(epoch, i)``, as a batch."""
        addresses = addresses_of(address)
        store, dice = self.store, torch.Generator()
        drawn = [self._draw(dice, epoch if self.resample else 0, i) for epoch, i in addresses]
        draws = torch.tensor(drawn, device="cpu")
        a, b, c = draws.unbind(1)
        identity, identity_faces, mask_a = self._allocate(a)
        pose, pose_faces, mask_b = self._allocate(b)
        truth = torch.zeros_like(identity) if self.ground_truth else identity[:, :0]
        match = torch.full(identity.shape[:2], -1, device="cpu")
        width = self.descriptor_width
        known_a, known_b = (x.new_zeros(*x.shape[:2], width) if width else None for x in (identity, pose))
        registered = (store.topology[a] == store.topology[b]).tolist()
        for row, (epoch, i) in enumerate(addresses):
            k, m, t = drawn[row]
            orders = self._orders(dice, epoch, i, k, m)
            rank_b = _take(store, m, orders[1], pose[row], pose_faces[row])
            _take(store, k, orders[0], identity[row], identity_faces[row])
            if registered[row]:
                torch.index_select(rank_b, 0, orders[0], out=match[row, : len(orders[0])])
            for known, mesh, order in ((known_a, k, orders[0]), (known_b, m, orders[1])):
                if known is not None:
                    torch.index_select(store.view("descriptors", mesh), 0, order, out=known[row, : len(order)])
            if self.ground_truth:
                torch.index_select(store.view("verts", t), 0, orders[0], out=truth[row, : len(orders[0])])
            if self.pose_noise > 0:
                real = pose[row, : len(orders[1])]
                seeded(dice, self.seed + 3, epoch, i)
                real += self.pose_noise * torch.randn(real.shape, generator=dice, device="cpu")
        return PairBatch(
            identity=_shift(identity, store.center[a], mask_a),
            identity_faces=identity_faces,
            pose=center(pose, mask_b) if self.pose_noise > 0 else _shift(pose, store.center[b], mask_b),
            pose_faces=pose_faces,
            ground_truth=_shift(truth, store.center[c], mask_a) if self.ground_truth else truth,
            correspondence=match,
            identity_index=store.identity[a],
            pose_index=store.pose[b],
            identity_descriptors=known_a,
            pose_descriptors=known_b,
            identity_mask=mask_a,
            pose_mask=mask_b,
        )

    def _allocate(self, meshes: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Room for vertices and faces of a batch, and the mask if they differ in number."""
        verts, faces = self.store.num_verts[meshes], self.store.num_faces[meshes]
        batch, most = len(meshes), int(verts.max())
        mask = None if bool((verts == most).all()) else torch.arange(most, device="cpu") < verts[:, None]
        points = torch.zeros(batch, most, 3, device="cpu")
        return points, torch.full((batch, int(faces.max()), 3), -1, device="cpu"), mask

    def _orders(self, dice: torch.Generator, epoch: int, i: int, a: int, b: int) -> tuple[Tensor, Tensor]:
        num_a, num_b = int(self.store.num_verts[a]), int(self.store.num_verts[b])
        if not self.shuffle:
            return torch.arange(num_a, device="cpu"), torch.arange(num_b, device="cpu")
        seeded(dice, self.seed + 1, epoch, i)
        a_order = torch.randperm(num_a, generator=dice, device="cpu")
        return a_order, torch.randperm(num_b, generator=dice, device="cpu")

    def _draw(self, dice: torch.Generator, epoch: int, i: int) -> tuple[int, int, int]:
        """Places of identity mesh, pose mesh and ground truth; the last is -1 without."""
        if self.listed is not None:
            return self.listed[i]
        choice = self._choice[1]
        if self.window is not None and self.window < self.num_shards:
            part = i * -(-self.num_shards // self.window) // self.length
            if self._choice[0] != (epoch, part):
                seeded(dice, self.seed + 4, epoch, 0)
                order = torch.randperm(self.num_shards, generator=dice, device="cpu")
                shards = order[part * self.window : (part + 1) * self.window]
                members = torch.isin(self.store.shard, shards).nonzero()[:, 0]
                self._choice = ((epoch, part), _Choice(self.store, members))
                if self.ground_truth and not self._choice[1].has_pairs():
                    warnings.warn(
                        f"no pose is shared by two meshes in {self.window} shards of {self.num_shards}: the pose mesh "
                        "will be the ground truth; make window or shard_bytes larger",
                        stacklevel=2,
                    )
            choice = self._choice[1]
        seeded(dice, self.seed, epoch, i)
        return choice.with_truth(dice) if self.ground_truth else (*choice.any_two(dice), -1)

    def _check_listed(self) -> None:
        for number, row in enumerate(self.listed or []):
            if len(row) != 3 or not all(0 <= k < len(self.store) for k in row):
                raise ValueError(f"listed row {number} must be 3 places in [0, {len(self.store)}), got {row}")
            a, _, c = row
            if self.ground_truth and self.store.num_verts[a] != self.store.num_verts[c]:
                first, second = self.store.entries[a].path, self.store.entries[c].path
                raise ValueError(f"{first} and its ground truth {second} differ in vertex count")


class _Choice:
    """Draws from some meshes of a store, in time that does not grow with their number."""

    def __init__(self, store: MeshStore, members: Tensor) -> None:
        who, how = store.identity[members], store.pose[members]
        by_identity, by_pose = torch.argsort(who, stable=True), torch.argsort(how, stable=True)
        (identity_row, identity_start), (pose_row, pose_start) = _groups(who), _groups(how)
        # Lists, because single entries of tensors are slow to read.
        self.members: list[int] = members.tolist()
        self.identity_row: list[int] = identity_row.tolist()
        self.identity_start: list[int] = identity_start.tolist()
        self.pose_start: list[int] = pose_start.tolist()
        self.of_identity: list[int] = members[by_identity].tolist()
        self.of_pose: list[int] = members[by_pose].tolist()
        self.pose_of: list[int] = pose_row[by_identity].tolist()  # the group of the pose of each entry of of_identity
        self.in_identity: list[int] = torch.argsort(by_identity).tolist()  # where each member is in of_identity,
        self.in_pose: list[int] = torch.argsort(by_pose)[by_identity].tolist()  # and each of these in of_pose

    def has_pairs(self) -> bool:
        """Whether some pose is shared by two meshes."""
        return max(b - a for a, b in pairwise(self.pose_start)) > 1

    def any_two(self, dice: torch.Generator) -> tuple[int, int]:
        """Two meshes, different if there are two."""
        u, v, _ = torch.rand(3, generator=dice, dtype=torch.float64, device="cpu").tolist()
        count = len(self.members)
        a = int(u * count)
        return self.members[a], self.members[_other(v, 0, count, a)]

    def with_truth(self, dice: torch.Generator) -> tuple[int, int, int]:
        """A mesh; a mesh in some pose that the first one's identity takes too; and that identity in that pose.

        Wherever there are others, the pose is not the first mesh's, and the second mesh is not the third.
        """
        u, v, w = torch.rand(3, generator=dice, dtype=torch.float64, device="cpu").tolist()
        a = int(u * len(self.members))
        row = self.identity_row[a]
        place = _other(v, self.identity_start[row], self.identity_start[row + 1], self.in_identity[a])
        row = self.pose_of[place]
        second = _other(w, self.pose_start[row], self.pose_start[row + 1], self.in_pose[place])
        return self.members[a], self.of_pose[second], self.of_identity[place]


def _other(u: float, start: int, stop: int, but: int) -> int:
    """A place of ``[start, stop)`` for u in [0, 1), another than ``but`` if there is one."""
    if stop - start == 1:
        return start
    place = start + int(u * (stop - start - 1))
    return place + (place >= but)


def _groups(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Number of each entry's group, and where the groups start once entries are sorted by label."""
    _, row, count = labels.unique(return_inverse=True, return_counts=True)
    return row, torch.cat([count.new_zeros(1), count.cumsum(0)])


def _take(store: MeshStore, k: int, order: Tensor, verts: Tensor, faces: Tensor) -> Tensor:
    """Write mesh k in another vertex order into the first rows; return where each of its vertices went."""
    torch.index_select(store.view("verts", k), 0, order, out=verts[: len(order)])
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device="cpu"))
    corners = store.view("faces", k).flatten()
    torch.index_select(rank, 0, corners, out=faces.view(-1)[: len(corners)])
    return rank


def _shift(verts: Tensor, centers: Tensor, mask: Tensor | None) -> Tensor:
    moved = verts.sub_(centers[:, None])
    return moved if mask is None else moved.masked_fill_(~mask[..., None], 0)


def _check_counts(store: MeshStore) -> None:
    """Every identity has one vertex count: its meshes are ground truth for each other."""
    row, _ = _groups(store.identity)
    place = torch.arange(len(row), device="cpu")
    first = row.new_full((int(row.max()) + 1,), len(row)).scatter_reduce_(0, row, place, "amin")
    other = (store.num_verts != store.num_verts[first[row]]).nonzero()[:, 0]
    if len(other):
        a, b = store.entries[int(first[row[other[0]]])].path, store.entries[int(other[0])].path
        raise ValueError(
            f"{a} and {b} are one identity but differ in vertex count: neither is ground truth for the other"
        )
