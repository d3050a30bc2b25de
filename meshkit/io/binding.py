"""Carry a deformation from a coarse surface to a fine one that lies close to it."""

from functools import partial

import numpy as np
import torch
from torch import Tensor

from meshkit.io._mesh import Indices, Points, area_vectors, as_arrays, directed_edges
from meshkit.io._nearest_face import nearest_faces
from meshkit.topology import cotangent_weights, mass_matrix

__all__ = ["SurfaceBinding"]

_SMOOTHING = 0.2  # smoothing length over the mean edge of the coarse surface


class SurfaceBinding:
    r"""A fine surface bound to a coarse one: bend the coarse surface, and the fine one follows with its detail.

    Every fine vertex is bound to a face of the coarse surface near it, with barycentric weights :math:`w_k`. When the
    coarse vertices move from :math:`c_k` to :math:`c'_k`, each of them carries an affine map: the mean, by area, of the
    deformation gradients of the faces around it, whose third axis is the unit normal. A fine vertex takes the mean of
    the three maps at its face,

    .. math:: v' = \sum_k w_k \bigl(c'_k + A_k (v - c_k)\bigr), \qquad A_v = \sum_k w_k A_k,

    and the result :math:`v'` is then smoothed over a fifth of a coarse edge :math:`h`, towards a surface whose edges
    are the old edges bent by these maps, so that the facets of the coarse surface do not show:

    .. math:: \min_x \; \sum_{ij} \omega_{ij} \lVert x_i - x_j - \tfrac12 (A_i + A_j)(v_i - v_j) \rVert^2
              + \frac{25}{h^2} \sum_i m_i \lVert x_i - v'_i \rVert^2

    with cotangent weights (negative ones taken as 0) and vertex areas :math:`m`. Any affine motion of the coarse
    surface is followed exactly but along the normal, which keeps its length.

    The face is sought along the fine surface: only around the coarse vertex that is nearest in geodesic distance, and
    not turned the other way. So a finger is not bound to the finger beside it. Where no coarse vertex is reachable (a
    separate part that the coarse surface lacks), the nearest face in space is taken.

    Args:
        verts: (V, 3) fine vertices.
        faces: (F, 3) their faces.
        coarse_verts: (N, 3) coarse vertices, in the same place and unit.
        coarse_faces: (G, 3) their faces, oriented.

    Attributes:
        face: (V,) coarse face of each fine vertex.
        weights: (V, 3) float64 barycentric weights in it.

    Raises:
        ValueError: wrong shapes or types, no vertices or faces, an index out of range, coordinates that are not finite,
            or a coarse surface without area.

    Reference:
        Sumner and Popovic, "Deformation Transfer for Triangle Meshes" (deformation gradients); Sumner, Schmid and
        Pauly, "Embedded Deformation for Shape Manipulation" (blending affine maps).

    Example:
        >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> two = torch.tensor([[0, 1, 2], [0, 2, 3]])
        >>> fine = torch.tensor([[0.2, 0.1, 0.1], [0.7, 0.2, 0.1], [0.6, 0.8, 0.1]])
        >>> binding = SurfaceBinding(fine, torch.tensor([[0, 1, 2]]), square, two)
        >>> turned = square[:, [1, 0, 2]] * torch.tensor([-1.0, 1, 1])  # a quarter turn about z
        >>> binding.carry(turned).allclose(fine[:, [1, 0, 2]] * torch.tensor([-1.0, 1, 1]), atol=1e-6)
        True
    """

    def __init__(self, verts: Tensor, faces: Tensor, coarse_verts: Tensor, coarse_faces: Tensor) -> None:
        self._points, self._triangles = as_arrays(verts, faces)
        self._coarse, self._coarse_triangles = as_arrays(coarse_verts, coarse_faces)
        doubled = area_vectors(self._coarse, self._coarse_triangles)
        if not (doubled != 0).any():
            raise ValueError("the coarse surface has no area: nothing can be bound to it")
        face, weights = nearest_faces(self._points, self._triangles, self._coarse, self._coarse_triangles)
        self.face, self.weights = torch.from_numpy(face), torch.from_numpy(weights)
        self._inverse_frames, self._areas = _inverse_frames(self._coarse, self._coarse_triangles)
        self._smoother = _Smoother(self._points, self._triangles, self._coarse, self._coarse_triangles)

    def carry(self, coarse_verts: Tensor) -> Tensor:
        """Fine vertices of a deformed coarse surface. Not differentiable.

        Args:
            coarse_verts: (N, 3) deformed coarse vertices.

        Returns:
            (V, 3) deformed fine vertices, of the dtype and on the device of ``coarse_verts``.

        Raises:
            ValueError: another number of vertices than were bound, or coordinates that are not finite.
        """
        if coarse_verts.shape != self._coarse.shape:
            raise ValueError(
                f"the binding is to {len(self._coarse)} coarse vertices, got a tensor of shape "
                f"{tuple(coarse_verts.shape)}"
            )
        moved = coarse_verts.detach().cpu().double().numpy()
        if not np.isfinite(moved).all():
            raise ValueError(f"{int((~np.isfinite(moved)).any(1).sum())} coarse vertices are NaN or infinite")
        maps = self._vertex_maps(moved)
        corner, weights = self._coarse_triangles[self.face.numpy()], self.weights.numpy()
        offset = np.einsum("vkij,vkj->vki", maps[corner], self._points[:, None] - self._coarse[corner])
        follow = np.einsum("vk,vkc->vc", weights, offset + moved[corner])
        follow = self._smoother.smooth(follow, np.einsum("vk,vkij->vij", weights, maps[corner]))
        return torch.from_numpy(follow).to(coarse_verts)

    def _vertex_maps(self, moved: Points) -> Points:
        """Affine map at every coarse vertex (N, 3, 3)."""
        gradients = _frames(moved, self._coarse_triangles)[0] @ self._inverse_frames
        corner = self._coarse_triangles.reshape(-1)
        total = np.bincount(corner, np.repeat(self._areas, 3), len(moved))
        weighted = np.repeat((gradients * self._areas[:, None, None]).reshape(-1, 9), 3, axis=0)
        sums = np.stack([np.bincount(corner, column, len(moved)) for column in weighted.T], axis=1)
        known = total > 0
        maps = np.tile(np.eye(3), (len(moved), 1, 1))
        maps[known] = (sums[known] / total[known, None]).reshape(-1, 3, 3)
        return maps


