"""As-rigid-as-possible surface deformation of a batch of meshes, with gradients."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from torch import Tensor

from meshkit._compile import uncompiled
from meshkit.deform.dispatch import Kind, dispatch
from meshkit.deform.options import ARAPInfo, Options, check_options, refuse_partial_gradient
from meshkit.deform.topology import check_energy

__all__ = ["PRESETS", "arap_deform"]

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "xdualnet": MappingProxyType(
            {"energy": "spokes", "method": "local_global", "max_iter": 50, "tol": 0.0, "grad": "unroll"}
        )
    }
)
"""Options by name: ``arap_deform(..., **PRESETS["xdualnet"])`` is the deformer of the paper, and Open3D's.

Its 50 iterations end before the minimum, so what they are differentiated through is themselves.
"""


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
    solver: str = "auto",
    compiled: bool = False,
    degenerate: str = "raise",
    mask: Tensor | None = None,
) -> tuple[Tensor, ARAPInfo]:
    r"""Deform meshes as rigidly as possible so that their handles meet given positions.

    .. math:: \min_x E(x) + \sum_i \omega_i \lVert x_i - t_i \rVert^2
              \quad\text{with}\quad x_h = p_h \text{ at the handles}

    E is :func:`arap_energy`, :math:`\omega, t` the soft weights and targets. Positions and energies are float64. On the
    CPU meshes are solved one after the other, and memory is proportional to the number of vertices. The connectivity
    of the last few sets of faces is kept between calls; :class:`~meshkit.deform.ARAPTopology`,
    :class:`~meshkit.deform.ARAPRest` and :class:`~meshkit.deform.ARAPFactor` are the parts for one mesh. CUDA tensors
    stay where they are, and the whole batch is set up and solved at once; the host looks now and then whether all
    meshes are done: L-BFGS every eight evaluations, local-global in every iteration unless ``tol`` is 0, then never.

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
        method: "lbfgs", which reaches the energy of 50 local-global iterations in about 15 evaluations and goes on to
            the minimum; or "local_global", which alternates the best rotations with the best positions.
        init: "rest" starts from the identity rotations of the rest shape; positions of the shape of `verts` start from
            the rotations that suit them once the handles are moved (detached).
        max_iter: evaluations, or iterations, at most.
        tol: stop at this residual (see :class:`ARAPInfo`). The rotations of "lbfgs" are float32 unless `verts` are
            float64 and `tol` is below 1e-7, or the batch is solved at once. 0 asks "local_global" for all iterations.
        grad: "implicit" differentiates the minimum, exact only at one: a warning tells of residuals above tol and 1e-7;
            converge further, or take "unroll", which records the iterations of "local_global" and differentiates them
            with respect to `handle_pos` and `soft_targets`, and refuses `verts` and `soft_weights` that want a
            gradient; "none" records nothing.
        grad_tol: relative accuracy of the implicit gradient's linear solve, in the norm of the Hessian. On a body of
            6890 vertices the defaults give gradients within 2e-3 at 10 % handles and 6e-3 at 1 %, where `tol` 1e-9
            gives 2e-3; holding the rotations fixed would be wrong by 35 % and 83 %.
        solver: "auto" is "splu" on the CPU; on another device "dense", which inverts a Cholesky factor per mesh there
            (24 B V² bytes at the peak), up to 8192 vertices and 8 GiB, and "pcg" beyond. "dense" also solves whole
            batches at once on the CPU. "splu", "qdldl" and "cholespy" always work on the CPU, mesh by mesh; for them
            and "pcg" see :class:`~meshkit.deform.ARAPFactor`.
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
            only needs welding); a degenerate face; soft weights without targets, or below 0; "unroll" with `verts` or
            `soft_weights` that want a gradient.
        ImportError: the package of the solver is missing.

    Reference:
        X-DualNet, section "ARAP deformer": ``**PRESETS["xdualnet"]``. Sorkine and Alexa 2007 (local-global).

    Deviations:
        The released code deforms without recording a gradient, which is ``grad="none"``.

    Example:
        >>> import torch
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        >>> moved, info = arap_deform(verts, faces, torch.tensor([0, 1, 2]), verts[:3] + 1.0)
        >>> torch.allclose(moved, verts + 1.0, atol=1e-6), bool(info.converged)
        (True, True)
    """
    inputs = {"verts": verts, "faces": faces, "handles": handles, "handle_pos": handle_pos}
    for name, value in (inputs | {"soft_targets": soft_targets, "soft_weights": soft_weights, "mask": mask}).items():
        if not isinstance(value, Tensor) and (value is not None or name in inputs):
            raise ValueError(f"{name} must be a tensor, got {type(value).__name__}: convert it with torch.as_tensor")
    check_options(method, max_iter, tol, grad, grad_tol, solver, degenerate)
    if isinstance(init, str) and init != "rest":
        raise ValueError(f'init must be "rest" or a tensor of positions, got {init!r}')
    if (soft_targets is None) != (soft_weights is None):
        missing = "soft_targets" if soft_targets is None else "soft_weights"
        raise ValueError(f"soft_targets and soft_weights belong together; {missing} is missing")
    check_energy(energy)
    if grad == "unroll":
        refuse_partial_gradient(verts=verts, soft_weights=soft_weights)
    options = Options(method, max_iter, tol, grad, grad_tol, solver, compiled)

    def work(kind: Kind) -> tuple[Tensor, ARAPInfo] | None:
        problem: Any = kind(verts, faces, mask, energy, degenerate)
        chosen = problem.handles(handles)
        return problem.deform(
            chosen,
            problem.goal(chosen, handle_pos),
            options,
            None if soft_targets is None else problem.positions(soft_targets, "soft_targets"),
            None if soft_weights is None else problem.weights(soft_weights, "soft_weights"),
            None if isinstance(init, str) else problem.positions(init, "init"),
        )

    return dispatch(options.batched(verts.device), work)
