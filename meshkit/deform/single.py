"""Deformation of the meshes of a batch one after the other on the CPU."""

from typing import Any

import torch
from torch import Tensor

from meshkit.deform.factor import ARAPFactor
from meshkit.deform.implicit import ImplicitMinimum
from meshkit.deform.local_global import alternate
from meshkit.deform.objective import Objective, Outcome, minimise
from meshkit.deform.options import ARAPInfo, Options
from meshkit.deform.problem import Problem
from meshkit.deform.rest import ARAPRest

__all__ = ["deform_each"]


def deform_each(
    problem: Problem,
    handles: list[Tensor],
    targets: list[Tensor],
    soft_targets: list[Any],
    soft_weights: list[Any],
    starts: list[Any],
    options: Options,
) -> tuple[Tensor, ARAPInfo]:
    """Deform the meshes of a problem one by one."""
    results, fields = [], []
    soft_and_start = zip(soft_targets, soft_weights, starts, strict=True)
    rows = zip(problem.rests, problem.verts, handles, targets, soft_and_start, strict=True)
    for rest, verts, own, goals, (soft_t, soft_w, start) in rows:
        with torch.set_grad_enabled(torch.is_grad_enabled() and options.grad != "none"):
            moved, info = _deform_one(rest, verts, own, goals, soft_t, soft_w, start, problem.dtype, options)
        results.append(moved)
        fields.append(info)
    return problem.join(results), ARAPInfo(*(problem.per_mesh(list(values)) for values in zip(*fields, strict=True)))


def _deform_one(
    rest: ARAPRest,
    verts: Tensor,
    handles: Tensor,
    targets: Tensor,
    soft_targets: Tensor | None,
    soft_weights: Tensor | None,
    start: Tensor | None,
    dtype: torch.dtype,
    options: Options,
) -> tuple[Tensor, tuple[Tensor, ...]]:
    factor = ARAPFactor(rest, handles, soft_weights=soft_weights, solver=options.solver)
    origin = rest.origin
    centred = None if soft_targets is None else (soft_targets - origin).detach()
    precise = torch.promote_types(dtype, torch.float32)
    if options.method == "local_global" or not len(factor.free):
        moved, outcome, objective = _alternate(factor, targets, soft_targets, start, centred, precise, options)
    else:
        objective = Objective(factor, centred, dtype=torch.float32, compiled=options.compiled)
        x = ((verts if start is None else start) - origin).detach().clone()
        x[handles] = (targets - origin).detach()
        if start is None:
            x = objective.global_step(x)
            objective.start_from_rest()
        outcome = minimise(objective, x, max_iter=options.max_iter, tol=options.tol, refine=precise == torch.float64)
        moved = outcome.x + origin
        moved[handles] = targets.detach()
    scalars = (outcome.energy * rest.topology.multiplicity, outcome.residual)
    energy, residual = (torch.tensor(value, dtype=torch.float64, device="cpu") for value in scalars)
    negative = torch.tensor(outcome.negative_curvature, device="cpu")
    converged = torch.tensor(outcome.converged, device="cpu")
    if options.grad == "implicit" and torch.is_grad_enabled():
        args = objective, options.grad_tol, negative, outcome.residual, options.tol
        moved = ImplicitMinimum.apply(verts, targets, soft_targets, soft_weights, moved.detach(), *args)
    evaluations = torch.tensor(outcome.evaluations, device="cpu")
    return moved, (energy, evaluations, residual, converged, negative)


def _alternate(
    factor: ARAPFactor,
    targets: Tensor,
    soft_targets: Tensor | None,
    start: Tensor | None,
    centred: Any,
    dtype: torch.dtype,
    options: Options,
) -> tuple[Tensor, Outcome, Objective]:
    """Local-global iterations, and what the energy says of where they end."""
    origin = factor.rest.origin
    pull = None
    if soft_targets is not None and factor.soft is not None:
        pull = factor.soft[:, None] * (soft_targets - origin)
    iterations = options.max_iter if len(factor.free) else 0
    objective = Objective(factor, centred, dtype=torch.float64)
    with torch.set_grad_enabled(torch.is_grad_enabled() and options.grad == "unroll"):
        x, evaluations = alternate(
            factor,
            targets - origin,
            pull,
            None if start is None else start.detach() - origin,
            constant=objective.constant,
            max_iter=iterations,
            tol=options.tol,
            dtype=dtype,
        )
    energy, gradient = objective(x.detach())
    residual = objective.residual(energy, gradient)
    moved = x + origin
    moved = moved.index_copy(0, factor.handles, targets)
    return moved, Outcome(x, energy, evaluations, residual, residual <= options.tol, False), objective
