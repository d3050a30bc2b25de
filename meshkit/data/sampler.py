"""The order of training pairs, by step, and the loader that follows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from meshkit._checks import check_whole
from meshkit.data.batch import PairBatch

__all__ = ["PairSampler", "pair_loader"]


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
        shuffle: ``False`` visits the pairs of an epoch in sequence, for pairs that are drawn at random anyway and
            streamed (:class:`~meshkit.data.MeshPairs` with a window).

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
        shuffle: bool = True,
    ) -> None:
        check_whole(length, "length", least=0)
        check_whole(batch_size, "batch_size")
        check_whole(world_size, "world_size")
        for name, step in (("start", start), ("stop", stop)):
            check_whole(step, name, least=0)
        if not 0 <= rank < world_size:
            raise ValueError(f"rank must be in [0, world_size), got {rank} of {world_size}")
        self.steps_per_epoch = length // (batch_size * world_size)
        if self.steps_per_epoch < 1:
            raise ValueError(
                f"an epoch of {length} pairs is less than one batch of {batch_size} for each of {world_size} processes"
            )
        self.length, self.batch_size, self.start, self.stop = length, batch_size, start, stop
        self.seed, self.rank, self.world_size, self.shuffle = seed, rank, world_size, shuffle

    def __len__(self) -> int:
        return max(0, self.stop - self.start)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        current, order = -1, torch.arange(self.length, device="cpu")
        for step in range(self.start, self.stop):
            epoch, place = divmod(step, self.steps_per_epoch)
            if self.shuffle and epoch != current:
                dice = seeded(torch.Generator(), self.seed + 2, epoch, 0)
                current, order = epoch, torch.randperm(self.length, generator=dice, device="cpu")
            begin = (place * self.world_size + self.rank) * self.batch_size
            yield [(epoch, int(i)) for i in order[begin : begin + self.batch_size]]


def pair_loader(
    dataset: Dataset[PairBatch], sampler: PairSampler, *, workers: int = 0, pin_memory: bool = False
) -> DataLoader[PairBatch]:
    """A loader that yields one :class:`PairBatch` per step; the same batches for any number of workers.

    Args:
        dataset: pairs, addressed by ``(epoch, i)``.
        sampler: the addresses of each step.
        workers: processes that prepare batches ahead. 0 prepares them here, when asked.
        pin_memory: hand batches over in page-locked memory, for copies to a GPU that nothing waits for.

    Raises:
        ValueError: workers for pairs that were moved to another device; they are made there without.
    """
    device = torch.device(getattr(dataset, "device", "cpu"))
    if workers > 0 and device.type != "cpu":
        raise ValueError(f"pairs on {device} are made by this process: use workers=0, got {workers}")
    return DataLoader(
        dataset,
        batch_size=None,
        sampler=sampler,
        num_workers=workers,
        persistent_workers=workers > 0,
        pin_memory=pin_memory,
    )


def addresses_of(key: Any) -> Sequence[tuple[int, int]]:
    """The one or several ``(epoch, i)`` that pairs are indexed with.

    Raises:
        TypeError: anything else, as from a loader that counts samples.
    """
    addresses = [key] if isinstance(key, tuple) else key
    if isinstance(addresses, list) and addresses and all(map(_is_address, addresses)):
        return addresses
    raise TypeError(
        f"address pairs by (epoch, i), or a list of these, got {key!r}; "
        "for batches use pair_loader(pairs, PairSampler(...))"
    )


def _is_address(entry: Any) -> bool:
    return isinstance(entry, tuple | list) and len(entry) == 2 and all(hasattr(part, "__index__") for part in entry)


def seeded(generator: torch.Generator, seed: int, epoch: int, i: int) -> torch.Generator:
    """Set a generator to the independent stream of an address; one generator serves a whole batch."""
    mixed = (seed * 0x9E3779B97F4A7C15 + epoch * 0xBF58476D1CE4E5B9 + i * 0x94D049BB133111EB) % (1 << 63)
    mixed ^= mixed >> 31
    return generator.manual_seed(mixed % (1 << 63))
