"""Minimisation for a whole batch on one device: local-global iterations, and L-BFGS.

Each mesh has its own step, history and end; what they decide is a mask over the batch, so that the host waits for the
device only every few evaluations, to see whether all meshes are done.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from meshkit.deform.batched import linear
from meshkit.deform.batched_factor import BatchedFactor
from meshkit.deform.objective import HALVINGS, LONGEST, MEMORY, SUFFICIENT

__all__ = ["BatchedObjective", "BatchedOutcome", "alternate_batch", "minimise_batch"]

LOOK = 8  # evaluations or iterations between two looks at what is done


@dataclass
class BatchedOutcome:
    """Where the meshes ended, each field (B,) but for the positions (BV, 3) about their origins."""

    x: Tensor
    energy: Tensor
    evaluations: Tensor
    residual: Tensor
    converged: Tensor
    negative_curvature: Tensor


class BatchedObjective:
    """Energy over m of each mesh, and half the gradient at its free vertices; see `Objective`."""

    def __init__(self, factor: BatchedFactor, soft_targets: Tensor | None) -> None:
        self.factor, self.energy = factor, factor.energy
        self.free, self.solve = factor.free, factor.solve
        rest = self.energy.rest.flatten(0, 1)
        self.image = rest  # of the last evaluation: (L + W) x
        self.force_at_rest = factor.stiffness @ rest
        self.pull: Tensor | None = None
        if factor.soft is not None and soft_targets is not None:
            weights = factor.soft.view(-1, 1)
            self.force_at_rest = self.force_at_rest - weights * rest
            self.pull = weights * soft_targets
        self.constant = self.energy.per_mesh(rest * self.force_at_rest)
        if self.pull is not None and soft_targets is not None:
            self.constant = self.constant + self.energy.per_mesh((self.pull * soft_targets).detach())

    def spread(self, values: Tensor) -> Tensor:
        """One value per mesh for every vertex: (BV, 1)."""
        return values.repeat_interleave(self.energy.size)[:, None]

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Energies (B,) and half gradients (BV, 3), zero at fixed vertices."""
        force = self.energy.pulled_back(self.energy.rotations(x))
        if self.pull is not None:
            force = force + self.pull.detach()
        self.image = self.factor.stiffness @ x
        energy = self.energy.per_mesh(x * (self.image - 2 * force)) + self.constant
        return energy, torch.where(self.free, self.image - force, 0.0)

    def relative(self, decrease: Tensor, energy: Tensor) -> Tensor:
        """A decrease over the energy; see `Objective.relative`."""
        return decrease / torch.maximum(energy, 1e-10 * self.constant.abs()).clamp_min(1e-300)

    def residual(self, energy: Tensor, gradient: Tensor) -> Tensor:
        """Decrease that one local-global iteration is sure to bring, relative."""
        return self.relative(self.energy.per_mesh(gradient * self.solve(gradient)), energy)


def alternate_batch(
    objective: BatchedObjective, goal: Tensor, start: Tensor | None, *, max_iter: int, tol: float
) -> tuple[Tensor, Tensor]:
    """Positions (BV, 3) after local-global iterations, differentiable, and the number of iterations of each mesh.

    Args:
        objective: its soft targets may be differentiable.
        goal: (BV, 3) positions at the fixed vertices, 0 elsewhere; differentiable.
        start: (BV, 3) positions whose rotations to start from, or None for the identity.
        max_iter: number of iterations.
        tol: see `alternate`; above 0 the host waits for the device in every iteration.
    """
    energy, free, factor = objective.energy, objective.free, objective.factor
    stiffness = factor.stiffness.matmul
    pulled = linear(goal, stiffness, stiffness)
    x = goal if start is None else torch.where(free, start, goal)
    done = torch.zeros(energy.batch, dtype=torch.bool, device=goal.device)
    count = torch.zeros(energy.batch, dtype=torch.int64, device=goal.device)
    for iteration in range(max_iter):
        force = objective.force_at_rest
        if iteration or start is not None:
            force = energy.pulled_back(energy.rotations(x))
        if objective.pull is not None:
            force = force + objective.pull
        right = torch.where(free, force - pulled, 0.0)
        moved = linear(right, objective.solve, objective.solve) + goal
        count += ~done
        if tol > 0 and (iteration or start is not None):
            moved = torch.where(objective.spread(done), x, moved)
            ended, step = moved.detach(), (moved - x).detach()
            bound = energy.per_mesh(ended * (stiffness(ended) - 2 * force.detach())) + objective.constant
            drop = energy.per_mesh(step * stiffness(step))
            done = done | (drop <= tol * torch.maximum(bound, 1e-10 * objective.constant))
            x = moved
            if bool(done.all()):
                break
        x = moved
    return x, count


