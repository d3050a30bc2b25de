"""Connectivity and first-order geometry of triangle meshes.

Faces are ``(F, 3)`` integer tensors; a face whose three indices are ``-1`` is padding and contributes nothing anywhere.
"""

import math

import torch
from torch import Tensor

from meshkit.scatter import segment_sum

__all__ = [
    "check_faces",
    "connected_components",
    "cotangent_laplacian",
    "cotangent_weights",
    "face_normals",
    "mass_matrix",
    "unique_edges",
    "vertex_adjacency",
    "vertex_normals",
]


def check_faces(faces: Tensor, num_verts: int | None = None, *, batched: bool = False) -> None:
    """Raise unless `faces` is a valid triangle list.

    Args:
        faces: (F, 3) integer tensor, or (B, F, 3) when `batched`; rows of three -1 are padding.
        num_verts: number of vertices the indices may address; None leaves the upper bound unchecked.
        batched: also accept (B, F, 3).

    Raises:
        ValueError: wrong shape, not an integer tensor, an index out of range, or a row that is only partly -1.

    Example:
        >>> check_faces(torch.tensor([[0, 1, 2], [-1, -1, -1]]), 3)
    """
    if not isinstance(faces, Tensor):
        raise ValueError(f"faces must be a torch.Tensor, got {type(faces).__name__}; use torch.as_tensor")
    if faces.shape[-1:] != (3,) or faces.dim() not in ((2, 3) if batched else (2,)):
        wanted = "(F, 3) or (B, F, 3)" if batched else "(F, 3)"
        raise ValueError(f"faces must have shape {wanted}, got {tuple(faces.shape)}")
    if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        raise ValueError(f"faces must be an integer tensor, got {faces.dtype}; use faces.long()")
    if faces.numel() == 0:
        return
    low, high = (int(v) for v in torch.aminmax(faces))
    if low < -1 or (num_verts is not None and high >= num_verts):
        bound = "V" if num_verts is None else num_verts
        raise ValueError(f"face indices must lie in [0, {bound}) (or be -1 padding), got a range of [{low}, {high}]")
    if low == -1:
        negative = (faces < 0).sum(-1)
        partial = int(((negative > 0) & (negative < 3)).sum())
        if partial:
            raise ValueError(f"{partial} faces mix -1 with vertex indices; padding rows must be (-1, -1, -1)")


