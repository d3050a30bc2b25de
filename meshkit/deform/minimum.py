"""From an objective and its goal to deformed positions with the gradient that was asked for."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from meshkit.deform.implicit import ImplicitMinimum
from meshkit.deform.local_global import alternate
from meshkit.deform.objective import Objective
from meshkit.deform.options import ARAPInfo, Options

__all__ = ["minimum"]


def minimum(
    objective: Objective,
    minimise: Callable[[Tensor], tuple[Tensor, ARAPInfo]],
    options: Options,
    *,
    verts: Tensor,
    goal: Tensor,
    soft_targets: Tensor | None,
    soft_weights: Tensor | None,
    start: Tensor | None,
    negative: Tensor,
) -> tuple[Tensor, ARAPInfo]:
    """Positions (V, 3) about the origins, and the report.

    Args:
        objective: with the soft targets, which are constant unless the iterations are recorded.
        minimise: L-BFGS of the objective, from positions that meet the goal.
        options: the choices.
        verts: (V, 3) rest positions; differentiable, as are the next three.
        goal: (V, 3) positions of the fixed vertices about the origins, 0 elsewhere.
        soft_targets: (V, 3) about the origins.
        soft_weights: (V,).
        start: (V, 3) about the origins, or None for the identity rotations of the rest shapes.
        negative: (B,) bool, to tell of negative curvature in the report and after the backward pass.
    """
    first = None if start is None else start.detach()
    with torch.set_grad_enabled(options.unroll):
        if options.method == "local_global":
            x, count = alternate(objective, goal, first, max_iter=options.max_iter, tol=options.tol)
            info = objective.ended(x.detach(), count, options.tol)
        else:
            held = goal.detach()
            if first is None:
                first, _ = alternate(objective, held, None, max_iter=1, tol=0.0)
            x, info = minimise(torch.where(objective.free, first, held))
    info = replace(info, negative_curvature=negative.copy_(info.negative_curvature))
    if options.grad == "implicit" and torch.is_grad_enabled():
        inputs = verts, goal, soft_targets, soft_weights
        x = ImplicitMinimum.apply(*inputs, x.detach(), objective, info, options)
    return x, info
