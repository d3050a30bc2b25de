"""Gradients of the minima of a whole batch, by the implicit function theorem with the true Hessian."""

import warnings
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.batched_objective import LOOK, BatchedObjective
from meshkit.deform.batched_rotation import Differential
from meshkit.deform.implicit import SADDLE
from meshkit.deform.options import warn_unconverged
from meshkit.topology import cotangent_weights

__all__ = ["BatchedImplicit"]


class BatchedImplicit(torch.autograd.Function):
    """Give the minima x (BV, 3) their gradients; the batched counterpart of `ImplicitMinimum`."""

    @staticmethod
    def forward(
        ctx: Any,
        verts: Tensor,
        goal: Tensor,
        soft_targets: Tensor | None,
        soft_weights: Tensor | None,
        x: Tensor,
        objective: BatchedObjective,
        tol: float,
        negative_curvature: Tensor,
        residual: Tensor,
        forward_tol: float,
    ) -> Tensor:
        """Return the minima. All positions are about the origins of their meshes."""
        ctx.save_for_backward(x, soft_targets)
        ctx.objective, ctx.tol, ctx.negative_curvature = objective, tol, negative_curvature
        ctx.ended = residual, forward_tol
        return x.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Solve for the adjoints, then differentiate the stationarity condition."""
        x, soft_targets = ctx.saved_tensors
        objective: BatchedObjective = ctx.objective
        energy, soft = objective.energy, objective.factor.soft
        S = energy.matrices(x).contiguous()
        R = energy.rotations(x)
        differential = Differential(S, R)

        def turned(direction: Tensor) -> Tensor:
            return differential(energy.matrices(direction).contiguous())

        def product(direction: Tensor, change: Tensor) -> Tensor:
            return objective.factor.stiffness @ direction - energy.pulled_back(change)

        adjoint, negative = _solve(objective, lambda p: product(p, turned(p)), grad, ctx.tol)
        ctx.negative_curvature |= negative.view_as(ctx.negative_curvature)
        if bool(negative.any()):
            warnings.warn(SADDLE, stacklevel=2)
        residual, forward_tol = ctx.ended
        warn_unconverged(float(residual.amax()), forward_tol)
        change = turned(adjoint)
        wanted = ctx.needs_input_grad
        grads: list[Tensor | None] = [None] * 10
        if wanted[0]:
            grads[0] = -_stationarity_gradient(objective, x, adjoint, R, change)
        if wanted[1]:
            grads[1] = torch.where(objective.free, 0.0, grad - product(adjoint, change))
        if soft is not None and wanted[2]:
            grads[2] = soft.view(-1, 1) * adjoint
        if soft is not None and wanted[3]:
            grads[3] = -(adjoint * (x - soft_targets)).sum(1).view_as(soft) / energy.multiplicity
        return tuple(grads)


def _solve(objective: BatchedObjective, product: Any, grad: Tensor, tol: float) -> tuple[Tensor, Tensor]:
    """Adjoints (BV, 3), zero at fixed vertices, by preconditioned conjugate gradients; and where p^T H p <= 0."""
    per_mesh, spread = objective.energy.per_mesh, objective.spread
    residual = torch.where(objective.free, grad, 0.0)
    solution = torch.zeros_like(residual)
    direction = objective.solve(residual)
    square = first = per_mesh(residual * direction)
    negative = torch.zeros_like(square, dtype=torch.bool)
    for iteration in range(500):
        done = (square <= tol * tol * first) | negative
        if iteration % LOOK == 0 and bool(done.all()):
            break
        image = torch.where(objective.free, product(direction), 0.0)
        curvature = per_mesh(direction * image)
        negative = negative | (~done & (curvature <= 0))
        moving = ~done & ~negative
        if iteration == 0:  # one step with the rotations held fixed is better than none
            solution = torch.where(spread(negative), direction, solution)
        step = torch.where(moving, square / torch.where(moving, curvature, 1.0), 0.0)
        solution = solution + spread(step) * direction
        residual = residual - spread(step) * image
        scaled = objective.solve(residual)
        before, square = square, torch.where(moving, per_mesh(residual * scaled), square)
        share = torch.where(moving, square / torch.where(moving, before, 1.0), 0.0)
        direction = scaled + spread(share) * direction
    return solution, negative


def _stationarity_gradient(
    objective: BatchedObjective, x: Tensor, adjoint: Tensor, rotations: Tensor, change: Tensor
) -> Tensor:
    """Gradient (B, V, 3) with respect to the rest positions; see `stationarity_gradient`."""
    energy = objective.energy
    shape = energy.rest.shape
    moved, along = energy.edges(x.view(shape)), energy.edges(adjoint.view(shape))
    turned = energy.mean_rotations(rotations).mT @ along[..., None]
    image = (turned + energy.mean_rotations(change).mT @ moved[..., None]).squeeze(-1)
    work = (along * moved).sum(-1)
    with torch.enable_grad():
        v = energy.rest.clone().requires_grad_()
        weights = torch.where(energy.kept, cotangent_weights(v, energy.faces), 0.0)
        value = (weights * (work - (image * energy.edges(v)).sum(-1))).sum()
    (gradient,) = torch.autograd.grad(value, v)
    return gradient
