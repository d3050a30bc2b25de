"""The as-rigid-as-possible energy of a deformation, its rotations eliminated."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit._compile import uncompiled
from meshkit.deform.batched import BatchedEnergy
from meshkit.deform.batched_deform import BatchedProblem
from meshkit.deform.factor import check_choice
from meshkit.deform.problem import Problem
from meshkit.deform.rest import ARAPRest, cell_edges
from meshkit.deform.topology import check_energy
from meshkit.topology import cotangent_weights

__all__ = ["arap_energy"]


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
    check_choice("degenerate", degenerate, ("raise", "ignore"))
    if verts.device.type != "cpu":
        at_once = energy_of_batch(verts, faces, deformed, energy=energy, mask=mask, degenerate=degenerate)
        if at_once is not None:
            return at_once
    problem = Problem(verts, faces, mask, energy, degenerate)
    values = []
    for rest, v, x in zip(problem.rests, problem.verts, problem.split(deformed, "deformed"), strict=True):
        values.append(_Energy.apply(v, x, rest))
    return problem.per_mesh(values).to(deformed.device, deformed.dtype)


def energy_of_batch(
    verts: Tensor, faces: Tensor, deformed: Tensor, *, energy: str, mask: Tensor | None, degenerate: str
) -> Tensor | None:
    """As :func:`arap_energy`, without leaving the device; None where the input needs the other path's checks."""
    check_energy(energy)
    if deformed.shape != verts.shape or not BatchedProblem.possible(verts, faces, mask):
        return None
    problem = BatchedProblem(verts, faces, mask, energy, degenerate)
    rest, x = (problem.positions(values) for values in (verts, deformed))
    if problem.refused():
        return None
    values: Tensor = _BatchEnergy.apply(rest, x, problem.energy)
    return (values if verts.dim() == 3 else values[0]).to(deformed.dtype)


class _BatchEnergy(torch.autograd.Function):
    """`_Energy` for all meshes at once."""

    @staticmethod
    def forward(ctx: Any, verts: Tensor, deformed: Tensor, operators: BatchedEnergy) -> Tensor:
        """Evaluate, and differentiate at once."""
        rotations = operators.rotations(deformed.detach().flatten(0, 1))[operators.cells]
        inputs = verts.detach().requires_grad_(), deformed.detach().requires_grad_()
        with torch.enable_grad():
            weights = torch.where(operators.kept, cotangent_weights(inputs[0], operators.faces), 0.0)
            before, after = (operators.edges(positions) for positions in inputs)
            turned = (rotations[:, :, :, None] @ before[:, :, None, ..., None]).squeeze(-1)
            squares = (after[:, :, None] - turned).square().sum(-1)
            energy = (weights[:, :, None] * operators.membership * squares).sum((1, 2, 3))
            total = energy.sum()
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*torch.autograd.grad(total, inputs))
        return energy.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """Scale the gradients."""
        to_verts, to_deformed = ctx.saved_tensors
        return grad[:, None, None] * to_verts, grad[:, None, None] * to_deformed, None


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
