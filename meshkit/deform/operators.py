"""Sparse operators of the ARAP energies for a batch of meshes taken as one disjoint union (scipy, float64, CPU)."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.rotation import ClosestRotation
from meshkit.topology import cotangent_weights

__all__ = ["LinearMap", "RestOperators"]


class LinearMap(torch.autograd.Function):
    """A linear map on (N, D) CPU tensors, given as a numpy callable together with its adjoint."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, apply: Callable[[Any], Any], adjoint: Callable[[Any], Any]) -> Tensor:
        """Apply the map."""
        ctx.adjoint = adjoint
        return torch.from_numpy(apply(x.detach().numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """Apply the adjoint."""
        return torch.from_numpy(ctx.adjoint(grad.numpy())), None, None


class RestOperators:
    r"""What the energies need to know of the rest shape v.

    With :math:`S_i = \sum_e w_e\, x_e v_e^\top` over the edges of cell i, and every edge in m cells, the energy is
    :math:`E(x) = m\,(x^\top L x + v^\top L v) - 2 \sum_i \operatorname{tr}(R_i^\top S_i)`; it is stationary in x where
    :math:`m L x = B^\top R`, B the matrix that takes x to all S.

    Attributes:
        laplacian: (N, N) CSR, positive semi-definite.
        moments: (3N, N) CSR, the matrix B; ``(B x).reshape(3, N, 3)`` has the axes (column, cell, row) of S.
        multiplicity: m, 2 for spokes and 3 for spokes and rims.
        rest_energy: (N,) float64, the summands of m v^T L v.
        components: (N,) int64 labels of the components that the weights hold together.
    """

    def __init__(self, verts: Tensor, faces: Tensor, energy: str) -> None:
        import numpy as np
        from scipy import sparse

        weights = cotangent_weights(verts, faces)
        regular = (weights != 0).any(-1)
        v, f, w = verts.numpy(), faces[regular].numpy().astype(np.int32), weights[regular].numpy()
        tail, head = f[:, [1, 2, 0]].ravel(), f[:, [2, 0, 1]].ravel()
        half = sparse.coo_array((w.ravel(), (tail, head)), shape=(len(v), len(v))).tocsr()
        coupling = half + half.T
        if energy == "spokes":
            coupling.data = coupling.data.clip(min=0)
            coupling.eliminate_zeros()
            graph, self.multiplicity, self.moments = coupling, 2, _spokes_moments(v, coupling)
        else:
            # An edge opposite two right angles weighs zero and still lies in the cells: keep the pattern of all edges.
            graph = sparse.csr_array((np.ones_like(half.data), half.indices, half.indptr), shape=half.shape)
            self.multiplicity, self.moments = 3, _rims_moments(v, f, w)
        self.components = torch.from_numpy(sparse.csgraph.connected_components(graph, directed=False)[1]).long()
        self.laplacian = (sparse.diags_array(coupling.sum(1)) - coupling).tocsr()
        self.rest_energy = self.multiplicity * torch.from_numpy((v * (self.laplacian @ v)).sum(1))

    def cell_moments(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """Matrices S, component first: (3, 3, N) in `dtype`."""
        stacked = LinearMap.apply(x, self.moments.__matmul__, self.moments.T.__matmul__)
        return stacked.view(3, -1, 3).permute(2, 0, 1).to(dtype).contiguous()

    def pull_back(self, rotations: Tensor) -> Tensor:
        """B^T R for component-first rotations: (N, 3)."""
        stacked = rotations.permute(1, 2, 0).reshape(-1, 3).double()
        return LinearMap.apply(stacked, self.moments.T.__matmul__, self.moments.__matmul__)

    def energy(self, x: Tensor, guess: Tensor | None = None) -> Tensor:
        """Summands (N,) of the energy with the best rotations; their sum over a mesh is what has a meaning.

        The rotations are at their optimum, so holding them fixed leaves the first derivative exact.
        """
        S = self.cell_moments(x, torch.float64)
        R, _ = ClosestRotation.apply(S.detach(), guess)
        stiffness = LinearMap.apply(x, self.laplacian.__matmul__, self.laplacian.__matmul__)
        return self.multiplicity * (x * stiffness).sum(-1) + self.rest_energy - 2 * (R * S).sum((0, 1))


def _spokes_moments(v: Any, coupling: Any) -> Any:
    """S_i = sum_j w_ij (x_i - x_j)(v_i - v_j)^T over the neighbours j."""
    import numpy as np
    from scipy import sparse

    row = np.repeat(np.arange(len(v)), np.diff(coupling.indptr))
    edges = coupling.data[:, None] * (v[row] - v[coupling.indices])
    columns = [sparse.csr_array((e, coupling.indices, coupling.indptr), shape=coupling.shape) for e in edges.T]
    return sparse.vstack([sparse.diags_array(c.sum(1)) - c for c in columns], format="csr")


def _rims_moments(v: Any, f: Any, w: Any) -> Any:
    """S_i = sum over the faces f around i of M_f, M_f = sum_k w_fk x_e v_e^T over the three edges of f."""
    import numpy as np
    from scipy import sparse

    corners = v[f]
    to_next, to_previous = corners - corners[:, [1, 2, 0]], corners - corners[:, [2, 0, 1]]
    # Each corner a is on the edge to the next corner (opposite a + 2) and on the one to the previous (opposite a + 1).
    gradient = w[:, [2, 0, 1], None] * to_next + w[:, [1, 2, 0], None] * to_previous
    indices, indptr = f.ravel(), np.arange(0, f.size + 1, 3, dtype=np.int32)
    shape = (len(f), len(v))
    around = sparse.csr_array((np.ones(f.size), indices, indptr), shape=shape).T.tocsr()
    columns = [sparse.csr_array((gradient[..., d].ravel(), indices, indptr), shape=shape) for d in range(3)]
    return sparse.vstack([around @ column for column in columns], format="csr")
