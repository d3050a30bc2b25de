"""What the as-rigid-as-possible energies need to know of a rest shape."""

from typing import Any

import torch
from torch import Tensor

from meshkit.deform.face_edges import FaceEdges
from meshkit.deform.rotation import closest_rotation
from meshkit.deform.topology import ARAPTopology
from meshkit.topology import cotangent_weights

__all__ = ["ARAPRest"]


class ARAPRest:
    r"""Operators of one rest shape v, in float64 on the CPU; they serve any set of handles.

    With :math:`S_i = \tfrac1m \sum_e w_e\, x_e v_e^\top` over the edges of cell i, every edge being in m cells, the
    energy is :math:`E(x) = m\,(x^\top L x + v^\top L v - 2 \sum_i \operatorname{tr}(R_i^\top S_i))`. It is stationary
    where :math:`L x = B^\top R`, B the matrix that takes x to all S.

    Args:
        topology: of the mesh.
        verts: (V, 3) rest positions; treated as constants here.
        degenerate: "raise" refuses edges of length zero and triangles of area zero; "ignore" gives them no stiffness.

    Attributes:
        verts: (V, 3) float64 positions about `origin`, their mean, so that a far origin costs no digits.
        laplacian: (V, V) scipy CSR matrix L, positive semi-definite.
        moments, moments_t: (3K, V) scipy CSR matrix B, whose rows 3i + d give column d of S_i, and its transpose.
        rest_energy: m v^T L v, the energy of collapsing the mesh to a point.
        force_at_rest: (V, 3) L v, which is B^T R where every rotation is the identity.
        edges: of the faces, and which of them count.
        components: (V,) int64 labels of the components that the weights hold together.

    Raises:
        ValueError: `verts` is no floating (V, 3) tensor, or holds NaN or infinity; degenerate faces under "raise".

    Example:
        >>> topology = ARAPTopology(torch.tensor([[0, 1, 2]]), 3)
        >>> round(ARAPRest(topology, torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])).rest_energy, 6)
        3.0
    """

    def __init__(self, topology: ARAPTopology, verts: Tensor, *, degenerate: str = "raise") -> None:
        import numpy as np
        from scipy import sparse

        if verts.shape != (topology.num_verts, 3) or not verts.is_floating_point():
            raise ValueError(
                f"verts must be a floating ({topology.num_verts}, 3) tensor for this topology, "
                f"got {verts.dtype} {tuple(verts.shape)}"
            )
        positions = verts.detach().cpu().double()
        if not torch.isfinite(positions).all():
            raise ValueError("verts holds NaN or infinity at a real vertex")
        self.topology = topology
        self.origin = positions.mean(0)
        self.verts = positions - self.origin
        weights = cotangent_weights(self.verts, topology.faces).numpy()
        v, f = self.verts.numpy(), topology.faces.numpy()
        corners = v[f]
        edges = corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]
        regular = (weights != 0).any(1)
        if degenerate == "raise" and not regular.all():
            _refuse(f, edges, regular)
        kept = topology.kept(weights) & regular[:, None]
        counts = torch.from_numpy(regular), torch.from_numpy(kept)
        self.edges = FaceEdges(topology.faces, topology.cells, topology.membership, topology.multiplicity, *counts)
        weights = weights * kept
        self.laplacian = topology.square.matrix((topology.stiffness @ weights.T).ravel())
        scaled = weights[:, :, None] * edges / topology.multiplicity
        entries = topology.moment @ scaled.transpose(1, 0, 2).reshape(3, -1)
        self.moments, self.moments_t = topology.interleaved.matrices(entries.reshape(-1, 3))
        force = self.laplacian @ v
        self.force_at_rest = torch.from_numpy(force)
        self.rest_energy = topology.multiplicity * float(np.vdot(v, force))
        # An edge opposite two right angles weighs zero and still lies in the cells of spokes and rims.
        joined = weights != 0 if topology.energy == "spokes" else np.broadcast_to(regular[:, None], weights.shape)
        tail, head = f[:, [2, 0, 1]][joined], f[:, [1, 2, 0]][joined]
        joining = sparse.csr_array((np.ones(len(tail)), (tail, head)), shape=self.laplacian.shape)
        self.components = torch.from_numpy(sparse.csgraph.connected_components(joining, directed=False)[1]).long()

    def rotations(self, x: Tensor) -> Tensor:
        """Best rotations (K, 3, 3) for positions (V, 3), in float64."""
        columns = torch.from_numpy(self.moments @ x.detach().cpu().double().numpy()).view(-1, 3, 3)
        return closest_rotation(columns.mT)


def _refuse(faces: Any, edges: Any, regular: Any) -> None:
    """Say which kind of degeneracy there is."""
    bad = faces[~regular]
    advice = 'repair the mesh, or pass degenerate="ignore" to give them no stiffness'
    repeated = int((bad == bad[:, [1, 2, 0]]).any(1).sum())
    if repeated:
        raise ValueError(f"{repeated} faces name a vertex twice; {advice}")
    short = int((edges[~regular] == 0).all(-1).any(-1).sum())
    if short:
        raise ValueError(f"{short} faces have an edge of length zero (two vertices at one place); {advice}")
    raise ValueError(f"{len(bad)} triangles have area zero (three vertices on a line); {advice}")