class _Smoother:
    """The least-squares problem of the docstring above."""

    def __init__(self, points: Points, triangles: Indices, coarse: Points, coarse_triangles: Indices) -> None:
        from scipy.sparse import coo_matrix, diags

        verts, faces = torch.from_numpy(points), torch.from_numpy(triangles)
        half_cotangents = cotangent_weights(verts, faces).numpy()
        i, j = triangles[:, [1, 2, 0]].reshape(-1), triangles[:, [2, 0, 1]].reshape(-1)
        size = (len(points), len(points))
        adjacency = coo_matrix((half_cotangents.reshape(-1), (i, j)), shape=size).tocsr()
        adjacency = (adjacency + adjacency.T).maximum(0).tocoo()
        self._i, self._j, self._weight = adjacency.row, adjacency.col, adjacency.data
        self._edges = points[self._i] - points[self._j]
        stiffness = diags(np.asarray(adjacency.sum(1)).reshape(-1)) - adjacency
        ends = directed_edges(coarse_triangles)
        mean_edge = np.linalg.norm(coarse[ends[:, 0]] - coarse[ends[:, 1]], axis=1).mean()
        mass = mass_matrix(verts, faces, kind="barycentric").numpy()
        # A vertex without area stays where its face carries it.
        self._pull = np.maximum(mass, 1e-9 * (mass.max() or 1.0)) / (_SMOOTHING * mean_edge) ** 2
        self._matrix = (stiffness + diags(self._pull)).tocsr()
        self._preconditioner = diags(1 / self._matrix.diagonal())

    def smooth(self, target: Points, maps: Points) -> Points:
        from scipy.sparse.linalg import cg

        bent = np.einsum("eij,ej->ei", (maps[self._i] + maps[self._j]) / 2, self._edges) * self._weight[:, None]
        pulls = np.stack([np.bincount(self._i, column, len(target)) for column in bent.T], axis=1)
        right = pulls + self._pull[:, None] * target
        # The pull is strong, so that some ten steps from the target are enough, on meshes of any size.
        solve = partial(cg, self._matrix, M=self._preconditioner, rtol=1e-8, maxiter=500)
        return np.stack([solve(right[:, k], x0=target[:, k])[0] for k in range(3)], axis=1)


def _frames(points: Points, triangles: Indices) -> tuple[Points, Points]:
    """Columns first edge, second edge, unit normal of every face (F, 3, 3), and the doubled areas (F,)."""
    normal = area_vectors(points, triangles)
    doubled = np.linalg.norm(normal, axis=1)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    unit = normal / np.maximum(doubled, np.finfo(float).tiny)[:, None]
    return np.stack([b - a, c - a, unit], axis=2), doubled


def _inverse_frames(points: Points, triangles: Indices) -> tuple[Points, Points]:
    """Inverses of the frames, 0 with weight 0 where a face has no area to speak of."""
    frames, doubled = _frames(points, triangles)
    longest = (frames[:, :, :2] ** 2).sum(1).max(1)
    regular = doubled > 1e-8 * longest
    inverse = np.zeros_like(frames)
    inverse[regular] = np.linalg.inv(frames[regular])
    return inverse, np.where(regular, doubled, 0.0)
