"""L-BFGS whose metric is the stiffness, so that its first step is one of local-global.

The turning of the rotations makes the energy flatter than its stiffness L says. By how much, the last step s and change
y of the gradient tell: the metric is L over s^T L s / s^T y, at least 1.

It is here twice. For one mesh the host decides after every evaluation. In a batch each mesh has its own step, history
and end; what they decide is a mask over the batch, so that the host waits for the device only every few evaluations, to
see whether all meshes are done. On the CPU those masks over all vectors would be a waste, on a GPU the waiting.
"""

import torch
from torch import Tensor

from meshkit.deform.batched_objective import BatchedObjective
from meshkit.deform.mesh_objective import MeshObjective
from meshkit.deform.objective import Objective
from meshkit.deform.options import ARAPInfo

__all__ = ["minimise", "minimise_batch"]

MEMORY, HALVINGS, SUFFICIENT = 5, 8, 2e-4
LONGEST = 4.0  # times the step of local-global

History = list[tuple[Tensor, Tensor, Tensor]]


def minimise(
    objective: MeshObjective, x: Tensor, *, max_iter: int, tol: float, refine: bool
) -> tuple[Tensor, ARAPInfo]:
    """Minimise the energy of one mesh.

    Args:
        objective: what to minimise.
        x: (V, 3) positions that meet the handles.
        max_iter: evaluations at most.
        tol: residual at which to stop.
        refine: go over to float64 rotations once float32 ones have done what they can.

    Returns:
        Positions, and the report.
    """
    dot = objective.dot
    history: History = []
    energy, gradient = objective(x)
    image, stretch = objective.image, torch.ones_like(energy)
    slack = 1e-13 * objective.constant.abs()
    negative = False
    while True:
        direction = _two_loops(objective, history, gradient, stretch)
        decrease = dot(gradient, direction)
        # Without a history this is g^T L^-1 g; with one it knows the curvature too, and is mostly larger.
        residual = objective.relative(decrease, energy)
        coarse = refine and objective.dtype == torch.float32
        if coarse and tol < 1e-7 and residual <= 1e-7:
            objective.refine()
            energy, gradient = objective(x)
            history.clear()
            image, stretch = objective.image, torch.ones_like(energy)
            continue
        if residual <= tol or objective.evaluations >= max_iter:
            break
        step, accepted = 1.0, False
        for _ in range(HALVINGS):
            candidate = torch.sub(x, direction, alpha=step)
            new_energy, new_gradient = objective(candidate)
            accepted = bool(new_energy <= energy - SUFFICIENT * step * decrease + slack)
            if accepted or objective.evaluations >= max_iter:
                break
            step *= 0.5
        if not accepted:
            if history:
                history.clear()
            elif coarse:
                objective.refine()
                energy, gradient = objective(x)
                image = objective.image
            else:
                break
            stretch = torch.ones_like(energy)
            continue
        move, change = direction.mul_(-step), new_gradient - gradient
        curvature = dot(move, change)
        negative = bool(curvature < 0)
        if curvature > 0:
            history = [*history[1 - MEMORY :], (move, change, 1 / curvature)]
            stretch = (dot(move, objective.image - image) / curvature).clamp(1.0, LONGEST)
        else:
            history.clear()
            stretch = torch.ones_like(energy)
        x, energy, gradient, image = candidate, new_energy, new_gradient, objective.image
    ended = residual <= tol
    if history:
        residual = objective.residual(energy, gradient)
    evaluations = torch.tensor(objective.evaluations, device="cpu")
    return x, objective.info(energy, evaluations, residual, ended, torch.tensor(negative, device="cpu"))


def minimise_batch(objective: BatchedObjective, x: Tensor, *, max_iter: int, tol: float) -> tuple[Tensor, ARAPInfo]:
    """Minimise the energies of all meshes at once.

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
        direction = _two_loops(objective, list(zip(moves, changes, inverses, strict=True)), gradient, stretch)
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


def _two_loops(objective: Objective, history: History, gradient: Tensor, stretch: Tensor) -> Tensor:
    """The L-BFGS inverse Hessian applied to a gradient; in the history an inverse curvature of 0 has no effect."""
    dot, spread, right, shares = objective.dot, objective.spread, gradient.clone(), []
    for move, change, inverse in reversed(history):
        shares.append(inverse * dot(move, right))
        right.addcmul_(spread(shares[-1]), change, value=-1)
    direction = objective.solve(right) * spread(stretch)
    for (move, change, inverse), share in zip(history, reversed(shares), strict=True):
        direction.addcmul_(spread(share - inverse * dot(change, direction)), move)
    return direction
