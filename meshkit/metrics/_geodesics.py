"""Geodesic distances between many pairs of vertices of one mesh.

The exact distance of a pair needs only the part of the mesh that its shortest path can touch. With D the length of a
path along edges, a point p of the shortest path has |p - s| + |p - t| <= D, so the vertices of the faces around it lie
in that ellipsoid enlarged by twice their longest edge. For good matches these patches have a few faces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    import numpy as np

_SOURCES = 256  # rows of path lengths held at once


def geodesic_distances(verts: Tensor, faces: Tensor, first: Tensor, second: Tensor, *, exact: bool) -> Tensor:
    """Distances ``(P,)`` on the mesh between vertices ``first`` and ``second (P,)``; infinite between components.

    Args:
        verts: ``(V, 3)``.
        faces: ``(F, 3)`` without padding.
        first: ``(P,)`` vertex indices.
        second: ``(P,)``, where heat starts from.
        exact: by the exact method of libigl, else by its heat method.
    """
    pairs = torch.stack([second, first], 1)
    if exact:
        pairs = pairs.sort(1).values  # the heat method is not symmetric
    unique, inverse = torch.unique(pairs, dim=0, return_inverse=True)
    positions, triangles = verts.detach().double().cpu().numpy(), faces.long().cpu().numpy()
    find = _exact if exact else _heat
    found = find(positions, triangles, unique.cpu().numpy())
    return torch.from_numpy(found).to(verts.device)[inverse]


def _exact(verts: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    import numpy as np
    from igl import exact_geodesic

    graph, longest = _edge_graph(verts, faces)
    along_edges = _path_lengths(graph, verts, pairs)
    straight = np.linalg.norm(verts[pairs[:, 0]] - verts[pairs[:, 1]], axis=1)
    distances = along_edges.copy()
    nothing = np.empty(0, dtype=np.int64)
    # A path as short as the straight line is the shortest one.
    for i in np.flatnonzero(np.isfinite(along_edges) & (along_edges > straight * (1 + 1e-12))):
        to_ends = np.linalg.norm(verts - verts[pairs[i, 0]], axis=1) + np.linalg.norm(
            verts - verts[pairs[i, 1]], axis=1
        )
        inside = to_ends <= along_edges[i] * (1 + 1e-9) + 2 * longest
        used, patch = np.unique(faces[inside[faces].all(1)], return_inverse=True)
        source, target = np.searchsorted(used, pairs[i])
        found = exact_geodesic(
            verts[used], patch.reshape(-1, 3), np.array([source]), nothing, np.array([target]), nothing
        )
        distances[i] = min(found[0], along_edges[i])
    return distances


def _heat(verts: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    import igl
    import numpy as np
    from scipy.sparse.csgraph import connected_components

    graph, _ = _edge_graph(verts, faces)
    label = connected_components(graph, directed=False)[1]
    distances = np.where(pairs[:, 0] == pairs[:, 1], 0.0, np.inf)
    linked = np.flatnonzero((pairs[:, 0] != pairs[:, 1]) & (label[pairs[:, 0]] == label[pairs[:, 1]]))
    if len(linked) == 0:
        return distances
    used, local = np.unique(faces, return_inverse=True)
    data = igl.HeatGeodesicsData()
    igl.heat_geodesics_precompute(verts[used], local.reshape(-1, 3), data)
    # Pairs come sorted, so those of one source are together: one solve for each.
    sources, starts = np.unique(pairs[linked, 0], return_index=True)
    for source, group in zip(sources, np.split(linked, starts[1:]), strict=True):
        field = igl.heat_geodesics_solve(data, np.searchsorted(used, [source]))
        distances[group] = field[np.searchsorted(used, pairs[group, 1])]
    return distances


def _edge_graph(verts: np.ndarray, faces: np.ndarray) -> tuple:
    """Edge lengths as a sparse graph, and the longest edge at each vertex."""
    import numpy as np
    from scipy.sparse import coo_array

    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    lengths = np.linalg.norm(verts[tail] - verts[head], axis=1)
    longest = np.zeros(len(verts))
    np.maximum.at(longest, tail, lengths)
    np.maximum.at(longest, head, lengths)
    # Sparse graphs have no edge of length 0; the smallest number stands for it.
    lengths = np.maximum(lengths, np.finfo(float).tiny)
    ends = np.stack([np.concatenate([tail, head]), np.concatenate([head, tail])], 1)
    ends, where = np.unique(ends, axis=0, return_index=True)  # an edge of two faces must not add up
    graph = coo_array((np.concatenate([lengths, lengths])[where], (ends[:, 0], ends[:, 1])), shape=(len(verts),) * 2)
    return graph.tocsr(), longest


def _path_lengths(graph: object, verts: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Lengths of the shortest paths along edges."""
    import numpy as np
    from scipy.sparse.csgraph import dijkstra

    straight = np.linalg.norm(verts[pairs[:, 0]] - verts[pairs[:, 1]], axis=1)
    found = np.empty(len(pairs))
    # Near pairs first, so that a search may stop early; the few paths that wind further are found without a limit.
    order = np.argsort(straight, kind="stable")
    for chunk in np.array_split(order, max(1, -(-len(order) // _SOURCES))) if len(order) else []:
        pending, limit = chunk, 2 * straight[chunk].max()
        while len(pending):
            sources, row = np.unique(pairs[pending, 0], return_inverse=True)
            found[pending] = dijkstra(graph, indices=sources, limit=limit)[row, pairs[pending, 1]]
            pending = pending[np.isinf(found[pending])] if np.isfinite(limit) else pending[:0]
            limit = np.inf
    return found
