"""The as-rigid-as-possible energy of a deformation, its rotations eliminated."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit._compile import uncompiled
from meshkit.deform.factor import check_choice
from meshkit.deform.problem import Problem
from meshkit.deform.rest import ARAPRest, cell_edges
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
    problem = Problem(verts, faces, mask, energy, degenerate)
    values = []
    for rest, v, x in zip(problem.rests, problem.verts, problem.split(deformed, "deformed"), strict=True):
        values.append(_Energy.apply(v, x, rest))
    return problem.per_mesh(values).to(deformed.device, deformed.dtype)


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
