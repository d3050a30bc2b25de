"""Gradients of a minimum, by the implicit function theorem with the true Hessian."""

import warnings
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.objective import Objective
from meshkit.deform.options import ARAPInfo, Options, warn_unconverged

__all__ = ["SADDLE", "ImplicitMinimum"]

SADDLE = (
    "negative curvature: the deformation is a saddle and not a minimum, so its gradient is truncated; "
    "raise max_iter, lower tol, or start elsewhere"
)


class ImplicitMinimum(torch.autograd.Function):
    r"""Give the minimum x of an objective its gradient with respect to everything it depends on.

    At the minimum :math:`g(x, \theta) = 0` at the free vertices, so
    :math:`\bar\theta = -(\partial g/\partial\theta)^\top \lambda` with :math:`H_{ff} \lambda = \bar x_f`. The Hessian
    :math:`H = L + W - B^\top D B` holds the derivative D of the rotations; conjugate gradients solve it, with the
    inverse of the forward pass as preconditioner.
    """

    @staticmethod
    def forward(
        ctx: Any,
        verts: Tensor,
        goal: Tensor,
        soft_targets: Tensor | None,
        soft_weights: Tensor | None,
        x: Tensor,
        objective: Objective,
        info: ARAPInfo,
        options: Options,
    ) -> Tensor:
        """Return the minimum. All is (V, 3), the soft weights (V,); all but `verts` about the origin."""
        ctx.save_for_backward(x, soft_targets)
        ctx.objective, ctx.info, ctx.options = objective, info, options
        return x.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Solve for the adjoint, then differentiate the stationarity condition."""
        x, soft_targets = ctx.saved_tensors
        grad = grad.contiguous()  # as all vectors here are; it enters with any strides
        objective: Objective = ctx.objective
        edges, soft = objective.edges, objective.soft
        R, turned = objective.linearise(x, precise=ctx.options.grad_tol < 1e-4)

        def product(direction: Tensor, change: Tensor) -> Tensor:
            return objective.stiffness @ direction - objective.pulled_back(change)

        adjoint, negative = objective.solve_hessian(
            lambda direction: product(direction, turned(direction)), grad, tol=ctx.options.grad_tol
        )
        ctx.info.negative_curvature.logical_or_(negative)
        if bool(negative.any()):
            warnings.warn(SADDLE, stacklevel=2)
        warn_unconverged(float(ctx.info.residual.amax()), ctx.options.tol)
        change = turned(adjoint)
        wanted = ctx.needs_input_grad
        grads: list[Tensor | None] = [None] * len(wanted)
        if wanted[0]:
            rotations = (objective.component_first(value) for value in (R, change))
            grads[0] = -edges.stationarity_gradient(objective.verts, x, adjoint, *rotations)
        if wanted[1]:
            grads[1] = torch.where(objective.free, 0.0, grad - product(adjoint, change))
        if soft is not None and wanted[2]:
            grads[2] = soft * adjoint
        if soft is not None and wanted[3]:
            grads[3] = -(adjoint * (x - soft_targets)).sum(1) / edges.multiplicity
        return tuple(grads)
