"""Pairs of posed meshes with ground truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from meshkit.batching import center
from meshkit.data.pool import MeshPool
from meshkit.data.rigged import RiggedModel
from meshkit.neighbors import gather_vertices

__all__ = ["PairBatch", "PairSampler", "PosePairs", "pair_loader"]


@dataclass(frozen=True)
class PairBatch:
    """A batch of (identity mesh, pose mesh, ground truth).

    Args:
        identity: ``(B, N, 3)`` mesh that gives the body.
        identity_faces: ``(B, F, 3)``.
        pose: ``(B, M, 3)`` mesh that gives the pose.
        pose_faces: ``(B, G, 3)``.
        ground_truth: ``(B, N, 3)`` body of the one in the pose of the other, in the identity's vertex order.
        correspondence: ``(B, N)`` vertex of the pose mesh that is the same point of the body.
        identity_index: ``(B,)`` identity of the body.
        pose_index: ``(B,)`` pose of the ground truth.
        identity_descriptors: ``(B, N, D)`` or ``None``.
        pose_descriptors: ``(B, M, D)`` or ``None``.
    """

    identity: Tensor
    identity_faces: Tensor
    pose: Tensor
    pose_faces: Tensor
    ground_truth: Tensor
    correspondence: Tensor
    identity_index: Tensor
    pose_index: Tensor
    identity_descriptors: Tensor | None = None
    pose_descriptors: Tensor | None = None

    def to(self, device: torch.device | str) -> PairBatch:
        """The batch on another device."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {k: None if v is None else v.to(device) for k, v in values.items()}
        return PairBatch(**moved)

    def __len__(self) -> int:
        return len(self.identity)