def minimise_batch(objective: BatchedObjective, x: Tensor, *, max_iter: int, tol: float) -> BatchedOutcome:
    """L-BFGS in the metric of the stiffness for every mesh at once; see `minimise`.

    Args:
        objective: what to minimise.
        x: (BV, 3) positions that meet the handles.
        max_iter: evaluations at most, of each mesh.
        tol: residual at which to stop.
    """
    per_mesh, spread = objective.energy.per_mesh, objective.spread
    energy, gradient = objective(x)
    evaluations = torch.ones_like(energy, dtype=torch.int64)
    slack = 1e-13 * objective.constant.abs()
    moves, changes = (x.new_zeros(MEMORY, *x.shape) for _ in range(2))
    inverses = energy.new_zeros(MEMORY, len(energy))  # 0 marks an empty place
    image, stretch = objective.image, torch.ones_like(energy)
    step, halvings = torch.ones_like(energy), torch.zeros_like(evaluations)
    stuck = negative = torch.zeros_like(energy, dtype=torch.bool)
    for evaluation in range(1, max_iter + 1):
        direction = _two_loops(objective, moves, changes, inverses, gradient, stretch)
        decrease = per_mesh(gradient * direction)
        residual = objective.relative(decrease, energy)
        done = (residual <= tol) | stuck
        if evaluation == max_iter or (evaluation % LOOK == 0 and bool(done.all())):
            break
        move = spread(-step) * direction
        new_energy, new_gradient = objective(x + move)
        evaluations += ~done
        accepted = ~done & (new_energy <= energy - SUFFICIENT * step * decrease + slack)
        change = new_gradient - gradient
        curvature = per_mesh(move * change)
        negative = torch.where(accepted, curvature < 0, negative)
        # Accepted steps enter the history, or empty it where they met negative curvature.
        taken, bent = spread(accepted), curvature > 0
        moves = torch.where(taken, torch.cat([moves[1:], move[None]]), moves)
        changes = torch.where(taken, torch.cat([changes[1:], change[None]]), changes)
        newest = torch.where(bent, 1 / torch.where(bent, curvature, 1.0), 0.0)
        shifted = torch.cat([torch.where(bent, inverses[1:], 0.0), newest[None]])
        inverses = torch.where(accepted, shifted, inverses)
        # As in `minimise`; 1 after negative curvature, where `newest` is 0.
        longer = (per_mesh(move * (objective.image - image)) * newest).clamp(1.0, LONGEST)
        stretch = torch.where(accepted, longer, stretch)
        image = torch.where(taken, objective.image, image)
        x = torch.where(taken, x + move, x)
        gradient = torch.where(taken, new_gradient, gradient)
        energy = torch.where(accepted, new_energy, energy)
        # A refused step is halved; after several, the history is at fault, or rounding.
        halvings = torch.where(accepted, 0, halvings + 1)
        failed = ~done & (halvings >= HALVINGS)
        stuck = stuck | (failed & (inverses == 0).all(0))
        inverses, stretch = torch.where(failed, 0.0, inverses), torch.where(failed, 1.0, stretch)
        step = torch.where(accepted | failed, 1.0, 0.5 * step)
        halvings = torch.where(failed, 0, halvings)
    converged = residual <= tol
    return BatchedOutcome(x, energy, evaluations, objective.residual(energy, gradient), converged, negative)


def _two_loops(
    objective: BatchedObjective, moves: Tensor, changes: Tensor, inverses: Tensor, gradient: Tensor, stretch: Tensor
) -> Tensor:
    """The L-BFGS inverse Hessian applied to a gradient."""
    per_mesh, spread = objective.energy.per_mesh, objective.spread
    right, shares = gradient, []
    for move, change, inverse in zip(moves.flip(0), changes.flip(0), inverses.flip(0), strict=True):
        shares.append(inverse * per_mesh(move * right))
        right = right - spread(shares[-1]) * change
    direction = spread(stretch) * objective.solve(right)
    for move, change, inverse, share in zip(moves, changes, inverses, reversed(shares), strict=True):
        direction = direction + spread(share - inverse * per_mesh(change * direction)) * move
    return direction
