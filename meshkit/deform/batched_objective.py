"""The energies of a whole batch on one device, and their minimisation by L-BFGS.

Each mesh has its own step, history and end; what they decide is a mask over the batch, so that the host waits for the
device only every few evaluations, to see whether all meshes are done.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.batched_factor import BatchedFactor
from meshkit.deform.batched_rotation import Differential
from meshkit.deform.mesh_objective import HALVINGS, LONGEST, MEMORY, SUFFICIENT
from meshkit.deform.objective import Objective
from meshkit.deform.options import ARAPInfo
from meshkit.deform.sparse import linear

__all__ = ["BatchedObjective", "minimise_batch"]


class BatchedObjective(Objective):
    """Energies of a batch, all in float64. Matrices of cells are (K, 3, 3)."""

    floor, look = 1e-10, 8

    def __init__(self, factor: BatchedFactor, soft_targets: Tensor | None) -> None:
        self.rest, self.free, self._solve = factor.rest, factor.free, factor.solve
        rest = factor.rest
        super().__init__(rest.verts.flatten(0, 1), rest.edges, factor.stiffness, factor.soft, soft_targets)

    def identity(self) -> Tensor:
        """The identity as the rotation of every cell."""
        return torch.eye(3, dtype=torch.float64, device=self.free.device).expand(self.rest.num_cells, 3, 3)

    def pulled_back(self, rotations: Tensor) -> Tensor:
        """B^T R (V, 3); differentiable."""
        stacked = rotations.permute(2, 0, 1).reshape(-1, 3)
        return linear(stacked, self.rest.moments_t.matmul, self.rest.moments.matmul)

    def rotations(self, x: Tensor, guess: Any) -> tuple[Tensor, Any]:
        """Best rotations; no guess helps."""
        return self.rest.rotations(x), None

    def tracked_rotations(self, x: Tensor) -> Tensor:
        """Best rotations."""
        return self.rest.rotations(x)

    def linearise(self, x: Tensor, *, precise: bool) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Best rotations at x, and the map D[B p] from a direction p (V, 3) to their change; always precise."""
        R = self.rest.rotations(x)
        differential = Differential(self.rest.matrices(x), R)
        return R, lambda direction: differential(self.rest.matrices(direction))

    def component_first(self, rotations: Tensor) -> Tensor:
        """Rotations (K, 3, 3) as (column, row, cell)."""
        return rotations.permute(2, 1, 0).contiguous()

    def solve(self, right: Tensor) -> Tensor:
        """Apply the inverse of the stiffness of the free vertices; 0 at the others, where `right` is 0 too."""
        return self._solve(right)

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner product (B,) of vectors, for each mesh."""
        return (a * b).view(self.rest.batch, -1).sum(1)

    def spread(self, values: Tensor) -> Tensor:
        """Values (B,) per mesh as a column (V, 1)."""
        return values.repeat_interleave(self.rest.size)[:, None]


def minimise_batch(objective: BatchedObjective, x: Tensor, *, max_iter: int, tol: float) -> tuple[Tensor, ARAPInfo]:
    """L-BFGS in the metric of the stiffness for every mesh at once; see `minimise`.

    Args:
        objective: what to minimise.
        x: (BV, 3) positions that meet the handles.
        max_iter: evaluations at most, of each mesh.
        tol: residual at which to stop.

    Returns:
        Positions, and the report.
    """
    dot, spread = objective.dot, objective.spread
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
        decrease = dot(gradient, direction)
        residual = objective.relative(decrease, energy)
        done = (residual <= tol) | stuck
        if evaluation == max_iter or (evaluation % objective.look == 0 and bool(done.all())):
            break
        move = spread(-step) * direction
        new_energy, new_gradient = objective(x + move)
        evaluations += ~done
        accepted = ~done & (new_energy <= energy - SUFFICIENT * step * decrease + slack)
        change = new_gradient - gradient
        curvature = dot(move, change)
        negative = torch.where(accepted, curvature < 0, negative)
        # Accepted steps enter the history, or empty it where they met negative curvature.
        taken, bent = spread(accepted), curvature > 0
        moves = torch.where(taken, torch.cat([moves[1:], move[None]]), moves)
        changes = torch.where(taken, torch.cat([changes[1:], change[None]]), changes)
        newest = torch.where(bent, 1 / torch.where(bent, curvature, 1.0), 0.0)
        shifted = torch.cat([torch.where(bent, inverses[1:], 0.0), newest[None]])
        inverses = torch.where(accepted, shifted, inverses)
        # As in `minimise`; 1 after negative curvature, where `newest` is 0.
        longer = (dot(move, objective.image - image) * newest).clamp(1.0, LONGEST)
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
    return x, objective.info(energy, evaluations, objective.residual(energy, gradient), residual <= tol, negative)


def _two_loops(
    objective: BatchedObjective, moves: Tensor, changes: Tensor, inverses: Tensor, gradient: Tensor, stretch: Tensor
) -> Tensor:
    """The L-BFGS inverse Hessian applied to a gradient."""
    dot, spread = objective.dot, objective.spread
    right, shares = gradient, []
    for move, change, inverse in zip(moves.flip(0), changes.flip(0), inverses.flip(0), strict=True):
        shares.append(inverse * dot(move, right))
        right = right - spread(shares[-1]) * change
    direction = spread(stretch) * objective.solve(right)
    for move, change, inverse, share in zip(moves, changes, inverses, reversed(shares), strict=True):
        direction = direction + spread(share - inverse * dot(change, direction)) * move
    return direction
