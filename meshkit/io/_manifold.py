"""The steps of :func:`meshkit.io.clean_mesh`."""

import numpy as np

from meshkit.io._mesh import Indices, Points, area_vectors, components, corner_fans, edge_numbers


def weld_vertices(points: Points, weld: float | None) -> Indices:
    """For each vertex the first vertex at the same place."""
    if weld is None:
        return np.arange(len(points))
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    same = first[inverse.reshape(-1)]
    if weld > 0:
        from scipy.spatial import cKDTree

        radius = weld * float(np.linalg.norm(np.ptp(points, axis=0)))
        pairs = cKDTree(points[first]).query_pairs(radius, output_type="ndarray")
        joined = np.concatenate([first[pairs], np.stack([np.arange(len(points)), same], axis=1)])
        label = components(joined, len(points))
        same = np.unique(label, return_index=True)[1][label]
    return np.asarray(same, dtype=np.int64)


def edge_manifold(points: Points, triangles: Indices) -> Indices:
    """Remove the smallest face at every edge of more than two faces until there is no such edge."""
    area = np.linalg.norm(area_vectors(points, triangles), axis=1)
    while True:
        number = edge_numbers(triangles)[1]
        crowded = np.bincount(number) > 2
        if not crowded.any():
            return triangles
        face = np.tile(np.arange(len(triangles)), 3)
        order = np.lexsort((area[face], number))
        smallest = order[np.flatnonzero(np.diff(number[order], prepend=-1))]
        keep = np.ones(len(triangles), dtype=bool)
        keep[face[smallest[crowded[number[smallest]]]]] = False
        triangles, area = triangles[keep], area[keep]


def _inner_edges(triangles: Indices) -> tuple[Indices, Indices]:
    """Rows of ``directed_edges`` that are the two sides of one edge."""
    number = edge_numbers(triangles)[1]
    order = np.argsort(number, kind="stable")
    twin = np.flatnonzero(np.diff(number[order]) == 0)
    return order[twin], order[twin + 1]


def face_components(triangles: Indices) -> Indices:
    """Part of every face (F,), faces joined where exactly two of them share an edge."""
    first, second = _inner_edges(triangles)
    return components(np.stack([first, second], axis=1) % len(triangles), len(triangles))


def split_fans(triangles: Indices, num_verts: int) -> tuple[Indices, Indices]:
    """Give every fan of faces but the first at a vertex a copy of it: the vertices copied, and the new faces."""
    fan, vertex = corner_fans(triangles).reshape(-1), triangles.reshape(-1)
    head = np.unique(fan, return_index=True)[1]  # a corner of each fan
    order = head[np.lexsort((head, vertex[head]))]
    again = order[np.flatnonzero(np.diff(vertex[order], prepend=-1) == 0)]
    row = np.empty(len(head), dtype=np.int64)
    row[fan[order]] = vertex[order]
    row[fan[again]] = num_verts + np.arange(len(again))
    return vertex[again], row[fan].reshape(-1, 3)


def orient_faces(points: Points, triangles: Indices) -> Indices:
    """Faces turned like their neighbours, and every part outward: to a positive volume about its middle."""
    import igl

    oriented, part = igl.bfs_orient(triangles)
    oriented, part = np.asarray(oriented, dtype=np.int64), np.asarray(part).reshape(-1)
    for label in range(int(part.max()) + 1):
        members = part == label
        corners = points[oriented[members]] - points[oriented[members]].mean((0, 1))
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        size = np.linalg.norm(area_vectors(points, oriented[members]), axis=1).sum() ** 1.5
        if volume < -1e-9 * size:  # a flat piece has no outside
            oriented[members] = oriented[members][:, [0, 2, 1]]
    # A cyclic shift of the corners is no turn.
    agrees = (oriented == triangles).all(1)
    for shift in (1, 2):
        agrees |= (np.roll(oriented, shift, 1) == triangles).all(1)
    return np.where(agrees[:, None], triangles, triangles[:, [0, 2, 1]])
