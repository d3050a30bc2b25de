"""A whole batch deformed at once on the device of its tensors."""

from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.batched_factor import BatchedFactor
from meshkit.deform.batched_objective import BatchedObjective
from meshkit.deform.batched_rest import BatchedRest
from meshkit.deform.face_edges import EnergyOfMeshes
from meshkit.deform.lbfgs import minimise_batch
from meshkit.deform.minimum import minimum
from meshkit.deform.options import ARAPInfo, Options
from meshkit.deform.problem import Problem

__all__ = ["WholeBatch"]


class WholeBatch(Problem):
    """The meshes of a batch as they are, with cheap tests of the values instead of messages.

    All tests are read from the device at once, in `refused`. Positions are (B, V, 3), float64, about the origins, 0 at
    padding; handles a mask (B, V), with the given indices (B, H) if any, V for what is none.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor | None, energy: str, degenerate: str) -> None:
        super().__init__(verts, faces, mask)
        self.masked = mask is not None
        everything = torch.ones(self.batch, self.size, dtype=torch.bool, device=self.device)
        self.mask = everything if mask is None else mask.to(self.device).contiguous().view(self.batch, -1)
        faces = faces.detach().to(self.device).long().expand(self.batch, -1, 3)
        self.verts = self.rows(verts, "verts")
        self.rest = BatchedRest(self.verts, faces, self.mask, energy)
        used = faces[..., 0].flatten() >= 0
        corners_real = self.mask.flatten()[self.rest.edges.faces].all(-1)
        self.bad = [~torch.isfinite(self.verts).all(-1) & self.mask, used & ~corners_real]
        if degenerate == "raise":
            self.bad.append(used & ~self.rest.edges.regular)

    def refused(self) -> bool:
        """Whether any test failed so far; waits for the device."""
        return bool(torch.cat([flags.flatten() for flags in self.bad]).any())

    def positions(self, values: Tensor, name: str) -> Tensor:
        """Positions about the origins."""
        values = self.rows(values, name).to(self.device).double()
        self.bad.append(~torch.isfinite(values).all(-1) & self.mask)
        return torch.where(self.mask[..., None], values - self.rest.origin, 0.0)

    def weights(self, values: Tensor, name: str) -> Tensor:
        """Weights (B, V)."""
        values = self.weight_rows(values, name).to(self.device).double()
        self.bad.append(self.mask & ~(torch.isfinite(values) & (values >= 0)))
        return values

    def handles(self, handles: Tensor) -> tuple[Tensor, Tensor]:
        """Which vertices are handles, and their indices."""
        index = self.handle_rows(handles).to(self.device)
        outside = (index < -1) | (index >= self.size)
        index = torch.where((index < 0) | outside, self.size, index)
        count = torch.zeros(self.batch, self.size + 1, dtype=torch.int64, device=self.device)
        count = count.scatter_add(1, index, torch.ones_like(index))[:, :-1]
        fixed = count > 0
        self.bad += [outside, count > 1, fixed & ~self.mask]
        return fixed, index

    def random_handles(self, fraction: float, generator: torch.Generator | None) -> tuple[Tensor, None]:
        """Which vertices are random handles: those that `MeshByMesh` would draw."""
        device = "cpu" if generator is None else generator.device
        total = int(self.mask.sum()) if self.masked else self.mask.numel()
        drawn = torch.rand(total, generator=generator, device=device, dtype=torch.float64).to(self.device)
        if self.masked:
            scores = torch.full(self.mask.shape, -1.0, dtype=torch.float64, device=self.device)
            scores[self.mask] = drawn
        else:
            scores = drawn.view(self.mask.shape)
        label = self.rest.components
        best = torch.full_like(scores, -1.0).flatten().scatter_reduce(0, label, scores.flatten(), "amax")
        forced = (scores == best[label].view_as(scores)) & self.mask
        share = torch.round(fraction * self.mask.sum(1).double()).long()
        quota = torch.maximum(share, forced.sum(1))
        rank = torch.argsort(torch.argsort(scores + forced.double(), dim=1, descending=True), dim=1)
        return (rank < quota[:, None]) & self.mask, None

    def goal(self, handles: tuple[Tensor, Tensor], handle_pos: Tensor) -> Tensor:
        """Positions of the handles, 0 elsewhere."""
        fixed, index = handles
        positions = self.target_rows(handle_pos, index.shape[1]).to(self.device).double()
        self.bad.append(~torch.isfinite(positions).all(-1) & (index < self.size))
        goal = positions.new_zeros(self.batch, self.size + 1, 3)
        goal = goal.scatter(1, index[..., None].expand_as(positions), positions)[:, :-1]
        return torch.where(fixed[..., None], goal - self.rest.origin, 0.0)

    def goal_at(self, handles: tuple[Tensor, Any], positions: Tensor) -> Tensor:
        """Positions of the handles, 0 elsewhere."""
        return torch.where(handles[0][..., None], positions, 0.0)

    def deform(
        self,
        handles: tuple[Tensor, Any],
        goal: Tensor,
        options: Options,
        soft_targets: Tensor | None,
        soft_weights: Tensor | None,
        start: Tensor | None,
    ) -> tuple[Tensor, ARAPInfo] | None:
        """Deform, or return None if a test of the input failed."""
        rest, fixed = self.rest, handles[0]
        soft = None
        if soft_weights is not None:
            soft = torch.where(self.mask, soft_weights.detach(), 0.0) / rest.multiplicity
        self.bad.append(self._loose(fixed if soft is None else fixed | (soft > 0)))
        if self.refused():
            return None
        limits: dict[str, Any] = {"max_iter": options.max_iter, "tol": options.tol}
        with torch.set_grad_enabled(torch.is_grad_enabled() and options.grad != "none"):
            factor = BatchedFactor(rest, self.mask & ~fixed, soft, options.solver)
            targets = None if soft_targets is None else soft_targets.flatten(0, 1)
            pull = targets if targets is None or options.unroll else targets.detach()
            objective = BatchedObjective(factor, pull)
            x, info = minimum(
                objective,
                partial(minimise_batch, objective, **limits),
                options,
                verts=self.verts.double().flatten(0, 1),
                goal=goal.flatten(0, 1),
                soft_targets=targets,
                soft_weights=None if soft_weights is None else soft_weights.flatten(),
                start=None if start is None else start.flatten(0, 1),
                negative=torch.zeros(self.batch, dtype=torch.bool, device=self.device),
            )
            moved = torch.where(self.mask[..., None], x.view(goal.shape) + rest.origin, 0.0)
        some = factor.free.view(self.batch, -1).any(1)
        info = replace(info, evaluations=info.evaluations * some)
        return moved.view(self.shape).to(self.dtype), self.report(info)

    def _loose(self, held: Tensor) -> Tensor:
        """Vertices of components that nothing holds."""
        label = self.rest.components
        count = torch.zeros_like(label).index_add_(0, label, held.flatten().long())
        return (count[label] == 0).view_as(held) & self.mask

    def energies(self, deformed: Tensor) -> Tensor | None:
        """Energies (B,) of deformed positions, or None if a test of the input failed."""
        x = self.positions(deformed, "deformed")
        if self.refused():
            return None
        verts = torch.where(self.mask[..., None], self.verts.double() - self.rest.origin, 0.0).flatten(0, 1)
        rotations = self.rest.rotations(x.detach().flatten(0, 1)).permute(2, 1, 0).contiguous()
        energies: Tensor = EnergyOfMeshes.apply(verts, x.flatten(0, 1), self.rest.edges, rotations, self.batch)
        return energies
