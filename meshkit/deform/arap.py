"""As-rigid-as-possible surface deformation of a batch of meshes, with gradients."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit._compile import uncompiled
from meshkit.deform.factor import ARAPFactor, check_solver
from meshkit.deform.implicit import ImplicitMinimum
from meshkit.deform.local_global import alternate
from meshkit.deform.objective import Objective, Outcome, minimise
from meshkit.deform.problem import Problem
from meshkit.deform.rest import ARAPRest, cell_edges
from meshkit.topology import cotangent_weights

__all__ = ["PRESETS", "ARAPInfo", "arap_deform", "arap_energy"]


PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {"xdualnet": MappingProxyType({"energy": "spokes", "method": "local_global", "max_iter": 50, "tol": 0.0})}
)
"""Options by name: ``arap_deform(..., **PRESETS["xdualnet"])`` is the deformer of the paper, and Open3D's."""


@dataclass(frozen=True)
class ARAPInfo:
    """How a deformation ended; every field is (B,), or () for one mesh, on the CPU.

    Attributes:
        energy: float64, detached; with the soft term, if any.
        evaluations: int64, local steps: evaluations of the energy by L-BFGS, or iterations of local-global.
        residual: float64, the decrease m gᵀL⁻¹g of the energy (g half its gradient, L its stiffness, both over m) that
            one more local-global iteration is sure to bring, relative to the energy. Where the energy is below 1e-6
            (1e-10 with float64 rotations) of that of collapsing the mesh to a point, relative to that share.
        converged: bool, whether `tol` was met. Implicit gradients presume it.
        negative_curvature: bool, whether the last step met it, or, after the backward pass, whether the adjoint solve
            did: the deformation is then a saddle and its gradient is truncated.
    """

    energy: Tensor
    evaluations: Tensor
    residual: Tensor
    converged: Tensor
    negative_curvature: Tensor


@uncompiled
def arap_energy(
    verts: Tensor,
    faces: Tensor,
    deformed: Tensor,
    *,
    energy: str = "spokes_and_rims",
    mask: Tensor | None = None,
    degenerate: str = "ignore",
) -> Tensor:
    r"""As-rigid-as-possible energy of a deformation, minimised over the rotations of the cells.

    .. math:: E = \sum_i \min_{R_i \in SO(3)} \sum_{(j,k) \in C_i} w_{jk}
              \lVert (\hat v_j - \hat v_k) - R_i (v_j - v_k) \rVert^2

    ``"spokes_and_rims"``: the cell holds all three edges of every face around vertex i, each with the half cotangent it
    has in that face. ``"spokes"``: the cell holds the edges (i, j) at vertex i, with the cotangent weight
    :math:`w_{ij} = \max(0, (\cot\alpha_{ij} + \cot\beta_{ij})/2)`. ``"spokes_unclamped"``: the same without the
    maximum; it can be negative where angles are obtuse. ``"elements"``: a cell per face, with its three edges; it does
    not resist bending. Zero-area faces weigh nothing. An edge may have any number of faces.

    Args:
        verts: (V, 3) or (B, V, 3) rest positions. Differentiable (first derivatives).
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1; each mesh may have its own connectivity.
        deformed: positions of the shape of `verts`. Differentiable (first derivatives).
        energy: one of the four names above.
        mask: (B, V) bool (or (V,) for one mesh), True at real vertices.
        degenerate: "ignore", or "raise" to refuse edges of length zero and triangles of area zero.

    Returns:
        (B,) energies, or () for one mesh, the unit of `verts` squared (a sum over cells, not a mean).

    Raises:
        ValueError: unknown energy; bad shapes, indices or mask; NaN or infinity at a real vertex.

    Reference:
        X-DualNet, section "ARAP deformer"; Sorkine and Alexa 2007 (spokes); Chao et al. 2010 (spokes and rims,
        elements).

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> arap_energy(verts, torch.tensor([[0, 1, 2]]), 2 * verts)
        tensor(3.)
    """
    _check_choice("degenerate", degenerate, ("raise", "ignore"))
    problem = Problem(verts, faces, mask, energy, degenerate)
    values = []
    for rest, v, x in zip(problem.rests, problem.verts, problem.split(deformed, "deformed"), strict=True):
        values.append(_Energy.apply(v, x, rest))
    return problem.per_mesh(values).to(deformed.device, deformed.dtype)


