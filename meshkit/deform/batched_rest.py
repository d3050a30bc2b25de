"""The rest shapes of a whole batch of meshes on one device, without a loop over the meshes."""

from functools import cached_property

import torch
from torch import Tensor

from meshkit.deform.batched_rotation import BatchedRotation
from meshkit.deform.face_edges import FaceEdges
from meshkit.deform.sparse import csr, linear
from meshkit.deform.topology import local_templates
from meshkit.topology import cotangent_weights

__all__ = ["BatchedRest"]


class BatchedRest:
    r"""Operators of the rest shapes of a batch, in float64; the batched counterpart of `ARAPTopology` and `ARAPRest`.

    Vertices of all meshes are numbered through, b V + i; so are cells. The block-diagonal matrices are sparse, and one
    product serves all meshes. As in :class:`~meshkit.deform.ARAPRest`, everything is over m, the number of cells that
    hold an edge. The patterns are found anew by sorting on the device: there each batch has faces of its own, and
    `ARAPTopology`, which prepares one mesh for many rest shapes, would bring every one to the host.

    Args:
        verts: (B, V, 3) rest positions; treated as constants.
        faces: (B, F, 3) int64, padding -1, valid for V.
        mask: (B, V) bool, True at real vertices.
        energy: see :func:`~meshkit.deform.arap_energy`.

    Attributes:
        origin: (B, 1, 3) mean of the real vertices.
        verts: (BV, 3) positions about it, 0 at padding.
        force_at_rest: (BV, 3) the Laplacian times these.
        edges: of the faces, numbered through.
        rows, cols, values: entries of the Laplacian.
        moments, moments_t: (3K, BV) sparse matrix to the columns of S, column d of cell k in row d K + k; and its
            transpose.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor, energy: str) -> None:
        self.batch, self.size = verts.shape[:2]
        count, device = self.batch * self.size, verts.device
        real = mask[..., None]
        positions = torch.where(real, verts.detach().double(), 0.0)
        self.origin = positions.sum(1, keepdim=True) / real.sum(1, keepdim=True).clamp_min(1)
        centred = torch.where(real, positions - self.origin, 0.0)
        self.verts = centred.flatten(0, 1)
        start = self.size * torch.arange(self.batch, device=device)[:, None, None]
        corners = (faces.clamp_min(0) + start).flatten(0, 1)
        weights = cotangent_weights(centred, faces).flatten(0, 1)
        regular = (weights != 0).any(1)
        kept = regular[:, None].expand_as(weights)
        if energy == "spokes":
            kept = kept & _positive_edges(corners, weights, count)
        per_face = energy == "elements"
        cells = torch.arange(len(corners), device=device)[:, None] if per_face else corners
        self.num_cells = len(corners) if per_face else count
        templates = local_templates(energy, device)
        self.multiplicity = templates.multiplicity
        self.edges = FaceEdges(corners, cells, templates.membership, self.multiplicity, regular, kept)
        self._joined = kept if energy == "spokes" else regular[:, None].expand_as(kept)
        weights = torch.where(kept, weights, 0.0)
        # Every vertex gets an entry on the diagonal, isolated ones too.
        entries = torch.cat([(weights @ templates.stiffness.T).flatten(), weights.new_zeros(count)])
        own = torch.arange(count, device=device)
        rows = torch.cat([corners.repeat_interleave(3, 1).flatten(), own])
        cols = torch.cat([corners.repeat(1, 3).flatten(), own])
        self.rows, self.cols, values = _summed(rows, cols, entries[:, None], (count, count))
        self.values = values[:, 0]
        self.force_at_rest = csr(self.rows, self.cols, self.values, (count, count)) @ self.verts
        scaled = weights[..., None] * self.edges.vectors(self.verts).permute(2, 1, 0) / self.multiplicity
        places = cells.repeat_interleave(3, 1), corners.repeat(1, cells.shape[1])
        rows, cols, values = _summed(*places, templates.moment @ scaled, (self.num_cells, count))
        shift = self.num_cells * torch.arange(3, device=device)[:, None]
        rows, cols, values = (rows + shift).flatten(), cols.repeat(3), values.T.flatten()
        self.moments = csr(rows, cols, values, (3 * self.num_cells, count))
        order = torch.argsort(cols * (3 * self.num_cells) + rows)
        self.moments_t = csr(cols[order], rows[order], values[order], (count, 3 * self.num_cells))

    @cached_property
    def components(self) -> Tensor:
        """(BV,) a label for every connected component: the number of one of its vertices."""
        tail, head = self.edges.faces.roll(-1, 1), self.edges.faces.roll(-2, 1)
        # An edge that joins nothing becomes a loop.
        tail, head = tail.flatten(), torch.where(self._joined, head, tail).flatten()
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
        return stacked.view(3, -1, 3).permute(1, 2, 0).contiguous()

    def rotations(self, x: Tensor) -> Tensor:
        """Best rotations (K, 3, 3); differentiable."""
        rotations: Tensor = BatchedRotation.apply(self.matrices(x))
        return rotations


def _positive_edges(corners: Tensor, weights: Tensor, count: int) -> Tensor:
    """Whether the half cotangents of an edge, over all its faces, have a positive sum."""
    ends = torch.stack([corners.roll(-1, 1), corners.roll(-2, 1)])
    key = ends.amin(0) * count + ends.amax(0)
    distinct, inverse = torch.unique(key.flatten(), return_inverse=True)
    total = weights.new_zeros(len(distinct)).index_add_(0, inverse, weights.flatten())
    return (total > 0)[inverse].view(weights.shape)


def _summed(rows: Tensor, cols: Tensor, values: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Add up entries (..., D) at equal places; sorted by row, then column."""
    keys, inverse = torch.unique((rows * shape[1] + cols).flatten(), return_inverse=True)
    summed = values.new_zeros(len(keys), values.shape[-1]).index_add_(0, inverse, values.flatten(0, -2))
    return keys // shape[1], keys % shape[1], summed
