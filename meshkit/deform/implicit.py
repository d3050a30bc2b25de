"""Gradients of a minimum, by the implicit function theorem with the true Hessian."""

import warnings
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.objective import Objective, dot
from meshkit.deform.options import warn_unconverged
from meshkit.deform.rest import stationarity_gradient
from meshkit.deform.rotation import ClosestRotation, RotationDifferential

__all__ = ["SADDLE", "ImplicitMinimum"]

SADDLE = (
    "negative curvature: the deformation is a saddle and not a minimum, so its gradient is truncated; "
    "raise max_iter, lower tol, or start elsewhere"
)


class ImplicitMinimum(torch.autograd.Function):
    r"""Give the minimum x of an objective its gradient with respect to everything it depends on.

    At the minimum :math:`g(x, \theta) = 0` at the free vertices, so
    :math:`\bar\theta = -(\partial g/\partial\theta)^\top \lambda` with :math:`H_{ff} \lambda = \bar x_f`. The Hessian
    :math:`H = L + W - B^\top D B` holds the derivative D
    of the rotations; conjugate gradients solve it, with the factor of the forward pass as preconditioner.
    """

    @staticmethod
    def forward(
        ctx: Any,
        verts: Tensor,
        handle_pos: Tensor,
        soft_targets: Tensor | None,
        soft_weights: Tensor | None,
        minimum: Tensor,
        objective: Objective,
        tol: float,
        negative_curvature: Tensor,
        residual: float,
        forward_tol: float,
    ) -> Tensor:
        """Return the minimum."""
        ctx.save_for_backward(minimum, soft_targets)
        ctx.objective, ctx.tol, ctx.negative_curvature = objective, tol, negative_curvature
        ctx.ended = residual, forward_tol
        return minimum.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Solve for the adjoint, then differentiate the stationarity condition."""
        minimum, soft_targets = ctx.saved_tensors
        factor, rest = ctx.objective.factor, ctx.objective.rest
        origin = rest.origin
        x = minimum - origin
        hessian = _Hessian(ctx.objective, x, torch.float32 if ctx.tol >= 1e-4 else torch.float64)
        adjoint, negative = hessian.solve(grad, ctx.tol)
        if negative:
            ctx.negative_curvature.fill_(True)
            warnings.warn(SADDLE, stacklevel=2)
        warn_unconverged(*ctx.ended)
        change = hessian.rotation_change(adjoint)
        wanted = ctx.needs_input_grad
        grads: list[Tensor | None] = [None] * 10
        if wanted[0]:
            grads[0] = -stationarity_gradient(rest, x, adjoint, hessian.R, change)
        if wanted[1]:
            grads[1] = (grad - hessian.product(adjoint, change))[factor.handles]
        if factor.soft is not None and wanted[2]:
            grads[2] = factor.soft[:, None] * adjoint
        if factor.soft is not None and wanted[3]:
            grads[3] = -(adjoint * (minimum - soft_targets)).sum(1) / rest.topology.multiplicity
        return tuple(grads)


class _Hessian:
    """Hessian over 2m of the energy with its rotations eliminated."""

    def __init__(self, objective: Objective, x: Tensor, dtype: torch.dtype) -> None:
        self.objective, self.factor, self.dtype = objective, objective.factor, dtype
        S = objective.matrices(x, torch.float64)
        last = objective.tracker.last
        self.R = ClosestRotation.apply(S, None if last is None else last[0].double())[0].to(dtype)
        self.differential = RotationDifferential(S.to(dtype), self.R)

    def rotation_change(self, direction: Tensor) -> Tensor:
        """D[B p], component first."""
        return self.differential(self.objective.matrices(direction, self.dtype))

    def product(self, direction: Tensor, change: Tensor | None = None) -> Tensor:
        """H p for a direction (V, 3)."""
        change = self.rotation_change(direction) if change is None else change
        return (self.objective.stiffness @ direction).sub_(self.objective.pulled_back(change))

    def solve(self, right: Tensor, tol: float) -> tuple[Tensor, bool]:
        """Adjoint (V, 3), zero at the handles, by preconditioned conjugate gradients; whether p^T H p <= 0 ended it."""
        objective = self.objective
        residual = right.index_select(0, self.factor.free)
        solution = torch.zeros_like(residual)
        direction = objective.solve(residual)
        square = first = dot(residual, direction)
        for iteration in range(500):
            if square <= tol * tol * first:
                break
            image = self.product(objective.spread(direction)).index_select(0, self.factor.free)
            curvature = dot(direction, image)
            if curvature <= 0:
                # One step with the rotations held fixed is better than none.
                return objective.spread(solution if iteration else direction), True
            step = square / curvature
            solution.add_(direction, alpha=step)
            residual.sub_(image, alpha=step)
            scaled = objective.solve(residual)
            before, square = square, dot(residual, scaled)
            direction = scaled.add_(direction, alpha=square / before)
        return objective.spread(solution), False
