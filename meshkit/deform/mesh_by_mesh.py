"""The meshes of a batch deformed one after the other on the CPU."""

from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.face_edges import EnergyOfMeshes
from meshkit.deform.factor import ARAPFactor
from meshkit.deform.lbfgs import minimise
from meshkit.deform.mesh_objective import MeshObjective
from meshkit.deform.minimum import minimum
from meshkit.deform.options import ARAPInfo, Options
from meshkit.deform.problem import Problem
from meshkit.deform.rest import ARAPRest
from meshkit.deform.topology import ARAPTopology

__all__ = ["MeshByMesh"]

_CPU = torch.device("cpu")


class MeshByMesh(Problem):
    """The meshes of a batch without padding, in float64 on the CPU; says what is wrong with their values.

    Positions and handles are lists with a tensor for each mesh; handles are indices of its real vertices, and come with
    which of the given ones (B, H) they are.

    Attributes:
        real: per mesh, the indices of its real vertices.
        verts: per mesh, the (n, 3) rest positions; differentiable.
        rests: per mesh, the operators of its rest shape.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor | None, energy: str, degenerate: str) -> None:
        super().__init__(verts, faces, mask)
        everything = torch.ones(self.batch, self.size, dtype=torch.bool, device=_CPU)
        rows = everything if mask is None else mask.cpu().view(self.batch, self.size)
        self.real = [row.nonzero().squeeze(1) for row in rows]
        # index of every vertex among the real ones of its mesh, -1 at padding
        self.place = torch.full((self.batch, self.size), -1, dtype=torch.int64, device=_CPU)
        for place, real in zip(self.place, self.real, strict=True):
            place[real] = torch.arange(len(real), device=_CPU)
        self.verts = self.positions(verts, "verts")
        given = faces.detach().cpu().long().expand(self.batch, -1, 3)
        own = self._renumbered([row[row[:, 0] >= 0] for row in given], "faces use a vertex")
        self.rests = [
            ARAPRest(ARAPTopology.cached(f, len(v), energy=energy), v, degenerate=degenerate)
            for f, v in zip(own, self.verts, strict=True)
        ]

    def _renumbered(self, vertices: list[Tensor], what: str) -> list[Tensor]:
        """Indices of vertices among the real ones."""
        own = [place[index] for place, index in zip(self.place, vertices, strict=True)]
        padded = sum(int((index < 0).view(len(index), -1).any(1).sum()) for index in own if len(index))
        if padded:
            raise ValueError(f"{padded} {what} that mask declares padding")
        return own

    def positions(self, values: Tensor, name: str) -> list[Tensor]:
        """Positions (n, 3) of the real vertices of each mesh."""
        return self._finite(self.rows(values, name), self.real, f"{name} holds NaN or infinity at a real vertex")

    def weights(self, values: Tensor, name: str) -> list[Tensor]:
        """Weights (n,) of the real vertices of each mesh."""
        message = f"{name} holds NaN or infinity at a real vertex"
        rows = self._finite(self.weight_rows(values, name), self.real, message)
        negative = sum(int((row < 0).sum()) for row in rows)
        if negative:
            raise ValueError(f"{negative} {name} are negative; use 0 where there is no target")
        return rows

    @staticmethod
    def _finite(values: Tensor, chosen: list[Tensor], message: str) -> list[Tensor]:
        own = [row.index_select(0, index) for row, index in zip(values.cpu().double().unbind(0), chosen, strict=True)]
        if not all(bool(torch.isfinite(row).all()) for row in own):
            raise ValueError(message)
        return own

    def handles(self, handles: Tensor) -> tuple[list[Tensor], Tensor]:
        """Handles of each mesh, and which of the given (B, H) they are."""
        given = self.handle_rows(handles).cpu()
        if given.numel() and (int(given.max()) >= self.size or int(given.min()) < -1):
            raise ValueError(
                f"handles must lie in [0, {self.size}) (or be -1 padding), "
                f"got a range of [{int(given.min())}, {int(given.max())}]"
            )
        used = given >= 0
        taken = [row[own] for row, own in zip(given, used, strict=True)]
        return self._renumbered(taken, "handles are vertices"), used

    def random_handles(self, fraction: float, generator: torch.Generator | None) -> tuple[list[Tensor], None]:
        """Random handles of each mesh."""
        sizes = [len(real) for real in self.real]
        device = "cpu" if generator is None else generator.device
        scores = torch.rand(sum(sizes), generator=generator, device=device, dtype=torch.float64).cpu()
        chosen = []
        for rest, size, score in zip(self.rests, sizes, scores.split(sizes), strict=True):
            best = score.new_zeros(int(rest.components.max()) + 1).scatter_reduce(0, rest.components, score, "amax")
            forced = score == best[rest.components]
            quota = max(round(fraction * size), int(forced.sum()))
            chosen.append(torch.topk(score + forced, quota).indices)
        return chosen, None

    def goal(self, handles: tuple[list[Tensor], Tensor], handle_pos: Tensor) -> list[Tensor]:
        """Positions (h, 3) of the handles of each mesh."""
        given = self.target_rows(handle_pos, handles[1].shape[1])
        used = [row.nonzero().squeeze(1) for row in handles[1]]
        return self._finite(given, used, "handle_pos holds NaN or infinity")

    def goal_at(self, handles: tuple[list[Tensor], Any], positions: list[Tensor]) -> list[Tensor]:
        """Positions (h, 3) of the handles of each mesh."""
        return [row[own] for row, own in zip(positions, handles[0], strict=True)]

    def deform(
        self,
        handles: tuple[list[Tensor], Any],
        goal: list[Tensor],
        options: Options,
        soft_targets: list[Tensor] | None,
        soft_weights: list[Tensor] | None,
        start: list[Tensor] | None,
    ) -> tuple[Tensor, ARAPInfo]:
        """Deform one mesh after the other."""
        bare = sum(not len(own) for own in handles[0])
        if bare and soft_weights is None:
            raise ValueError(f"{bare} of {self.batch} meshes have no handle; give each at least one, or soft targets")
        negative = torch.zeros(self.batch, dtype=torch.bool, device=_CPU)
        results, infos = [], []
        with torch.set_grad_enabled(torch.is_grad_enabled() and options.grad != "none"):
            for b in range(self.batch):
                soft = [None if values is None else values[b] for values in (soft_targets, soft_weights, start)]
                moved, info = self._deform_one(b, handles[0][b], goal[b], options, soft, negative[b])
                results.append(moved.new_zeros(self.size, 3).index_copy(0, self.real[b], moved))
                infos.append(info)
            deformed = torch.stack(results).view(self.shape).to(self.device, self.dtype)
        joined = {field.name: torch.stack([getattr(info, field.name) for info in infos]) for field in fields(ARAPInfo)}
        # The backward pass writes into this one.
        return deformed, self.report(ARAPInfo(**joined | {"negative_curvature": negative}))

    def _deform_one(
        self,
        b: int,
        handles: Tensor,
        targets: Tensor,
        options: Options,
        soft: list[Tensor | None],
        negative: Tensor,
    ) -> tuple[Tensor, ARAPInfo]:
        """Positions (n, 3) of one mesh, given its soft targets, soft weights and start; and its report ()."""
        rest, (soft_targets, soft_weights, start) = self.rests[b], soft
        factor = ARAPFactor(rest, handles, soft_weights=soft_weights, solver=options.solver)
        if not len(factor.free):
            options = replace(options, method="local_global", max_iter=0)
        wanted = torch.promote_types(self.dtype, torch.float32)
        dtype = wanted if options.method == "local_global" else torch.float32
        soft_targets, start = (None if values is None else values - rest.origin for values in (soft_targets, start))
        pull = soft_targets if soft_targets is None or options.unroll else soft_targets.detach()
        objective = MeshObjective(factor, pull, dtype=dtype, compiled=options.compiled)
        if start is None:
            objective.start_from_rest()
        limits: dict[str, Any] = {"max_iter": options.max_iter, "tol": options.tol}
        x, info = minimum(
            objective,
            partial(minimise, objective, refine=wanted == torch.float64, **limits),
            options,
            verts=self.verts[b],
            goal=torch.zeros_like(rest.verts).index_copy(0, handles, targets - rest.origin),
            soft_targets=soft_targets,
            soft_weights=soft_weights,
            start=start,
            negative=negative,
        )
        return (x + rest.origin).index_copy(0, handles, targets), info

    def energies(self, deformed: Tensor) -> Tensor:
        """Energies (B,) of deformed positions."""
        values = []
        for rest, v, x in zip(self.rests, self.verts, self.positions(deformed, "deformed"), strict=True):
            rotations = rest.rotations((x - rest.origin).detach()).permute(2, 1, 0).contiguous()
            values.append(EnergyOfMeshes.apply(v, x, rest.edges, rotations, 1))
        return torch.cat(values)