@uncompiled
def arap_deform(
    verts: Tensor,
    faces: Tensor,
    handles: Tensor,
    handle_pos: Tensor,
    *,
    soft_targets: Tensor | None = None,
    soft_weights: Tensor | None = None,
    energy: str = "spokes_and_rims",
    method: str = "lbfgs",
    init: str | Tensor = "rest",
    max_iter: int = 200,
    tol: float = 1e-7,
    grad: str = "implicit",
    grad_tol: float = 1e-3,
    solver: str = "splu",
    compiled: bool = False,
    degenerate: str = "raise",
    mask: Tensor | None = None,
) -> tuple[Tensor, ARAPInfo]:
    r"""Deform meshes as rigidly as possible so that their handles meet given positions.

    .. math:: \min_x E(x) + \sum_i \omega_i \lVert x_i - t_i \rVert^2
              \quad\text{with}\quad x_h = p_h \text{ at the handles}

    E is :func:`arap_energy`, :math:`\omega, t` the soft weights and targets. Meshes are solved one after the other on
    the CPU, with positions and energies in float64; memory is proportional to the number of vertices. The connectivity
    of the last few sets of faces is kept between calls; :class:`~meshkit.deform.ARAPTopology`,
    :class:`~meshkit.deform.ARAPRest` and :class:`~meshkit.deform.ARAPFactor` are the parts for one mesh.

    Args:
        verts: (V, 3) or (B, V, 3) rest positions. Differentiable.
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1; each mesh may have its own connectivity. An edge
            may have any number of faces.
        handles: (H,) int64 vertex indices shared by the batch, or (B, H) padded with -1. None are needed where soft
            weights hold every component.
        handle_pos: (H, 3) or (B, H, 3) positions of the handles; rows of padding handles are ignored. Differentiable.
        soft_targets: positions of the shape of `verts`, met as far as their weights ask. Differentiable.
        soft_weights: (V,) or (B, V) weights, dimensionless like cotangents, at least 0. Differentiable.
        energy: see :func:`arap_energy`.
        method: "lbfgs", which reaches the energy of 50 local-global iterations in about 20 evaluations and goes on to
            the minimum; or "local_global", which alternates the best rotations with the best positions.
        init: "rest" starts from the identity rotations of the rest shape; positions of the shape of `verts` start from
            the rotations that suit them once the handles are moved (detached).
        max_iter: evaluations, or iterations, at most.
        tol: stop at this residual (see :class:`ARAPInfo`). The rotations of "lbfgs" are float32 unless `verts` are
            float64 and `tol` is below 1e-7. 0 asks "local_global" for all iterations.
        grad: "implicit" differentiates the minimum, which is exact only at one: look at ``info.converged`` and converge
            further, or take "unroll", which records the iterations of "local_global" and differentiates them with
            respect to `handle_pos` and `soft_targets` (only); "none" records nothing.
        grad_tol: relative accuracy of the implicit gradient's linear solve, in the norm of the Hessian. On a body of
            6890 vertices the defaults give gradients within 2e-3 at 10 % handles and 6e-3 at 1 %, where `tol` 1e-9
            gives 2e-3; holding the rotations fixed would be wrong by 35 % and 83 %.
        solver: see :class:`~meshkit.deform.ARAPFactor`.
        compiled: run the rotations of "lbfgs" through torch.compile: it needs a C++ compiler and pays after some
            hundred evaluations.
        degenerate: "raise" refuses edges of length zero and triangles of area zero, "ignore" gives them no stiffness.
        mask: (B, V) bool (or (V,) for one mesh), True at real vertices. Padding comes back as zeros.

    Returns:
        Deformed positions of the shape, dtype and device of `verts`, and an :class:`ARAPInfo`. If every vertex is a
        handle, these are the handle positions and there are no evaluations.

    Raises:
        ValueError: an unknown option; bad shapes, indices or mask; NaN or infinity; a mesh without a handle; a handle
            out of range or repeated; a component, or a vertex of no face, that nothing holds (it says so if the mesh
            only needs welding); a degenerate face; soft weights without targets, or below 0.
        ImportError: the package of the solver is missing.

    Reference:
        X-DualNet, section "ARAP deformer": ``**PRESETS["xdualnet"]``. Sorkine and Alexa 2007 (local-global).

    Deviations:
        The released code deforms without recording a gradient, which is ``grad="none"``.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        >>> moved, info = arap_deform(verts, faces, torch.tensor([0, 1, 2]), verts[:3] + 1.0)
        >>> torch.allclose(moved, verts + 1.0, atol=1e-6), bool(info.converged)
        (True, True)
    """
    check_options(method, max_iter, tol, grad, grad_tol, solver, degenerate)
    if isinstance(init, str) and init != "rest":
        raise ValueError(f'init must be "rest" or a tensor of positions, got {init!r}')
    if (soft_targets is None) != (soft_weights is None):
        missing = "soft_targets" if soft_targets is None else "soft_weights"
        raise ValueError(f"soft_targets and soft_weights belong together; {missing} is missing")
    problem = Problem(verts, faces, mask, energy, degenerate)
    own, used = problem.handles(handles, needed=soft_weights is None)
    none: list[Any] = [None] * problem.batch
    soft_t = none if soft_targets is None else problem.split(soft_targets, "soft_targets")
    soft_w = none if soft_weights is None else problem.split_weights(soft_weights, "soft_weights")
    starts = none if isinstance(init, str) else problem.split(init, "init")
    options = Options(method, max_iter, tol, grad, grad_tol, solver, compiled)
    return deform(problem, own, problem.targets(handle_pos, used), soft_t, soft_w, starts, options)


