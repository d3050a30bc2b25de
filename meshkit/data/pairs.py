"""Pairs of posed bodies with ground truth, generated on the fly."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from meshkit.batching import center
from meshkit.data.batch import PairBatch
from meshkit.data.pool import MeshPool
from meshkit.data.rigged import RiggedModel
from meshkit.data.sampler import addresses_of, seeded
from meshkit.neighbors import gather_vertices

__all__ = ["PosePairs"]


class PosePairs(Dataset[PairBatch]):
    """Random pairs of posed bodies, generated on the fly and reproducible.

    An item is addressed by ``(epoch, i)`` and depends on nothing else: not on the worker, the batch it falls into, or
    what was read before. Indexing with a list of such addresses evaluates the whole batch at once.

    :meth:`to` moves body and pool to a GPU, and batches are then made there. Random numbers are drawn on the CPU all
    the same, so a batch is the same on every device, up to the rounding of coordinates.

    Each mesh is centred by its bounding box. Identity and pose meshes get independent random vertex orders; faces are
    re-indexed to match, and the ground truth follows the identity's order.

    Args:
        model: body with tables of identities and poses.
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
        ground_truth: evaluate the ground truth. Unsupervised training does without, and saves a third of the work, or
            with a pool most of it; ``PairBatch.ground_truth`` is then empty.
        pose_noise: standard deviation of normal noise on the vertices of the pose mesh, in the unit of the model,
            added before centring; the paper's test of robustness. The ground truth stays clean.

    Raises:
        ValueError: an empty list, a length below 1, indices beyond the model's tables, a model without tables,
            negative noise, noise with a pool, whose descriptors are of clean meshes, or a pool of other meshes than
            those listed.
        TypeError: indexed with anything but addresses.

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
        ground_truth: bool = True,
        pose_noise: float = 0.0,
    ) -> None:
        if len(identities) == 0 or len(poses) == 0 or not length >= 1:
            raise ValueError(
                f"need identities, poses and a positive length, got {len(identities)}, {len(poses)} and {length}"
            )
        if listed is not None and (listed.dim() != 2 or listed.shape[1] != 4 or len(listed) == 0):
            raise ValueError(f"listed must be a pair or more (L, 4), got {tuple(listed.shape)}")
        for name, rows in (("identities", identities), ("poses", poses), ("listed", listed)):
            if rows is not None and (rows.is_floating_point() or rows.dtype == torch.bool):
                raise ValueError(f"{name} must be whole numbers, rows of the model's tables, got {rows.dtype}")
        if model.identities is None or model.poses is None:
            raise ValueError("the model has no tables of identities and poses to draw from: give it both")
        # Checked here, once: the tables are then indexed without asking the device for the smallest and largest index.
        listed_who, listed_how = (identities, poses) if listed is None else (listed[:, ::2], listed[:, 1::2])
        for name, table, used in (
            ("identities", model.identities, (identities, listed_who)),
            ("poses", model.poses, (poses, listed_how)),
        ):
            low, high = min(int(x.min()) for x in used), max(int(x.max()) for x in used)
            if not 0 <= low <= high < len(table):
                raise ValueError(f"{name} must be in [0, {len(table)}), got {low} to {high}")
        if not pose_noise >= 0 or (pose_noise > 0 and pool is not None):
            raise ValueError(
                f"pose_noise must be >= 0, and 0 with a pool, whose descriptors are of clean meshes; got {pose_noise}"
            )
        if listed is not None and pool is not None:
            wanted, held = listed.cpu().reshape(-1, 2), torch.stack([pool.identity, pool.pose], 1).cpu()
            if wanted.shape != held.shape or bool((wanted != held).any()):
                raise ValueError(
                    f"the pool must hold the {len(wanted)} listed meshes in their order, those of listed.view(-1, 2); "
                    f"its {len(held)} are others"
                )
        self.model, self.pool = model, pool
        self.identities, self.poses = identities.cpu(), poses.cpu()
        self.length = length if listed is None else len(listed)
        self.listed = None if listed is None else listed.cpu()
        self.seed, self.resample, self.shuffle = seed, resample, shuffle
        self.ground_truth, self.pose_noise = ground_truth, pose_noise

    @property
    def device(self) -> torch.device:
        """Where batches are made."""
        return self.model.template.device

    def to(self, device: torch.device | str) -> PosePairs:
        """The same pairs, made on another device; this object and its model stay as they are."""
        moved = copy.copy(self)
        moved.model = copy.deepcopy(self.model).to(device)
        moved.pool = None if self.pool is None else self.pool.to(device)
        return moved

    def __len__(self) -> int:
        return self.length

    @torch.no_grad()
    def __getitem__(self, address: tuple[int, int] | Sequence[tuple[int, int]]) -> PairBatch:
        """The pairs at one or several ``(epoch, i)``, as a batch."""
        addresses = addresses_of(address)
        meshes, orders, noise = self._draw(addresses)
        return self._assemble(
            meshes.to(self.device, non_blocking=True),
            orders.to(self.device, non_blocking=True),
            None if noise is None else noise.to(self.device, non_blocking=True),
        )

    def _draw(self, addresses: Sequence[tuple[int, int]]) -> tuple[Tensor, Tensor, Tensor | None]:
        """Two meshes ``(2, B, 1 or 2)``, places in the pool or (identity, pose); vertex orders ``(2, B, N)``; noise."""
        batch, num, dice = len(addresses), len(self.model.template), torch.Generator()
        meshes = torch.empty(2, batch, 2 if self.pool is None else 1, dtype=torch.int64, device="cpu")
        orders = torch.arange(num, device="cpu").repeat(2, batch, 1)
        noise = torch.empty(batch, num, 3, device="cpu") if self.pose_noise > 0 else None
        for b, (epoch, i) in enumerate(addresses):
            if self.listed is None:
                self._pick(meshes[:, b], seeded(dice, self.seed, epoch if self.resample else 0, i))
            elif self.pool is None:
                meshes[:, b] = self.listed[i].view(2, 2)
            else:
                meshes[0, b, 0], meshes[1, b, 0] = 2 * i, 2 * i + 1
            if self.shuffle:
                seeded(dice, self.seed + 1, epoch, i)
                torch.randperm(num, generator=dice, out=orders[0, b], device="cpu")
                torch.randperm(num, generator=dice, out=orders[1, b], device="cpu")
            if noise is not None:
                noise[b].normal_(generator=seeded(dice, self.seed + 3, epoch, i))
        return meshes, orders, noise

    def _pick(self, meshes: Tensor, dice: torch.Generator) -> None:
        if self.pool is None:
            meshes[:, 0] = self.identities[torch.randint(len(self.identities), (2,), generator=dice, device="cpu")]
            meshes[:, 1] = self.poses[torch.randint(len(self.poses), (2,), generator=dice, device="cpu")]
        else:  # two different meshes: the second is drawn from the others
            a = int(torch.randint(len(self.pool), (), generator=dice, device="cpu"))
            b = int(torch.randint(len(self.pool) - 1, (), generator=dice, device="cpu"))
            meshes[0, 0], meshes[1, 0] = a, b + (b >= a)

    def _assemble(self, meshes: Tensor, orders: Tensor, noise: Tensor | None) -> PairBatch:
        descriptors: dict[str, Any] = {}
        order_a, order_b = orders
        truth: Tensor | None = None
        if self.pool is None:
            (who_a, how_a), (who_b, how_b) = meshes[0].unbind(1), meshes[1].unbind(1)
            if self.ground_truth:
                body = self._body(torch.cat([who_a, who_b, who_a]), torch.cat([how_a, how_b, how_b]))
                mesh_a, mesh_b, truth = body.chunk(3)
            else:
                mesh_a, mesh_b = self._body(torch.cat([who_a, who_b]), torch.cat([how_a, how_b])).chunk(2)
        else:
            a, b = meshes[..., 0]
            who_a, how_b = self.pool.identity[a], self.pool.pose[b]
            mesh_a, mesh_b = self.pool.verts[a], self.pool.verts[b]
            truth = self._body(who_a, how_b) if self.ground_truth else None
            descriptors = {
                "identity_descriptors": gather_vertices(self.pool.descriptors[a], order_a),
                "pose_descriptors": gather_vertices(self.pool.descriptors[b], order_b),
            }
        if noise is not None:
            mesh_b = mesh_b + self.pose_noise * noise.to(mesh_b.dtype)
        places = torch.arange(orders.shape[2], device=orders.device).expand_as(orders)
        rank_a, rank_b = torch.empty_like(orders).scatter_(2, orders, places)  # where each vertex went
        corners = self.model.faces.flatten().expand(len(order_a), -1)
        return PairBatch(
            identity=center(gather_vertices(mesh_a, order_a)),
            identity_faces=rank_a.gather(1, corners).unflatten(1, (-1, 3)),
            pose=center(gather_vertices(mesh_b, order_b)),
            pose_faces=rank_b.gather(1, corners).unflatten(1, (-1, 3)),
            ground_truth=mesh_a[:, :0] if truth is None else center(gather_vertices(truth, order_a)),
            correspondence=rank_b.gather(1, order_a),
            identity_index=who_a,
            pose_index=how_b,
            **descriptors,
        )

    def _body(self, identity: Tensor, pose: Tensor) -> Tensor:
        assert self.model.identities is not None and self.model.poses is not None
        return self.model(self.model.identities[identity], self.model.poses[pose])
