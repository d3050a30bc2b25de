"""What the parts of ``meshkit.io`` share: one check of a mesh in memory, and small pieces of triangle geometry."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from meshkit.topology import check_faces

Points = NDArray[np.float64]
Indices = NDArray[np.int64]


class Parsed(NamedTuple):
    """A mesh as read; ``polygons`` counts the faces of the file with more than three corners."""

    verts: Points
    faces: Indices
    polygons: int = 0


def as_arrays(verts: Tensor, faces: Tensor) -> tuple[Points, Indices]:
    """One checked mesh as float64 and int64 arrays, without the padding rows of ``faces``.

    Raises:
        ValueError: wrong shapes or types, no vertices or no faces, an index out of range, coordinates that are not
            finite.
    """
    if not isinstance(verts, Tensor) or not verts.is_floating_point() or verts.dim() != 2 or verts.shape[1] != 3:
        got = f"{verts.dtype} {tuple(verts.shape)}" if isinstance(verts, Tensor) else type(verts).__name__
        raise ValueError(f"verts must be a floating (V, 3) tensor, got {got}")
    check_faces(faces, len(verts))
    triangles = faces.detach().cpu().long().numpy()
    triangles = np.ascontiguousarray(triangles[triangles[:, 0] >= 0])
    if len(verts) == 0 or len(triangles) == 0:
        raise ValueError(f"a mesh needs vertices and faces, got {len(verts)} vertices and {len(triangles)} faces")
    points = verts.detach().cpu().double().numpy()
    bad = int((~np.isfinite(points)).any(1).sum())
    if bad:
        raise ValueError(f"{bad} of {len(points)} vertices have NaN or infinite coordinates")
    return np.ascontiguousarray(points), triangles


def as_tensors(points: Points, triangles: Indices, verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Arrays in the dtype of ``verts`` and as int64, on the devices of ``verts`` and ``faces``."""
    return (
        torch.from_numpy(np.ascontiguousarray(points)).to(verts),
        torch.from_numpy(np.ascontiguousarray(triangles, dtype=np.int64)).to(faces.device),
    )


def area_vectors(points: Points, triangles: Indices) -> Points:
    """Normal of every face (F, 3), as long as twice its area."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def directed_edges(triangles: Indices) -> Indices:
    """Edges in the sense of the faces (3F, 2): corners 0-1, then 1-2, then 2-0 of every face."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def edge_numbers(triangles: Indices) -> tuple[Indices, Indices]:
    """Undirected edges (E, 2), and for each row of :func:`directed_edges` the edge it belongs to (3F,)."""
    ends = np.sort(directed_edges(triangles), axis=1)
    span = int(triangles.max(initial=0)) + 1
    keys, number = np.unique(ends[:, 0] * span + ends[:, 1], return_inverse=True)
    return np.stack([keys // span, keys % span], axis=1), number.reshape(-1)


def components(pairs: Indices, count: int) -> Indices:
    """Component number of each of ``count`` things joined by ``pairs`` (P, 2)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels: Any = connected_components(graph, directed=False)[1]
    return np.asarray(labels, dtype=np.int64)


def corner_fans(triangles: Indices) -> Indices:
    """Number of the fan that each corner belongs to (F, 3): faces that share an edge at a vertex are one fan of it."""
    count = len(triangles)
    # Corner k of face f is 3f + k. Corners at one end of one edge are chained.
    face, side = np.tile(np.arange(count), 3), np.repeat(np.arange(3), count)
    corner = np.concatenate([3 * face + side, 3 * face + (side + 1) % 3])
    vertex, edge = triangles.reshape(-1)[corner], np.tile(edge_numbers(triangles)[1], 2)
    order = np.lexsort((vertex, edge))
    same = (np.diff(edge[order]) == 0) & (np.diff(vertex[order]) == 0)
    pairs = np.stack([corner[order][:-1][same], corner[order][1:][same]], axis=1)
    return components(pairs, 3 * count).reshape(-1, 3)