@dataclass(frozen=True)
class Options:
    """The choices of :func:`arap_deform` that all meshes share."""

    method: str
    max_iter: int
    tol: float
    grad: str
    grad_tol: float
    solver: str
    compiled: bool


def _check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}; got {value!r}")


def check_options(
    method: str, max_iter: int, tol: float, grad: str, grad_tol: float, solver: str, degenerate: str
) -> None:
    """Raise ValueError on an option that neither the function nor the module knows."""
    _check_choice("method", method, ("lbfgs", "local_global"))
    _check_choice("grad", grad, ("implicit", "unroll", "none"))
    _check_choice("degenerate", degenerate, ("raise", "ignore"))
    check_solver(solver)
    if grad == "unroll" and method != "local_global":
        raise ValueError('grad="unroll" needs method="local_global"; "lbfgs" goes with grad="implicit"')
    if max_iter < 1:
        raise ValueError(f"max_iter must be at least 1, got {max_iter}")
    if not tol >= 0:
        raise ValueError(f"tol must be at least 0, got {tol}")
    if not 0 < grad_tol < 1:
        raise ValueError(f"grad_tol must be in (0, 1), got {grad_tol}")


def deform(
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
        moved = ImplicitMinimum.apply(
            verts, targets, soft_targets, soft_weights, moved.detach(), objective, options.grad_tol, negative
        )
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


class _Energy(torch.autograd.Function):
    """Energy with the best rotations; held fixed they give the right first derivatives, and wrong second ones."""

    @staticmethod
    def forward(ctx: Any, verts: Tensor, deformed: Tensor, rest: ARAPRest) -> Tensor:
        """Evaluate, and differentiate at once."""
        topology = rest.topology
        rotations = rest.rotations(deformed - rest.origin)[topology.cells]
        inputs = verts.detach().requires_grad_(), deformed.detach().requires_grad_()
        with torch.enable_grad():
            weights = torch.where(rest.kept, cotangent_weights(inputs[0], topology.faces), 0.0)
            before, after = (cell_edges(positions, topology) for positions in inputs)
            turned = (rotations[:, :, None] @ before[:, None, :, :, None]).squeeze(-1)
            squares = (after[:, None] - turned).square().sum(-1)
            energy = (weights[:, None] * torch.from_numpy(topology.membership) * squares).sum()
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*torch.autograd.grad(energy, inputs))
        return energy.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """Scale the gradients."""
        to_verts, to_deformed = ctx.saved_tensors
        return grad * to_verts, grad * to_deformed, None
