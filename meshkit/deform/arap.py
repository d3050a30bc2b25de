"""As-rigid-as-possible surface deformation of a batch of meshes, by the local-global iteration."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.operators import LinearMap
from meshkit.deform.problem import Problem
from meshkit.deform.rotation import ClosestRotation

__all__ = ["ARAPInfo", "arap_deform", "arap_energy"]


@dataclass(frozen=True)
class ARAPInfo:
    """How a deformation ended.

    Attributes:
        energy: (B,) energy of each mesh, or () for one mesh; float64, detached.
        iterations: local-global iterations done.
        residual: largest relative decrease of a mesh's energy in the last iteration, relative to at least 1e-8 of the
            energy of collapsing that mesh to a point; infinity after a single iteration from rest.
        converged: whether `residual` is at most `tol`; never at the default `tol` of 0, which asks for all iterations.
    """

    energy: Tensor
    iterations: int
    residual: float
    converged: bool


def arap_energy(
    verts: Tensor, faces: Tensor, deformed: Tensor, *, energy: str = "spokes_and_rims", mask: Tensor | None = None
) -> Tensor:
    r"""As-rigid-as-possible energy of a deformation, minimised over the rotations of the cells.

    .. math:: E = \sum_i \min_{R_i \in SO(3)} \sum_{(j,k) \in C_i} w_{jk}
              \lVert (\hat v_j - \hat v_k) - R_i (v_j - v_k) \rVert^2

    ``"spokes"``: the cell holds the edges (i, j) at vertex i, with the cotangent weight
    :math:`w_{ij} = \max(0, (\cot\alpha_{ij} + \cot\beta_{ij})/2)`. Without the clamp this energy is unbounded below
    at obtuse triangles. ``"spokes_and_rims"``: the cell holds all three edges of every face around i, each with the
    half cotangent it has in that face; it is never negative and needs no clamp. Zero-area faces weigh nothing.

    Args:
        verts: (V, 3) or (B, V, 3) rest positions. Treated as constants.
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1; each mesh may have its own connectivity.
        deformed: positions of the shape of `verts`. Differentiable (first derivatives).
        energy: "spokes_and_rims" or "spokes".
        mask: (B, V) bool (or (V,) for one mesh), True at real vertices.

    Returns:
        (B,) energies, or () for one mesh, the unit of `verts` squared (a sum over cells, not a mean).

    Raises:
        ValueError: unknown energy; bad shapes, indices or mask; NaN or infinity at a real vertex.

    Reference:
        X-DualNet, section "ARAP deformer"; Sorkine and Alexa 2007 (spokes); Chao et al. 2010 (spokes and rims).

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> arap_energy(verts, torch.tensor([[0, 1, 2]]), 2 * verts)
        tensor(3.)
    """
    problem = Problem(verts, faces, mask, energy)
    moved = problem.join(deformed, "deformed")
    per_mesh = problem.per_mesh(problem.operators.energy(moved))
    return per_mesh.to(deformed.device, deformed.dtype)


def arap_deform(
    verts: Tensor,
    faces: Tensor,
    handles: Tensor,
    handle_pos: Tensor,
    *,
    energy: str = "spokes_and_rims",
    max_iter: int = 50,
    tol: float = 0.0,
    init: str | Tensor = "rest",
    grad: str = "unroll",
    mask: Tensor | None = None,
) -> tuple[Tensor, ARAPInfo]:
    r"""Deform meshes as rigidly as possible so that their handles meet given positions.

    Alternates the best rotations of the cells (local) with the positions that minimise :func:`arap_energy` under them
    (global, :math:`m L_{ff} x_f = (B^\top R)_f - m L_{fh} x_h`). The energy never increases. The batch is one disjoint
    union of meshes: one sparse factorisation per call and one solve per iteration, on the CPU, in float64; the
    rotations are in the dtype of `verts` (at least float32).

    Args:
        verts: (V, 3) or (B, V, 3) rest positions. Treated as constants: no gradient reaches them yet.
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1; each mesh may have its own connectivity.
        handles: (H,) int64 vertex indices shared by the batch, or (B, H) padded with -1.
        handle_pos: (H, 3) or (B, H, 3) positions of the handles; rows of padding handles are ignored.
        energy: "spokes_and_rims" (default: right on any mesh) or "spokes" with weights clamped at 0.
        max_iter: number of iterations, at least 1.
        tol: stop early when the relative decrease of every energy is at most `tol`; 0 runs all iterations.
        init: "rest" starts from the identity rotations of the rest shape; positions of the shape of `verts` start from
            the rotations that suit them once the handles are moved (detached).
        grad: "unroll" differentiates through the iterations with respect to `handle_pos`; "none" records nothing.
        mask: (B, V) bool (or (V,) for one mesh), True at real vertices. Padding comes back as zeros.

    Returns:
        Deformed positions of the shape, dtype and device of `verts`, and an :class:`ARAPInfo`. If every vertex is a
        handle, these are the handle positions and there are no iterations.

    Raises:
        ValueError: an unknown option; bad shapes, indices or mask; NaN or infinity; a mesh without a handle; a handle
            out of range or repeated; a component, or a vertex of no face of positive area, that has no handle.
            Zero-area faces themselves are allowed: they have no stiffness.

    Reference:
        X-DualNet, section "ARAP deformer": ``energy="spokes"``, 50 iterations from rest, is the paper's setting.

    Deviations:
        The released code deforms without recording a gradient, which is ``grad="none"``.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        >>> moved, info = arap_deform(verts, faces, torch.tensor([0, 1, 2]), verts[:3] + 1.0)
        >>> torch.allclose(moved, verts + 1.0, atol=1e-6), info.iterations
        (True, 50)
    """
    check_options(max_iter, grad)
    if not tol >= 0:
        raise ValueError(f"tol must be at least 0, got {tol}")
    if isinstance(init, str) and init != "rest":
        raise ValueError(f'init must be "rest" or a tensor of positions, got {init!r}')
    problem = Problem(verts, faces, mask, energy)
    start = None if isinstance(init, str) else problem.join(init.detach(), "init")
    with torch.set_grad_enabled(torch.is_grad_enabled() and grad == "unroll"):
        fixed, used = problem.join_handles(handles)
        return solve(problem, fixed, problem.join_targets(handle_pos, used), start, max_iter, tol)


def check_options(max_iter: int, grad: str) -> None:
    """Raise ValueError on an option that neither the function nor the module knows."""
    if max_iter < 1:
        raise ValueError(f"max_iter must be at least 1, got {max_iter}")
    if grad not in ("unroll", "none"):
        raise ValueError(f'grad must be "unroll" or "none", got {grad!r}')


def solve(
    problem: Problem, fixed: Tensor, targets: Tensor, start: Tensor | None, max_iter: int, tol: float
) -> tuple[Tensor, ARAPInfo]:
    """Local-global iteration on a joined problem whose vertices `fixed` (H,) are held at `targets` (H, 3)."""
    operators, count = problem.operators, len(problem.real)
    is_free = torch.ones(count, dtype=torch.bool)
    is_free[fixed] = False
    free = is_free.nonzero().squeeze(1)
    place = torch.empty(count, dtype=torch.int64)
    place[torch.cat([free, fixed])] = torch.arange(count)

    def assemble(x_free: Tensor) -> Tensor:
        return torch.cat([x_free, targets]).index_select(0, place)

    if not len(free):
        everything = assemble(targets[:0])
        return problem.split(everything), ARAPInfo(
            problem.per_mesh(operators.energy(everything.detach())), 0, 0.0, True
        )

    factor, pull = _factorise(operators.laplacian, free.numpy(), fixed.numpy())
    pulled = LinearMap.apply(targets, pull.__matmul__, pull.T.__matmul__)
    dtype = torch.promote_types(problem.dtype, torch.float32)
    quaternions = torch.eye(4, 1, dtype=dtype).repeat(1, count)
    rotations = torch.eye(3, dtype=dtype)[:, :, None].expand(3, 3, count)
    x, energies = problem.verts, []
    if start is not None:
        x = assemble(start[free])
        energies.append(problem.per_mesh(operators.energy(x.detach())))
    iteration, residual = 0, float("inf")
    while iteration < max_iter and not (tol > 0 and residual <= tol):
        if iteration or start is not None:
            rotations, quaternions = ClosestRotation.apply(operators.cell_moments(x, dtype), quaternions)
        right = operators.pull_back(rotations).index_select(0, free) / operators.multiplicity - pulled
        x = assemble(LinearMap.apply(right, factor.solve, factor.solve))
        iteration += 1
        # An energy costs a local step: without a tolerance only the last two are wanted.
        if tol > 0 or iteration >= max_iter - 1:
            energies.append(problem.per_mesh(operators.energy(x.detach(), quaternions.double())))
            if len(energies) > 1:
                scale = torch.maximum(energies[-2], 1e-8 * problem.per_mesh(operators.rest_energy))
                residual = float(((energies[-2] - energies[-1]) / scale).max())
    return problem.split(x), ARAPInfo(energies[-1], iteration, residual, residual <= tol)


def _factorise(laplacian: Any, free: Any, fixed: Any) -> tuple[Any, Any]:
    """Sparse factor of the free-free block, which is positive definite, and the free-fixed block."""
    from scipy.sparse.linalg import splu

    rows = laplacian[free]
    block = rows[:, free].tocsc()
    options = {"SymmetricMode": True}
    return splu(block, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options), rows[:, fixed]