def unique_edges(faces: Tensor) -> Tensor:
    """List the undirected edges of a mesh once each.

    Args:
        faces: (F, 3) integer vertex indices, padding rows -1.

    Returns:
        (E, 2) int64 pairs (i, j), i < j, in lexicographic order. An edge from a vertex to itself is left out.

    Raises:
        ValueError: `faces` is not a valid triangle list.

    Example:
        >>> unique_edges(torch.tensor([[0, 1, 2], [2, 1, 3]])).tolist()
        [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    """
    check_faces(faces)
    faces = faces.long()
    pairs = torch.cat([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]])
    low, high = pairs.amin(-1), pairs.amax(-1)
    keep = (low >= 0) & (low < high)
    low, high = low[keep], high[keep]
    if not len(low):
        return low.new_empty(0, 2)
    base = high.max() + 1
    key = torch.unique(low * base + high)
    return torch.stack([key // base, key % base], 1)


def vertex_adjacency(faces: Tensor, num_verts: int) -> Tensor:
    """Build the symmetric 0/1 adjacency matrix of the vertices.

    Args:
        faces: (F, 3) integer vertex indices, padding rows -1.
        num_verts: number of vertices V.

    Returns:
        (V, V) coalesced sparse COO tensor of float32 ones, zero diagonal.

    Raises:
        ValueError: `faces` is not a valid triangle list for `num_verts` vertices.

    Example:
        >>> vertex_adjacency(torch.tensor([[0, 1, 2]]), 4).sum(1).to_dense().tolist()
        [2.0, 2.0, 2.0, 0.0]
    """
    check_faces(faces, num_verts)
    edges = unique_edges(faces).T
    index = torch.cat([edges, edges.flip(0)], 1)
    return _sparse(index, torch.ones(index.shape[1], device=faces.device), num_verts)


def connected_components(faces: Tensor, num_verts: int) -> Tensor:
    """Label the connected components of a mesh.

    Args:
        faces: (F, 3) integer vertex indices, padding rows -1.
        num_verts: number of vertices V.

    Returns:
        (V,) int64 labels 0 .. C-1 on the device of `faces`; a vertex of no face is a component of its own.

    Raises:
        ValueError: `faces` is not a valid triangle list for `num_verts` vertices.

    Example:
        >>> connected_components(torch.tensor([[0, 2, 4], [1, 3, 5]]), 7).tolist()
        [0, 1, 0, 1, 0, 1, 2]
    """
    import numpy as np
    from scipy.sparse import coo_array, csgraph

    check_faces(faces, num_verts)
    corners = faces[(faces >= 0).all(-1)].cpu().numpy()
    # Two of the three edges of every face already connect its corners.
    tail, head = np.concatenate([corners[:, 0], corners[:, 1]]), np.concatenate([corners[:, 1], corners[:, 2]])
    graph = coo_array((np.ones(len(tail), dtype=np.int8), (tail, head)), shape=(num_verts, num_verts))
    labels = csgraph.connected_components(graph.tocsr(), directed=False)[1]
    return torch.from_numpy(labels).long().to(faces.device)


def cotangent_weights(verts: Tensor, faces: Tensor) -> Tensor:
    r"""Half cotangent of the angle at every corner, i.e. opposite to every edge.

    .. math:: w_{f,k} = \tfrac12 \cot\theta_{f,k}
              = \tfrac12 \frac{\langle a, b\rangle}{\lVert a \times b\rVert}

    with a, b the edges that leave corner k of face f; edge k is the one opposite corner k. Summed over the faces at an
    edge they give its cotangent weight. Differentiable in `verts`.

    Args:
        verts: (..., V, 3) positions, any unit (the weights are dimensionless).
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1 for verts (B, V, 3).

    Returns:
        (..., F, 3) weights. A degenerate face (doubled area not above 4 machine epsilons times its longest squared
        edge) and a padding face get weight 0 and gradient 0: they add no stiffness instead of an infinite one.

    Raises:
        ValueError: bad shapes or face indices.

    Example:
        >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
        >>> cotangent_weights(square, torch.tensor([[0, 1, 2]])).tolist()
        [[0.5, 0.0, 0.5]]
    """
    _check(verts, faces)
    corners = _corners(verts, faces)
    dots = _corner_dots(corners)
    doubled, regular = _doubled_area(corners)
    regular = regular & (faces[..., 0] >= 0)
    return torch.where(regular[..., None], 0.5 * dots / doubled[..., None], 0.0)


def cotangent_laplacian(verts: Tensor, faces: Tensor) -> Tensor:
    r"""Assemble the cotangent stiffness matrix of one mesh, positive semi-definite.

    .. math:: L_{ij} = -\tfrac12(\cot\alpha_{ij} + \cot\beta_{ij}), \qquad L_{ii} = -\sum_{j\ne i} L_{ij}

    so that :math:`u^\top L u` is the Dirichlet energy :math:`\int \lVert\nabla u\rVert^2` of a linear interpolation.

    Args:
        verts: (V, 3) positions.
        faces: (F, 3) integer vertex indices, padding rows -1.

    Returns:
        (V, V) coalesced sparse COO tensor in the dtype of `verts`. Degenerate faces contribute nothing.

    Raises:
        ValueError: bad shapes or face indices.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> cotangent_laplacian(verts, torch.tensor([[0, 1, 2]])).to_dense().diagonal().tolist()
        [1.0, 0.5, 0.5]
    """
    if verts.dim() != 2:
        raise ValueError(f"cotangent_laplacian takes one mesh, verts (V, 3), got {tuple(verts.shape)}")
    weights = cotangent_weights(verts, faces)
    real = faces[:, 0] >= 0
    faces, weights = faces[real].long(), weights[real]
    i, j, w = faces[:, [1, 2, 0]].flatten(), faces[:, [2, 0, 1]].flatten(), weights.flatten()
    index = torch.stack([torch.cat([i, j, i, j]), torch.cat([j, i, i, j])])
    return _sparse(index, torch.cat([-w, -w, w, w]), len(verts))


def mass_matrix(verts: Tensor, faces: Tensor, *, kind: str = "voronoi") -> Tensor:
    r"""Diagonal of the lumped mass matrix: the surface area that belongs to every vertex.

    ``"barycentric"`` gives each corner a third of its face. ``"voronoi"`` gives it the part of the face nearest to it,

    .. math:: A_{f,i} = \tfrac18(\cot\theta_j\,\lVert e_j\rVert^2 + \cot\theta_k\,\lVert e_k\rVert^2),

    and in a face with an obtuse angle half of the face to the obtuse corner and a quarter to each of the others.
    Both sum to the area of the mesh. Differentiable in `verts`.

    Args:
        verts: (..., V, 3) positions.
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1 for verts (B, V, 3).
        kind: "voronoi" (default, more accurate) or "barycentric".

    Returns:
        (..., V) areas, the unit of `verts` squared; 0 at a vertex of no face of positive area.

    Raises:
        ValueError: unknown kind, bad shapes or face indices.

    Reference:
        Meyer, Desbrun, Schroeder and Barr, "Discrete Differential-Geometry Operators for Triangulated 2-Manifolds",
        section 3.4.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> mass_matrix(verts, torch.tensor([[0, 1, 2]])).tolist()
        [0.25, 0.125, 0.125]
    """
    if kind not in ("voronoi", "barycentric"):
        raise ValueError(f'kind must be "voronoi" or "barycentric", got {kind!r}')
    _check(verts, faces)
    corners = _corners(verts, faces)
    doubled, regular = _doubled_area(corners)
    regular = regular & (faces[..., 0] >= 0)
    if kind == "barycentric":
        parts = (doubled / 6)[..., None].expand(*doubled.shape, 3)
    else:
        dots = _corner_dots(corners)
        opposite = (corners[..., [1, 2, 0], :] - corners[..., [2, 0, 1], :]).square().sum(-1)
        pieces = dots / doubled[..., None] * opposite / 8
        obtuse = dots < 0
        parts = torch.where(
            obtuse.any(-1, keepdim=True),
            torch.where(obtuse, doubled[..., None] / 4, doubled[..., None] / 8),
            pieces[..., [1, 2, 0]] + pieces[..., [2, 0, 1]],
        )
    parts = torch.where(regular[..., None], parts, 0.0)
    return _add_at_corners(parts[..., None], faces, verts.shape[-2])[..., 0]


def face_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Unit normals of the faces, counter-clockwise seen from outside.

    Args:
        verts: (..., V, 3) positions.
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1 for verts (B, V, 3).

    Returns:
        (..., F, 3) unit vectors; zero for degenerate and padding faces.

    Raises:
        ValueError: bad shapes or face indices.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
        >>> face_normals(verts, torch.tensor([[0, 1, 2]])).tolist()
        [[0.0, 0.0, 1.0]]
    """
    _check(verts, faces)
    corners = _corners(verts, faces)
    doubled, regular = _doubled_area(corners)
    regular = regular & (faces[..., 0] >= 0)
    return torch.where(regular[..., None], _area_vectors(corners) / doubled[..., None], 0.0)


def vertex_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Unit normals of the vertices: area-weighted mean of the normals of the faces around.

    Args:
        verts: (..., V, 3) positions.
        faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1 for verts (B, V, 3).

    Returns:
        (..., V, 3) unit vectors; zero where the faces around cancel or there are none.

    Raises:
        ValueError: bad shapes or face indices.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [5, 5, 5]])
        >>> vertex_normals(verts, torch.tensor([[0, 1, 2]]))[2:].tolist()
        [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    """
    _check(verts, faces)
    areas = torch.where((faces[..., :1] >= 0), _area_vectors(_corners(verts, faces)), 0.0)
    summed = _add_at_corners(areas[..., None, :].expand(*areas.shape[:-1], 3, 3), faces, verts.shape[-2])
    squared = summed.square().sum(-1, keepdim=True)
    positive = squared > 0
    return torch.where(positive, summed / torch.where(positive, squared, 1.0).sqrt(), 0.0)


def _sparse(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Square matrix of entries that are summed where they meet."""
    place = values.device
    return torch.sparse_coo_tensor(index, values, (size, size), device=place, check_invariants=False).coalesce()


def _check(verts: Tensor, faces: Tensor) -> None:
    if verts.dim() < 2 or verts.shape[-1] != 3 or not verts.is_floating_point():
        raise ValueError(f"verts must be a floating (..., V, 3) tensor, got {verts.dtype} {tuple(verts.shape)}")
    check_faces(faces, verts.shape[-2], batched=True)
    if faces.dim() == 3 and (verts.dim() != 3 or len(verts) != len(faces)):
        raise ValueError(
            f"faces {tuple(faces.shape)} need verts (B, V, 3) of the same batch size, got {tuple(verts.shape)}"
        )


def _corners(verts: Tensor, faces: Tensor) -> Tensor:
    """(..., F, 3, 3): position of every corner; padding faces read vertex 0."""
    index = faces.long().clamp_min(0)
    if faces.dim() == 2:
        return verts[..., index, :]
    return verts[torch.arange(len(verts), device=verts.device)[:, None, None], index]


def _area_vectors(corners: Tensor) -> Tensor:
    first, second, third = corners.unbind(-2)
    area_vectors: Tensor = torch.linalg.cross(second - first, third - first, dim=-1)
    return area_vectors


def _corner_dots(corners: Tensor) -> Tensor:
    """(..., F, 3): inner product of the two edges that leave each corner."""
    to_next, to_previous = corners[..., [1, 2, 0], :] - corners, corners[..., [2, 0, 1], :] - corners
    return (to_next * to_previous).sum(-1)


def _doubled_area(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Doubled face areas, 1 where degenerate so that quotients and their gradients stay finite; and a regular mask."""
    squared = _area_vectors(corners).square().sum(-1)
    longest = (corners - corners[..., [1, 2, 0], :]).square().sum(-1).amax(-1).detach()
    regular = squared > (4 * torch.finfo(corners.dtype).eps * longest).square()
    return torch.where(regular, squared, 1.0).sqrt(), regular


def _add_at_corners(values: Tensor, faces: Tensor, num_verts: int) -> Tensor:
    """Sum (..., F, 3, D) corner values over the faces around each vertex: (..., V, D)."""
    *lead, _, _, dim = values.shape
    meshes = math.prod(lead)
    start = num_verts * torch.arange(meshes, device=faces.device)[:, None, None]
    index = (faces.long().clamp_min(0) + start).flatten()
    return segment_sum(values.reshape(-1, dim), index, meshes * num_verts).view(*lead, num_verts, dim)
