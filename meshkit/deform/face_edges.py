"""Sums over the edges of the faces: the energy itself, and how its minimum moves with the rest shape."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["EnergyOfMeshes", "FaceEdges"]


@dataclass(frozen=True)
class FaceEdges:
    """The edges of the faces, the cells that hold them, and which of them count.

    A batch is one mesh here, its vertices, faces and cells numbered through. Edge k of a face is opposite corner k.
    Vectors are stored coordinate first, (3, 3, F) as (coordinate, edge, face), an order that suits elementwise work;
    rotations (3, 3, K) as (column, row, cell).

    Attributes:
        faces: (F, 3) vertices; any valid ones at padding.
        cells: (F, C) cells that hold edges of a face.
        membership: (C, 3), 1 where cell c of a face holds its edge k.
        multiplicity: m, the number of cells that hold an edge.
        regular: (F,) bool, faces that have an area.
        kept: (F, 3) bool, half cotangents that count; of regular faces only.
    """

    faces: Tensor
    cells: Tensor
    membership: Tensor
    multiplicity: int
    regular: Tensor
    kept: Tensor

    def vectors(self, positions: Tensor) -> Tensor:
        """Edge vectors of positions (V, 3)."""
        corners = positions.T.contiguous().index_select(1, self.faces.T.flatten()).unflatten(1, (3, -1))
        return torch.stack([corners[:, k - 2] - corners[:, k - 1] for k in range(3)], 1)

    def weights(self, vectors: Tensor) -> Tensor:
        """Half cotangents (3, F) that count, from the edges alone."""
        x0, y0, z0 = vectors[:, 0]
        x1, y1, z1 = vectors[:, 1]
        squared = (y0 * z1 - z0 * y1).square() + (z0 * x1 - x0 * z1).square() + (x0 * y1 - y0 * x1).square()
        doubled = torch.where(self.regular, squared, 1.0).sqrt()  # the area
        dots = torch.stack([(vectors[:, k - 2] * vectors[:, k - 1]).sum(0) for k in range(3)])
        return torch.where(self.kept.T, -0.5 * dots / doubled, 0.0)

    def energies(self, verts: Tensor, deformed: Tensor, rotations: Tensor) -> Tensor:
        """Energy (F,) of the edges of each face, for given rotations; differentiable in the positions."""
        before, after = self.vectors(verts), self.vectors(deformed)
        squares = torch.zeros_like(before[0])
        for cell, held in zip(self.cells.T, self.membership, strict=True):
            turned = (rotations.index_select(2, cell)[:, :, None] * before[:, None]).sum(0)
            squares = squares + held[:, None] * (after - turned).square().sum(0)
        return (self.weights(before) * squares).sum(0)

    def mean_rotations(self, rotations: Tensor) -> Tensor:
        """Sum over the cells of each edge, over m: float64 (3, 3, 3, F), or (3, 3, 1, F) where a face has one value.

        The axes of the result are (column, row, edge, face).
        """
        around = [rotations.index_select(2, cell).double() for cell in self.cells.T]
        total = torch.stack(around).sum(0)[:, :, None]
        if len(around) == self.multiplicity:  # every cell of a face holds all its edges
            return total / self.multiplicity
        return (total - torch.stack(around, 2)) / self.multiplicity

    def stationarity_gradient(
        self, verts: Tensor, x: Tensor, adjoint: Tensor, rotations: Tensor, change: Tensor
    ) -> Tensor:
        r"""Gradient with respect to v of :math:`\lambda \cdot (L x - B^\top R)`, the change of the rotations included.

        That change of R is :math:`D[dS]` with D self-adjoint, so
        :math:`\lambda\cdot(L x - B^\top R) - D[B\lambda]\cdot Bx` has the wanted derivative while R and D[Bλ] are held
        fixed. It is a sum over the edges e of the faces,

        .. math:: \sum_e w_e \bigl(\lambda_e \cdot x_e
                  - (\bar R^\top \lambda_e + \overline{D[B\lambda]}^\top x_e) \cdot v_e\bigr)

        Args:
            verts: (V, 3) rest positions v.
            x: (V, 3) positions.
            adjoint: (V, 3) the vector λ.
            rotations: (3, 3, K) R at x.
            change: (3, 3, K) D[Bλ].

        Returns:
            (V, 3).
        """
        moved, along = self.vectors(x), self.vectors(adjoint)
        image = (self.mean_rotations(rotations) * along).sum(1) + (self.mean_rotations(change) * moved).sum(1)
        work = (along * moved).sum(0)
        with torch.enable_grad():
            v = self.vectors(verts).requires_grad_()
            value = (self.weights(v) * (work - (image * v).sum(0))).sum()
        (edges,) = torch.autograd.grad(value, v)
        corners = torch.stack([edges[:, k - 1] - edges[:, k - 2] for k in range(3)], 1)
        gathered = verts.new_zeros(3, len(verts))
        return gathered.index_add_(1, self.faces.T.flatten(), corners.flatten(1)).T


class EnergyOfMeshes(torch.autograd.Function):
    """Energies (B,) for the best rotations. Held fixed, these give the right first derivatives, not second ones."""

    @staticmethod
    def forward(ctx: Any, verts: Tensor, deformed: Tensor, edges: FaceEdges, rotations: Tensor, batch: int) -> Tensor:
        """Evaluate, and differentiate at once; the vertices and faces (BF, 3) of a batch are numbered through."""
        inputs = verts.detach().requires_grad_(), deformed.detach().requires_grad_()
        with torch.enable_grad():
            energies = edges.energies(*inputs, rotations)
            total = energies.sum()
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*torch.autograd.grad(total, inputs))
        return energies.detach().view(batch, len(energies) // batch).sum(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        """Scale the gradients."""
        to_verts, to_deformed = ctx.saved_tensors
        scale = grad.repeat_interleave(len(to_verts) // len(grad))[:, None]
        return scale * to_verts, scale * to_deformed, None, None, None
