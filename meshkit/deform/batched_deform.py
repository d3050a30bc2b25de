"""Deformation of a whole batch at once on the device of its tensors, from input to report."""

from typing import Any

import torch
from torch import Tensor

from meshkit.deform.batched import BatchedEnergy
from meshkit.deform.batched_factor import BatchedFactor
from meshkit.deform.batched_implicit import BatchedImplicit
from meshkit.deform.batched_objective import BatchedObjective, BatchedOutcome, alternate_batch, minimise_batch
from meshkit.deform.options import ARAPInfo, Options
from meshkit.topology import check_faces

__all__ = ["BatchedProblem"]


class BatchedProblem:
    """The meshes of a batch, with cheap tests of the input instead of messages.

    A caller whose input fails a test goes on to the path that takes meshes one by one, which says what is wrong with
    them, or copes. All tests are read from the device at once, in `deform`.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor | None, energy: str, degenerate: str) -> None:
        self.shape, self.dtype, self.device = verts.shape, verts.dtype, verts.device
        self.batch, self.size = (1 if verts.dim() == 2 else len(verts)), verts.shape[-2]
        self.masked = mask is not None
        everything = torch.ones(self.batch, self.size, dtype=torch.bool, device=self.device)
        self.mask = everything if mask is None else mask.view(self.batch, -1)
        faces = faces.detach().to(self.device).long().expand(self.batch, -1, 3)
        self.verts = verts.view(self.batch, self.size, 3)
        self.energy = BatchedEnergy(self.verts, faces, self.mask, energy)
        used = faces[..., 0] >= 0
        corners_real = self.mask.flatten()[self.energy.corners].all(-1)
        self.bad = [~torch.isfinite(self.verts).all(-1) & self.mask, used & ~corners_real]
        if degenerate == "raise":
            self.bad.append(used & ~self.energy.regular)

    @staticmethod
    def possible(verts: Tensor, faces: Any, mask: Tensor | None) -> bool:
        """Whether shapes and types are right, so that nothing but the values is left to test."""
        if verts.dim() not in (2, 3) or verts.shape[-1] != 3 or not verts.is_floating_point() or not verts.numel():
            return False
        if mask is not None and (mask.dtype != torch.bool or mask.shape != verts.shape[:-1]):
            return False
        check_faces(faces, verts.shape[-2], batched=verts.dim() == 3)
        return faces.dim() == 2 or len(faces) == len(verts)

    def positions(self, values: Tensor) -> Tensor:
        """Positions (B, V, 3) of the shape of the rest positions, in float64 about the origins; 0 at padding."""
        values = values.to(self.device).double().view(self.batch, self.size, 3)
        self.bad.append(~torch.isfinite(values).all(-1) & self.mask)
        return torch.where(self.mask[..., None], values - self.energy.origin, 0.0)

    def refused(self) -> bool:
        """Whether any test failed so far; waits for the device."""
        return bool(torch.cat([flags.flatten() for flags in self.bad]).any())

    def handles(self, handles: Tensor) -> tuple[Tensor, Tensor] | None:
        """Which vertices (B, V) are handles, and indices (B, H) with V for what is none; None for a wrong shape."""
        dims = (1, 2) if len(self.shape) == 3 else (1,)
        if handles.is_floating_point() or handles.dtype == torch.bool or handles.dim() not in dims:
            return None
        if handles.dim() == 2 and len(handles) != self.batch:
            return None
        index = handles.detach().to(self.device).long().expand(self.batch, -1)
        outside = (index < -1) | (index >= self.size)
        index = torch.where((index < 0) | outside, self.size, index)
        count = torch.zeros(self.batch, self.size + 1, dtype=torch.int64, device=self.device)
        count = count.scatter_add(1, index, torch.ones_like(index))[:, :-1]
        fixed = count > 0
        self.bad += [outside, count > 1, fixed & ~self.mask]
        return fixed, index

    def goal(self, fixed: Tensor, index: Tensor, handle_pos: Tensor) -> Tensor | None:
        """Positions (B, V, 3) of the handles about the origins, 0 elsewhere; None for a wrong shape."""
        wanted = (index.shape[1], 3)
        if handle_pos.shape not in (wanted, (*self.shape[:-2], *wanted)):
            return None
        positions = handle_pos.to(self.device).double().expand(self.batch, *wanted)
        self.bad.append(~torch.isfinite(positions).all(-1) & (index < self.size))
        goal = positions.new_zeros(self.batch, self.size + 1, 3)
        goal = goal.scatter(1, index[..., None].expand_as(positions), positions)[:, :-1]
        return torch.where(fixed[..., None], goal - self.energy.origin, 0.0)

    def random_handles(self, fraction: float, generator: torch.Generator | None) -> Tensor:
        """Random handles (B, V): a share of the vertices of each mesh, at least one in every component."""
        device = "cpu" if generator is None else generator.device
        total = int(self.mask.sum()) if self.masked else self.mask.numel()
        drawn = torch.rand(total, generator=generator, device=device, dtype=torch.float64).to(self.device)
        if self.masked:
            scores = torch.full(self.mask.shape, -1.0, dtype=torch.float64, device=self.device)
            scores[self.mask] = drawn
        else:
            scores = drawn.view(self.mask.shape)
        label = self.energy.components
        best = torch.full_like(scores, -1.0).flatten().scatter_reduce(0, label, scores.flatten(), "amax")
        forced = (scores == best[label].view_as(scores)) & self.mask
        share = torch.round(fraction * self.mask.sum(1).double()).long()
        quota = torch.maximum(share, forced.sum(1))
        rank = torch.argsort(torch.argsort(scores + forced.double(), dim=1, descending=True), dim=1)
        return (rank < quota[:, None]) & self.mask

    def deform(
        self,
        fixed: Tensor,
        goal: Tensor,
        options: Options,
        *,
        soft_targets: Tensor | None = None,
        soft_weights: Tensor | None = None,
        start: Tensor | None = None,
        held: bool = False,
    ) -> tuple[Tensor, ARAPInfo] | None:
        """Deform, or return None if a test of the input failed.

        Args:
            fixed: (B, V) bool.
            goal: (B, V, 3) positions of the fixed vertices about the origins, 0 elsewhere; differentiable.
            options: the choices.
            soft_targets: (B, V, 3) about the origins; differentiable.
            soft_weights: (B, V); differentiable.
            start: (B, V, 3) about the origins.
            held: whether every component is known to have a fixed vertex.
        """
        energy = self.energy
        soft = None
        if soft_weights is not None:
            soft = torch.where(self.mask, soft_weights.detach(), 0.0) / energy.multiplicity
            self.bad.append(self.mask & ~(torch.isfinite(soft_weights) & (soft_weights >= 0)))
        if not held:
            self.bad.append(self._loose(fixed if soft is None else fixed | (soft > 0)))
        if self.refused():
            return None
        with torch.set_grad_enabled(torch.is_grad_enabled() and options.grad != "none"):
            factor = BatchedFactor(energy, self.mask & ~fixed, soft, options.solver)
            flat = [None if value is None else value.reshape(-1, 3) for value in (goal, soft_targets, start)]
            moved, outcome = self._solve(factor, flat[0], flat[1], flat[2], soft_weights, options)
        moved = torch.where(self.mask[..., None], moved.view(goal.shape) + energy.origin, 0.0)
        fields = (
            outcome.energy * energy.multiplicity,
            outcome.evaluations * factor.free.view(self.batch, -1).any(1),
            outcome.residual,
            outcome.converged,
            outcome.negative_curvature,
        )
        info = ARAPInfo(*(field if len(self.shape) == 3 else field[0] for field in fields))
        return moved.view(self.shape).to(self.dtype), info

    def _loose(self, held: Tensor) -> Tensor:
        """Vertices of components that nothing holds."""
        label = self.energy.components
        count = torch.zeros_like(label).index_add_(0, label, held.flatten().long())
        return (count[label] == 0).view_as(held) & self.mask

    def _solve(
        self,
        factor: BatchedFactor,
        goal: Any,
        soft_targets: Tensor | None,
        start: Tensor | None,
        soft_weights: Tensor | None,
        options: Options,
    ) -> tuple[Tensor, BatchedOutcome]:
        unroll = options.grad == "unroll" and torch.is_grad_enabled()
        targets = soft_targets if unroll or soft_targets is None else soft_targets.detach()
        objective = BatchedObjective(factor, targets)
        first = None if start is None else start.detach()
        with torch.set_grad_enabled(unroll):
            if options.method == "local_global":
                limits: dict[str, Any] = {"max_iter": options.max_iter, "tol": options.tol}
                x, count = alternate_batch(objective, goal, first, **limits)
                energy, gradient = objective(x.detach())
                residual = objective.residual(energy, gradient)
                never = torch.zeros_like(count, dtype=torch.bool)
                outcome = BatchedOutcome(x, energy, count, residual, residual <= options.tol, never)
            else:
                if first is None:
                    first, _ = alternate_batch(objective, goal.detach(), None, max_iter=1, tol=0.0)
                first = torch.where(objective.free, first, goal.detach())
                outcome = minimise_batch(objective, first, max_iter=options.max_iter, tol=options.tol)
        moved = outcome.x
        if options.grad == "implicit" and torch.is_grad_enabled():
            negative = outcome.negative_curvature = outcome.negative_curvature.clone()
            args = objective, options.grad_tol, negative, outcome.residual, options.tol
            moved = BatchedImplicit.apply(self.verts.double(), goal, soft_targets, soft_weights, moved.detach(), *args)
        return moved, outcome