class PosePairs(Dataset[PairBatch]):
    """Random pairs of posed bodies, generated on the fly and reproducible.

    An item is addressed by ``(epoch, i)`` and depends on nothing else: not on the worker, the batch it falls into, or
    what was read before. Indexing with a list of such addresses evaluates the whole batch at once.

    Each mesh is centred by its bounding box. Identity and pose meshes get independent random vertex orders; faces are
    re-indexed to match, and the ground truth follows the identity's order.

    Args:
        model: body with tables of identities and poses, on the CPU, where pairs are drawn; move the batch afterwards.
        identities: allowed identity indices.
        poses: allowed pose indices.
        length: pairs per epoch.
        seed: of everything random.
        resample: draw new pairs each epoch. ``False`` keeps one fixed set of pairs, as the paper does; vertex orders
            change all the same.
        shuffle: permute the vertices.
        pool: take input meshes with their descriptors from this pool. Its identities and poses replace the two lists.
        listed: ``(L, 4)`` identity and pose of the first mesh, identity and pose of the second: these pairs instead of
            random ones, ``i`` being the row. A pool must then hold their meshes in this order, two per row.

    Raises:
        ValueError: an empty list, or a length below 1.

    Reference:
        X-DualNet, "Datasets": 6400 pairs, vertices shuffled, bounding-box centring.

    Example:
        >>> from meshkit.data import human_split, load_humans
        >>> split = human_split()
        >>> pairs = PosePairs(load_humans(), split.train_identities, split.train_poses, length=100)
        >>> batch = pairs[[(0, 0), (0, 1)]]
        >>> batch.identity.shape, batch.identity_faces.shape
        (torch.Size([2, 1000, 3]), torch.Size([2, 1996, 3]))
    """

    def __init__(
        self,
        model: RiggedModel,
        identities: Tensor,
        poses: Tensor,
        *,
        length: int = 6400,
        seed: int = 0,
        resample: bool = True,
        shuffle: bool = True,
        pool: MeshPool | None = None,
        listed: Tensor | None = None,
    ) -> None:
        if len(identities) == 0 or len(poses) == 0 or length < 1:
            raise ValueError(
                f"need identities, poses and a positive length, got {len(identities)}, {len(poses)} and {length}"
            )
        self.model, self.identities, self.poses, self.pool = model, identities, poses, pool
        self.length = length if listed is None else len(listed)
        self.seed, self.resample, self.shuffle, self.listed = seed, resample, shuffle, listed

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, address: tuple[int, int] | Sequence[tuple[int, int]]) -> PairBatch:
        """The pairs at one or several ``(epoch, i)``, as a batch."""
        if isinstance(address, tuple):
            address = [address]
        draws = [self._draw(epoch, i) for epoch, i in address]
        first, second, order_a, order_b = (torch.stack(column) for column in zip(*draws, strict=True))
        with torch.no_grad():
            return self._assemble(first, second, order_a, order_b)

    def _draw(self, epoch: int, i: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Two meshes, each an (identity, pose) or a place in the pool, and two vertex orders."""
        what = _generator(self.seed, epoch if self.resample else 0, i)
        if self.listed is not None:
            first, second = self.listed[i].split(2) if self.pool is None else torch.tensor([[2 * i], [2 * i + 1]])
        elif self.pool is None:
            who = self.identities[torch.randint(len(self.identities), (2,), generator=what)]
            how = self.poses[torch.randint(len(self.poses), (2,), generator=what)]
            first, second = torch.stack([who, how], 1)
        else:
            first, second = torch.randperm(len(self.pool), generator=what)[:2, None]
        num = len(self.model.template)
        if not self.shuffle:
            return first, second, torch.arange(num), torch.arange(num)
        order = _generator(self.seed + 1, epoch, i)
        return first, second, torch.randperm(num, generator=order), torch.randperm(num, generator=order)

    def _assemble(self, first: Tensor, second: Tensor, order_a: Tensor, order_b: Tensor) -> PairBatch:
        descriptors: dict[str, Any] = {}
        if self.pool is None:
            (who_a, how_a), (who_b, how_b) = first.unbind(1), second.unbind(1)
            meshes = self.model(torch.cat([who_a, who_b, who_a]), torch.cat([how_a, how_b, how_b]))
            mesh_a, mesh_b, truth = meshes.chunk(3)
        else:
            a, b = first[:, 0], second[:, 0]
            who_a, how_b = self.pool.identity[a], self.pool.pose[b]
            mesh_a, mesh_b, truth = self.pool.verts[a], self.pool.verts[b], self.model(who_a, how_b)
            descriptors = {
                "identity_descriptors": gather_vertices(self.pool.descriptors[a], order_a),
                "pose_descriptors": gather_vertices(self.pool.descriptors[b], order_b),
            }
        rank_a, rank_b = order_a.argsort(1), order_b.argsort(1)
        return PairBatch(
            identity=center(gather_vertices(mesh_a, order_a)),
            identity_faces=rank_a[:, self.model.faces],
            pose=center(gather_vertices(mesh_b, order_b)),
            pose_faces=rank_b[:, self.model.faces],
            ground_truth=center(gather_vertices(truth, order_a)),
            correspondence=rank_b.gather(1, order_a),
            identity_index=who_a,
            pose_index=how_b,
            **descriptors,
        )


class PairSampler(Sampler[list[tuple[int, int]]]):
    """Batches of ``(epoch, i)`` addresses by training step: step ``s`` has the same batch whenever it is reached.

    Every epoch visits each pair once, in an order drawn from the seed and the epoch; a last incomplete batch is
    dropped. Starting at step ``s`` is how a run resumes.

    Args:
        length: pairs per epoch.
        batch_size: pairs per step.
        start: first step.
        stop: step to stop before.
        seed: of the orders.
        rank: of this process; processes take disjoint parts of each epoch.
        world_size: number of processes.

    Raises:
        ValueError: an epoch holds less than one batch per process, or the sizes make no sense.
    """

    def __init__(
        self,
        length: int,
        batch_size: int,
        *,
        start: int = 0,
        stop: int,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if batch_size < 1 or not 0 <= rank < world_size:
            raise ValueError(f"need a batch and 0 <= rank < world_size, got {batch_size}, {rank} and {world_size}")
        self.steps_per_epoch = length // (batch_size * world_size)
        if self.steps_per_epoch < 1:
            raise ValueError(
                f"an epoch of {length} pairs is less than one batch of {batch_size} for each of {world_size} processes"
            )
        self.length, self.batch_size, self.start, self.stop = length, batch_size, start, stop
        self.seed, self.rank, self.world_size = seed, rank, world_size

    def __len__(self) -> int:
        return max(0, self.stop - self.start)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        current, order = -1, torch.empty(0)
        for step in range(self.start, self.stop):
            epoch, place = divmod(step, self.steps_per_epoch)
            if epoch != current:
                current, order = epoch, torch.randperm(self.length, generator=_generator(self.seed + 2, epoch, 0))
            begin = (place * self.world_size + self.rank) * self.batch_size
            yield [(epoch, int(i)) for i in order[begin : begin + self.batch_size]]


def pair_loader(dataset: PosePairs, sampler: PairSampler, *, workers: int = 0) -> DataLoader[PairBatch]:
    """A loader that yields one :class:`PairBatch` per step; the same batches for any number of workers."""
    return DataLoader(dataset, batch_size=None, sampler=sampler, num_workers=workers, persistent_workers=workers > 0)


def _generator(seed: int, epoch: int, i: int) -> torch.Generator:
    """An independent stream for each address."""
    mixed = (seed * 0x9E3779B97F4A7C15 + epoch * 0xBF58476D1CE4E5B9 + i * 0x94D049BB133111EB) % (1 << 63)
    mixed ^= mixed >> 31
    return torch.Generator().manual_seed(mixed % (1 << 63))
