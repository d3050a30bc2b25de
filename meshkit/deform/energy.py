"""The as-rigid-as-possible energy of a deformation, its rotations eliminated."""

from torch import Tensor

from meshkit._compile import uncompiled
from meshkit.deform.dispatch import Kind, dispatch
from meshkit.deform.factor import check_choice
from meshkit.deform.topology import check_energy

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
        >>> import torch
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> arap_energy(verts, torch.tensor([[0, 1, 2]]), 2 * verts)
        tensor(3.)
    """
    check_choice("degenerate", degenerate, ("raise", "ignore"))
    check_energy(energy)

    def work(kind: Kind) -> Tensor | None:
        problem = kind(verts, faces, mask, energy, degenerate)
        values = problem.energies(deformed)
        return values if values is None or problem.batched else values[0]

    return dispatch(verts.device.type != "cpu", work).to(deformed.device, deformed.dtype)
