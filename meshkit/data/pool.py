"""A pool of posed meshes with their descriptors, computed once and sampled from during training."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from itertools import repeat

import torch
from torch import Tensor

from meshkit.data._signatures import signatures
from meshkit.data.rigged import RiggedModel

__all__ = ["MeshPool"]


@dataclass(frozen=True)
class MeshPool:
    """Posed meshes of known identity and pose, with per-vertex descriptors of the posed surface.

    Descriptors are computed from the very meshes a network is given, never from a rest shape that a user would not
    have.

    Args:
        identity: ``(P,)`` index of the identity of each mesh.
        pose: ``(P,)`` index of its pose.
        verts: ``(P, V, 3)``.
        descriptors: ``(P, V, D)``.
    """

    identity: Tensor
    pose: Tensor
    verts: Tensor
    descriptors: Tensor

    def __len__(self) -> int:
        return len(self.identity)

    def to(self, device: torch.device | str) -> MeshPool:
        """The pool on another device."""
        return MeshPool(**{name: value.to(device) for name, value in self.state_dict().items()})

    @classmethod
    def build(
        cls,
        model: RiggedModel,
        identities: Tensor,
        poses: Tensor,
        size: int,
        *,
        num_signatures: int = 16,
        num_eigenpairs: int = 64,
        seed: int = 0,
        workers: int = 1,
        progress: bool = False,
    ) -> MeshPool:
        """Draw ``size`` (identity, pose) combinations and compute their intrinsic descriptors, by the fast method.

        Args:
            model: body with tables of identities and poses.
            identities: allowed identity indices.
            poses: allowed pose indices.
            size: number of meshes.
            num_signatures: see :func:`~meshkit.descriptors.intrinsic_descriptors`.
            num_eigenpairs: likewise.
            seed: of the draw.
            workers: processes; the eigensolver uses one core each. With more than one, a script must keep its work
                under ``if __name__ == "__main__"``, as for any spawned process.
            progress: show a progress bar.

        Raises:
            ValueError: ``size`` is smaller than 2, or there is nothing to draw from.
        """
        if size < 2:
            raise ValueError(f"a pool needs at least 2 meshes to make a pair, got {size}")
        if len(identities) == 0 or len(poses) == 0:
            raise ValueError(f"need identities and poses to draw from, got {len(identities)} and {len(poses)}")
        generator = torch.Generator().manual_seed(seed)
        identity = identities[torch.randint(len(identities), (size,), generator=generator, device="cpu")]
        pose = poses[torch.randint(len(poses), (size,), generator=generator, device="cpu")]
        return cls.of(
            model,
            identity,
            pose,
            num_signatures=num_signatures,
            num_eigenpairs=num_eigenpairs,
            workers=workers,
            progress=progress,
        )

    @classmethod
    def of(
        cls,
        model: RiggedModel,
        identity: Tensor,
        pose: Tensor,
        *,
        num_signatures: int = 16,
        num_eigenpairs: int = 64,
        workers: int = 1,
        progress: bool = False,
    ) -> MeshPool:
        """The pool of exactly these (identity, pose) combinations; arguments as in :meth:`build`."""
        from tqdm import tqdm

        with torch.no_grad():
            verts = torch.cat([model(i, p) for i, p in zip(identity.split(64), pose.split(64), strict=True)])
        computed = signatures(
            verts, repeat(model.faces), num_signatures=num_signatures, num_eigenpairs=num_eigenpairs, workers=workers
        )
        descriptors = []
        # An error ends the processes and gives the threads back at once.
        with (
            closing(computed),
            tqdm(total=len(verts), desc="descriptors", unit="mesh", disable=not progress, dynamic_ncols=True) as bar,
        ):
            for result in computed:
                if isinstance(result, ValueError):
                    raise result
                descriptors.append(torch.from_numpy(result))
                bar.update()
        return cls(identity, pose, verts, torch.stack(descriptors))

    def state_dict(self) -> dict[str, Tensor]:
        """The four tensors, to be saved."""
        return {name: getattr(self, name).contiguous() for name in self.__dataclass_fields__}
