"""The energies of a whole batch of meshes on one device, without a loop over the meshes."""

import warnings
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit.deform.batched_rotation import BatchedRotation
from meshkit.deform.topology import local_templates
from meshkit.topology import cotangent_weights

__all__ = ["BatchedEnergy", "linear"]


class BatchedEnergy:
    r"""Operators of the rest shapes of a batch, in float64; the batched counterpart of `ARAPTopology` and `ARAPRest`.

    Vertices of all meshes are numbered through, b V + i; so are cells. The block-diagonal matrices are sparse, and one
    product serves all meshes. As in :class:`~meshkit.deform.ARAPRest`, everything is over m, the number of cells that
    hold an edge.

    Args:
        verts: (B, V, 3) rest positions; treated as constants.
        faces: (B, F, 3) int64, padding -1, valid for V.
        mask: (B, V) bool, True at real vertices.
        energy: see :func:`~meshkit.deform.arap_energy`.

    Attributes:
        origin: (B, 1, 3) mean of the real vertices.
        rest: (B, V, 3) positions about it, 0 at padding.
        regular: (B, F) bool, faces that have an area.
        kept: (B, F, 3) bool, half cotangents that count.
        corners, cells: (B, F, 3) vertices, and (B, F, 3 or 1) cells, of the faces, numbered through.
        rows, cols, values: entries of the Laplacian.
        moments, moments_t: (3K, BV) sparse matrix to the columns of S, and its transpose.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor, energy: str) -> None:
        self.batch, self.size = verts.shape[:2]
        self.energy = energy
        count, device = self.batch * self.size, verts.device
        real = mask[..., None]
        positions = torch.where(real, verts.detach().double(), 0.0)
        self.origin = positions.sum(1, keepdim=True) / real.sum(1, keepdim=True).clamp_min(1)
        self.rest = torch.where(real, positions - self.origin, 0.0)
        self.faces = faces
        start = self.size * torch.arange(self.batch, device=device)[:, None, None]
        self.corners = faces.clamp_min(0) + start
        weights = cotangent_weights(self.rest, faces)
        self.regular = (weights != 0).any(-1)
        self.kept = self.regular[..., None].expand_as(weights)
        if energy == "spokes":
            self.kept = self.kept & self._positive_edges(weights)
        weights = torch.where(self.kept, weights, 0.0)
        per_face = energy == "elements"
        faces_in_all = faces.shape[0] * faces.shape[1]
        self.cells = torch.arange(faces_in_all, device=device).view(*faces.shape[:2], 1) if per_face else self.corners
        self.num_cells = faces_in_all if per_face else count
        templates = local_templates(energy, device)
        self.multiplicity, self.membership = templates.multiplicity, templates.membership
        # Every vertex gets an entry on the diagonal, isolated ones too.
        entries = torch.cat([(weights @ templates.stiffness.T).flatten(), weights.new_zeros(count)])
        own = torch.arange(count, device=device)
        rows = torch.cat([self.corners.repeat_interleave(3, 2).flatten(), own])
        cols = torch.cat([self.corners.repeat(1, 1, 3).flatten(), own])
        self.rows, self.cols, values = _summed(rows, cols, entries[:, None], (count, count))
        self.values = values[:, 0]
        scaled = weights[..., None] * self.edges(self.rest) / self.multiplicity
        places = self.cells.repeat_interleave(3, 2), self.corners.repeat(1, 1, self.cells.shape[2])
        rows, cols, values = _summed(*places, templates.moment @ scaled, (self.num_cells, count))
        # Component d of cell k in row d K + k
        shift = self.num_cells * torch.arange(3, device=device)[:, None]
        rows, cols, values = (rows + shift).flatten(), cols.repeat(3), values.T.flatten()
        self.moments = csr(rows, cols, values, (3 * self.num_cells, count))
        order = torch.argsort(cols * (3 * self.num_cells) + rows)
        self.moments_t = csr(cols[order], rows[order], values[order], (count, 3 * self.num_cells))

    def _positive_edges(self, weights: Tensor) -> Tensor:
        """Whether the half cotangents of an edge, over all its faces, have a positive sum."""
        ends = torch.stack([self.corners.roll(-1, 2), self.corners.roll(-2, 2)])
        key = ends.amin(0) * (self.batch * self.size) + ends.amax(0)
        distinct, inverse = torch.unique(key.flatten(), return_inverse=True)
        total = weights.new_zeros(len(distinct)).index_add_(0, inverse, weights.flatten())
        return (total > 0)[inverse].view(weights.shape)

    def edges(self, positions: Tensor) -> Tensor:
        """Edge vectors (B, F, 3, 3) of positions (B, V, 3), edge k opposite corner k."""
        corners = positions.flatten(0, 1)[self.corners]
        return corners.roll(-1, 2) - corners.roll(-2, 2)

    def per_mesh(self, values: Tensor) -> Tensor:
        """Sum over each mesh of values (BV, 3): (B,)."""
        return values.view(self.batch, -1).sum(1)

    @cached_property
    def components(self) -> Tensor:
        """(BV,) a label for every connected component: the number of one of its vertices."""
        joined = self.kept if self.energy == "spokes" else self.regular[..., None].expand_as(self.kept)
        tail, head = self.corners.roll(-1, 2), self.corners.roll(-2, 2)
        # An edge that joins nothing becomes a loop.
        tail, head = tail.flatten(), torch.where(joined, head, tail).flatten()
        label = torch.arange(self.batch * self.size, device=tail.device)
        while True:
            before = label
            for _ in range(4):  # rounds between two looks at the result, each of which waits for the device
                low = torch.minimum(label[tail], label[head])
                for place in (label[tail], label[head], tail, head):
                    label = label.scatter_reduce(0, place, low, "amin")
                label = label[label]
            if torch.equal(label, before):
                return label

    def matrices(self, x: Tensor) -> Tensor:
        """S (K, 3, 3) of positions (BV, 3); differentiable."""
        stacked = linear(x, self.moments.matmul, self.moments_t.matmul)
        return stacked.view(3, -1, 3).permute(1, 2, 0)

    def pulled_back(self, rotations: Tensor) -> Tensor:
        """B^T R (BV, 3); differentiable."""
        stacked = rotations.permute(2, 0, 1).reshape(-1, 3)
        return linear(stacked, self.moments_t.matmul, self.moments.matmul)

    def rotations(self, x: Tensor) -> Tensor:
        """Best rotations (K, 3, 3); differentiable."""
        return BatchedRotation.apply(self.matrices(x).contiguous())

    def mean_rotations(self, rotations: Tensor) -> Tensor:
        """Mean (B, F, 3, 3, 3) over the cells that hold each edge (axis 2) of a face."""
        around = rotations[self.cells].flatten(3)
        return (self.membership.T @ around).unflatten(3, (3, 3)) / self.multiplicity


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, apply: Any, adjoint: Any) -> Tensor:
        ctx.adjoint = adjoint
        return apply(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return ctx.adjoint(grad.contiguous()), None, None


def linear(x: Tensor, apply: Any, adjoint: Any) -> Tensor:
    """Apply a linear map given together with its adjoint."""
    result: Tensor = _Linear.apply(x, apply, adjoint)
    return result


def csr(rows: Tensor, cols: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Sparse matrix of entries sorted by row, then column."""
    pointers = torch.searchsorted(rows, torch.arange(shape[0] + 1, device=rows.device))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
        place = values.device
        return torch.sparse_csr_tensor(pointers, cols, values, size=shape, device=place, check_invariants=False)


def _summed(rows: Tensor, cols: Tensor, values: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Add up entries (..., D) at equal places; sorted by row, then column."""
    keys, inverse = torch.unique((rows * shape[1] + cols).flatten(), return_inverse=True)
    summed = values.new_zeros(len(keys), values.shape[-1]).index_add_(0, inverse, values.flatten(0, -2))
    return keys // shape[1], keys % shape[1], summed
