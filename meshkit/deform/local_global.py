"""The alternation of local and global steps, recorded for autograd if wanted."""

import torch
from torch import Tensor

from meshkit.deform.objective import Objective
from meshkit.deform.sparse import linear

__all__ = ["alternate"]


def alternate(
    objective: Objective, goal: Tensor, start: Tensor | None, *, max_iter: int, tol: float
) -> tuple[Tensor, Tensor]:
    """Positions (V, 3) after local-global iterations, and the number of iterations of each mesh.

    Args:
        objective: its soft targets may be differentiable.
        goal: (V, 3) positions of the fixed vertices, 0 elsewhere; differentiable.
        start: (V, 3) positions whose rotations to start from, or None for the identity.
        max_iter: number of iterations.
        tol: stop when an iteration lowered the energy by at most this share, from the second one on; 0 for never.
            Above 0 the host waits for the device in every iteration.
    """
    stiffness, floor = objective.stiffness.matmul, 1e-10 * objective.constant
    pulled = linear(goal, stiffness, stiffness)
    x = goal if start is None else torch.where(objective.free, start, goal)
    guess = None
    done = torch.zeros_like(floor, dtype=torch.bool)
    count = torch.zeros_like(floor, dtype=torch.int64)
    for iteration in range(max_iter):
        force = objective.force_at_rest
        if iteration or start is not None:
            rotations, guess = objective.rotations(x, guess)
            force = objective.pulled_back(rotations)
        if objective.pull is not None:
            force = force + objective.pull
        moved = linear(force - pulled, objective.solve, objective.solve) + goal
        count += ~done
        if tol > 0 and (iteration or start is not None):
            moved = torch.where(objective.spread(done), x, moved)
            ended, step = moved.detach(), (moved - x).detach()
            bound = objective.dot(ended, stiffness(ended) - 2 * force.detach()) + objective.constant
            done = done | (objective.dot(step, stiffness(step)) <= tol * torch.maximum(bound, floor))
        x = moved
        if tol > 0 and bool(done.all()):
            break
    return x, count
