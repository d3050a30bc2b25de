"""The face of a coarse surface to which each vertex of a fine one belongs."""

import numpy as np
import torch

from meshkit.io._mesh import Indices, Points, area_vectors, directed_edges
from meshkit.topology import vertex_normals

_NORMAL_WEIGHT = 0.03  # a right angle between normals counts as this fraction of the bounding-box diagonal


def nearest_faces(
    points: Points, triangles: Indices, coarse: Points, coarse_triangles: Indices
) -> tuple[Indices, Points]:
    """Coarse face (V,) and barycentric weights (V, 3) of each fine vertex."""
    import igl
    from scipy.sparse import coo_matrix

    diagonal = float(np.linalg.norm(np.ptp(coarse, axis=0)))
    _, face, foot = igl.point_mesh_squared_distance(points, coarse, coarse_triangles)
    face, foot = np.atleast_1d(face).astype(np.int64), np.asarray(foot).reshape(-1, 3)
    weights = _closest(foot, coarse[coarse_triangles[face]])[0]

    nearest = _nearest_along_surface(points, triangles, coarse, coarse_triangles, diagonal)
    reached = np.flatnonzero(nearest >= 0)
    if len(reached) == 0:
        return face, weights
    count = len(coarse_triangles)
    corner = (np.ones(3 * count), (coarse_triangles.reshape(-1), np.repeat(np.arange(count), 3)))
    incidence = coo_matrix(corner, shape=(len(coarse), count)).tocsr()
    around = ((incidence @ incidence.T) @ incidence).tocsr()  # faces at a vertex or at one of its neighbours
    # A vertex keeps its nearest face in space if that is among them and turned the same way.
    doubled = area_vectors(coarse, coarse_triangles)
    coarse_normals = doubled / np.maximum(np.linalg.norm(doubled, axis=1), np.finfo(float).tiny)[:, None]
    normals = _normals(points, triangles)
    turned_alike = (coarse_normals[face[reached]] * normals[reached]).sum(1) > 0
    astray = reached[~turned_alike | (np.asarray(around[nearest[reached], face[reached]]).reshape(-1) == 0)]
    pairs = around[nearest[astray]].tocoo()
    if pairs.nnz:
        fine = astray[pairs.row]
        candidate, distance = _closest(points[fine], coarse[coarse_triangles[pairs.col]])
        cosine = (coarse_normals[pairs.col] * normals[fine]).sum(1)
        order = np.lexsort((distance + (_NORMAL_WEIGHT * diagonal) ** 2 * (-cosine).clip(0), fine))
        first = order[np.flatnonzero(np.diff(fine[order], prepend=-1))]
        face[fine[first]], weights[fine[first]] = pairs.col[first], candidate[first]
    return face, weights


def _normals(points: Points, triangles: Indices) -> Points:
    return np.asarray(vertex_normals(torch.from_numpy(points), torch.from_numpy(triangles)).numpy())


def _nearest_along_surface(
    points: Points, triangles: Indices, coarse: Points, coarse_triangles: Indices, diagonal: float
) -> Indices:
    """Coarse vertex nearest to each fine vertex along the fine surface (V,), -1 where none is reachable.

    Every coarse vertex starts from the fine vertex nearest to it in place and normal.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    def with_normals(p: Points, t: Indices) -> Points:
        return np.concatenate([p, _NORMAL_WEIGHT * diagonal * _normals(p, t)], axis=1)

    # Loose vertices start nowhere and are reached by nothing.
    nearest = np.full(len(points), -1, dtype=np.int64)
    used, coarse_used = (
        np.unique(t[(np.diff(np.sort(t, 1), axis=1) > 0).all(1)]) for t in (triangles, coarse_triangles)
    )
    if len(used) == 0:
        return nearest
    tree = cKDTree(with_normals(points, triangles)[used])
    gap, start = tree.query(with_normals(coarse, coarse_triangles)[coarse_used])
    closest_first = np.argsort(gap, kind="stable")  # where several start from one vertex, the closest counts
    coarse_used, start = coarse_used[closest_first], used[start[closest_first]]
    starts, first = np.unique(start, return_index=True)
    ends = directed_edges(triangles)
    length = np.maximum(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1), 1e-12 * diagonal)
    graph = coo_matrix((length, (ends[:, 0], ends[:, 1])), shape=(len(points),) * 2).tocsr()
    graph = graph.maximum(graph.T)
    distance, _, source = dijkstra(graph, directed=False, indices=starts, min_only=True, return_predecessors=True)
    reached = np.isfinite(distance)
    nearest[reached] = coarse_used[first[np.searchsorted(starts, source[reached])]]
    return nearest


def _closest(query: Points, corners: Points) -> tuple[Points, Points]:
    """Barycentric weights (P, 3) of the point of each triangle (P, 3, 3) closest to its query, squared distance (P,).

    Equation: the foot of the perpendicular if it lies inside, else the best of the three edges.
    """
    best = np.zeros((len(query), 3))
    shortest = np.full(len(query), np.inf)

    def offer(weights: Points, allowed: np.ndarray) -> None:
        distance = ((query - np.einsum("pk,pkc->pc", weights, corners)) ** 2).sum(1)
        better = allowed & (distance < shortest)
        best[better], shortest[better] = weights[better], distance[better]

    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        length = np.maximum(((b - a) ** 2).sum(1), np.finfo(float).tiny)
        t = (((query - a) * (b - a)).sum(1) / length).clip(0, 1)
        weights = np.zeros_like(best)
        weights[:, k], weights[:, (k + 1) % 3] = 1 - t, t
        offer(weights, np.ones(len(query), dtype=bool))
    u, v, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], query - corners[:, 0]
    uu, uv, vv, du, dv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1), (d * u).sum(1), (d * v).sum(1)
    squared_area = uu * vv - uv * uv
    regular = squared_area > 1e-14 * uu * vv
    safe = np.where(regular, squared_area, 1.0)
    second, third = (vv * du - uv * dv) / safe, (uu * dv - uv * du) / safe
    inner = np.stack([1 - second - third, second, third], axis=1)
    offer(inner, regular & (inner >= 0).all(1))
    return best, shortest
