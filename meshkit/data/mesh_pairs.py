"""Pairs of meshes from files, of any vertex counts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils.data import Dataset

from meshkit.batching import pad, pad_faces
from meshkit.data.batch import PairBatch
from meshkit.data.sampler import seeded
from meshkit.data.store import MeshStore

__all__ = ["MeshPairs"]


class MeshPairs(Dataset[PairBatch]):
    """Random pairs of the meshes in a store; the counterpart of :class:`~meshkit.data.PosePairs` for files.

    Addressed, reproducible, centred and shuffled alike: an item depends on ``(epoch, i)`` and on nothing else. Meshes
    of a batch may differ in vertices and faces; they are padded, with masks, and faces with -1.

    With ground truth, the identity mesh is any mesh, the pose one that its identity is stored in, and the pose mesh any
    mesh in that pose: on a complete grid of identities and poses, that is two independent draws, as in the released
    loaders. Where files are missing from the grid, only pairs whose ground truth exists are drawn. Without, the two are
    different meshes of the store.

    Args:
        store: the meshes.
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
            :class:`~meshkit.data.PairSampler` ``shuffle=False``, so that parts follow each other.

    Raises:
        ValueError: a length or window below 1, negative noise, less than two meshes, no ground truth in the store,
            meshes of one identity that differ in vertex count, or listed places that are not there.

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
        if length < 1 or pose_noise < 0 or (window is not None and window < 1):
            raise ValueError(
                f"need length >= 1, pose_noise >= 0 and window >= 1, got {length}, {pose_noise} and {window}"
            )
        if len(store) < 2 and listed is None:
            raise ValueError(f"pairs need at least 2 meshes, the store has {len(store)}")
        self.store, self.seed, self.resample, self.shuffle = store, seed, resample, shuffle
        self.ground_truth, self.pose_noise, self.window = ground_truth, pose_noise, window
        self.listed = None if listed is None else list(listed)
        self.length = length if self.listed is None else len(self.listed)
        self.num_shards = int(store.shard.max()) + 1
        self._choice: tuple[tuple[int, int] | None, _Choice] = (None, _Choice(store, torch.arange(len(store))))
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
        addresses = [address] if isinstance(address, tuple) else address
        dice = torch.Generator()
        columns = list(zip(*(self._item(dice, epoch, i) for epoch, i in addresses), strict=True))
        verts_a, faces_a, verts_b, faces_b, truths, matches, places = columns
        identity, mask_a = pad(verts_a)
        pose, mask_b = pad(verts_b)
        index = torch.tensor(places)
        return PairBatch(
            identity=identity,
            identity_faces=pad_faces(faces_a),
            pose=pose,
            pose_faces=pad_faces(faces_b),
            ground_truth=pad(truths)[0] if self.ground_truth else identity[:, :0],
            correspondence=torch.nn.utils.rnn.pad_sequence(list(matches), batch_first=True, padding_value=-1),
            identity_index=self.store.identity[index[:, 0]],
            pose_index=self.store.pose[index[:, 1]],
            identity_mask=None if bool(mask_a.all()) else mask_a,
            pose_mask=None if bool(mask_b.all()) else mask_b,
        )

    def _item(
        self, dice: torch.Generator, epoch: int, i: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None, Tensor, tuple[int, int]]:
        a, b, c = self._draw(dice, epoch if self.resample else 0, i)
        store = self.store
        verts_a, verts_b = store.verts(a), store.verts(b)
        order_a, order_b = torch.arange(len(verts_a)), torch.arange(len(verts_b))
        if self.shuffle:
            seeded(dice, self.seed + 1, epoch, i)
            order_a = torch.randperm(len(verts_a), generator=dice)
            order_b = torch.randperm(len(verts_b), generator=dice)
        if self.pose_noise > 0:
            noise = torch.randn(verts_b.shape, generator=seeded(dice, self.seed + 3, epoch, i))
            verts_b = verts_b + self.pose_noise * noise
        rank_a, rank_b = _inverse(order_a), _inverse(order_b)
        registered = bool(store.topology[a] == store.topology[b])
        match = rank_b[order_a] if registered else torch.full_like(order_a, -1)
        truth = _centred(store.verts(c))[order_a] if self.ground_truth else None
        faces_a, faces_b = rank_a[store.faces(a)], rank_b[store.faces(b)]
        return _centred(verts_a)[order_a], faces_a, _centred(verts_b)[order_b], faces_b, truth, match, (a, b)

    def _draw(self, dice: torch.Generator, epoch: int, i: int) -> tuple[int, int, int]:
        """Places of identity mesh, pose mesh and ground truth; the last is -1 without."""
        if self.listed is not None:
            return self.listed[i]
        choice = self._choice[1]
        if self.window is not None and self.window < self.num_shards:
            part = i * -(-self.num_shards // self.window) // self.length
            if self._choice[0] != (epoch, part):
                order = torch.randperm(self.num_shards, generator=seeded(dice, self.seed + 4, epoch, 0))
                shards = order[part * self.window : (part + 1) * self.window]
                members = torch.isin(self.store.shard, shards).nonzero()[:, 0]
                self._choice = ((epoch, part), _Choice(self.store, members))
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
        self.members = members
        who, how = store.identity[members], store.pose[members]
        by_identity, by_pose = torch.argsort(who, stable=True), torch.argsort(how, stable=True)
        self.identity_row, self.identity_start = _groups(who)
        self.pose_row, self.pose_start = _groups(how)
        self.of_identity, self.of_pose = members[by_identity], members[by_pose]
        # Where the pose of each entry of of_identity is found in of_pose.
        self.pose_of = self.pose_row[by_identity]

    def has_pairs(self) -> bool:
        """Whether some pose is shared by two meshes."""
        return int(self.pose_start.diff().max()) > 1

    def any_two(self, dice: torch.Generator) -> tuple[int, int]:
        """Two meshes, different if there are two."""
        a = _below(len(self.members), dice)
        b = _below(max(1, len(self.members) - 1), dice)
        return int(self.members[a]), int(self.members[min(b + (b >= a), len(self.members) - 1)])

    def with_truth(self, dice: torch.Generator) -> tuple[int, int, int]:
        """A mesh; a mesh in some pose that the first one's identity takes too; and that identity in that pose."""
        a = _below(len(self.members), dice)
        start, stop = self.identity_start[self.identity_row[a] : self.identity_row[a] + 2].tolist()
        place = start + _below(stop - start, dice)
        row = int(self.pose_of[place])
        first, last = self.pose_start[row : row + 2].tolist()
        b = first + _below(last - first, dice)
        return int(self.members[a]), int(self.of_pose[b]), int(self.of_identity[place])


def _groups(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Number of each entry's group, and where the groups start once entries are sorted by label."""
    _, row, count = labels.unique(return_inverse=True, return_counts=True)
    return row, torch.cat([count.new_zeros(1), count.cumsum(0)])


def _below(count: int, dice: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=dice))


def _inverse(order: Tensor) -> Tensor:
    return torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))


def _centred(verts: Tensor) -> Tensor:
    low, high = verts.aminmax(dim=0)
    return verts - (low + high) / 2


def _check_counts(store: MeshStore) -> None:
    """Every identity has one vertex count: its meshes are ground truth for each other."""
    row, _ = _groups(store.identity)
    place = torch.arange(len(row))
    first = torch.full((int(row.max()) + 1,), len(row)).scatter_reduce_(0, row, place, "amin")
    other = (store.num_verts != store.num_verts[first[row]]).nonzero()[:, 0]
    if len(other):
        a, b = store.entries[int(first[row[other[0]]])].path, store.entries[int(other[0])].path
        raise ValueError(
            f"{a} and {b} are one identity but differ in vertex count: neither is ground truth for the other"
        )
