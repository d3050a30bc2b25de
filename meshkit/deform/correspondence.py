"""Deformation gradients of faces, and how they are carried from one mesh to another."""

from typing import Protocol

import torch
from torch import Tensor

from meshkit.deform.rotation import closest_rotation
from meshkit.neighbors import knn
from meshkit.topology import check_faces, cotangent_weights, vertex_normals

__all__ = ["Correspondence", "key_point_correspondence"]


class Plan(Protocol):
    """What is read of a transport plan."""

    @property
    def shape(self) -> torch.Size:
        """(1, N, V)."""

    def barycentric(self, values: Tensor) -> Tensor:
        """Mean of the values (1, V, C) over each row."""


Correspondence = Tensor | Plan


def key_point_correspondence(
    source_rest: Tensor,
    target_rest: Tensor,
    key_points: Tensor,
    *,
    source_faces: Tensor,
    target_faces: Tensor,
    smoothing: float = 0.0,
    k: int = 4,
) -> Tensor:
    r"""Extend pairs of key points to a correspondence of all vertices.

    The target is carried to the source by the map of least bending energy that does so with its key points,

    .. math:: \phi(x) = A x + b + \sum_i c_i \lVert x - t_i \rVert, \qquad \phi(t_i) = s_i, \qquad
              \sum_i c_i = 0, \quad \sum_i c_i t_i^\top = 0,

    which is affine if an affine map can do it. Each target vertex then corresponds to the `k` nearest source vertices
    whose normals point to its side, weighted by the inverse of the squared distance (to all `k` where none does). Give
    at least four points that span space, such as head, hands, feet and pelvis, at rest in like poses; between
    them the map is as good as the likeness of the shapes. Add points where the result is off.

    Args:
        source_rest: (V, 3).
        target_rest: (N, 3).
        key_points: (K, 2) int64, K >= 4: rows of a target vertex and the source vertex that is the same point.
        source_faces: (F, 3), padding -1.
        target_faces: (G, 3), padding -1.
        smoothing: at least 0, in the unit of the positions; above 0 the key points are met as far as bending allows,
            for points marked by hand.
        k: number of source vertices.

    Returns:
        (N, V) sparse matrix, float64 on the CPU, rows summing to 1, for
        :func:`~meshkit.deform.deformation_transfer`.

    Raises:
        ValueError: bad shapes or indices; NaN or infinity; too few key points, a target vertex named twice, or points
            of the target in one plane; a negative `smoothing`; `k` not in 1 .. V.

    Reference:
        Duchon, "Splines minimizing rotation-invariant semi-norms in Sobolev spaces", 1977 (the map).

    Example:
        >>> tetrahedron = torch.cat([torch.zeros(1, 3), torch.eye(3)])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> pairs = torch.tensor([[0, 0], [1, 1], [2, 2], [3, 3]])
        >>> matrix = key_point_correspondence(
        ...     tetrahedron, 2 * tetrahedron + 1, pairs, source_faces=faces, target_faces=faces
        ... )
        >>> matrix.to_dense().argmax(1).tolist()
        [0, 1, 2, 3]
    """
    check_points(source_rest, "source_rest")
    check_points(target_rest, "target_rest")
    check_faces(source_faces, len(source_rest))
    check_faces(target_faces, len(target_rest))
    _check_key_points(key_points, len(target_rest), len(source_rest))
    if not smoothing >= 0:
        raise ValueError(f"smoothing must be at least 0, got {smoothing}")
    if not 1 <= k <= len(source_rest):
        raise ValueError(f"k must be between 1 and the {len(source_rest)} source vertices, got {k}")
    source, target = (points.detach().cpu().double() for points in (source_rest, target_rest))
    at, to = key_points.cpu().long().unbind(1)
    carried = _spline(target[at], source[to], target, smoothing)
    near = knn(source[None], k, query=carried[None])[0]
    squared = (source[near] - carried[:, None]).square().sum(-1)
    ours = vertex_normals(carried, target_faces.cpu())
    facing = (vertex_normals(source, source_faces.cpu())[near] * ours[:, None]).sum(-1) > 0
    facing |= ~facing.any(1, keepdim=True)
    floor = 1e-12 * (source.amax(0) - source.amin(0)).square().sum()
    weights = facing / (squared + floor)
    weights = weights / weights.sum(1, keepdim=True)
    rows = torch.arange(len(target), device="cpu")[:, None].expand_as(near)
    index = torch.stack([rows.flatten(), near.flatten()])
    size = (len(target), len(source))
    return torch.sparse_coo_tensor(index, weights.flatten(), size, device="cpu", check_invariants=False).coalesce()


def check_points(points: Tensor, name: str, *, batched: bool = False) -> None:
    """Raise ValueError unless points are finite and floating, (V, 3) with V > 0, or also (P, V, 3)."""
    if points.dim() not in ((2, 3) if batched else (2,)) or points.shape[-1] != 3 or not points.is_floating_point():
        wanted = "(V, 3) or (P, V, 3)" if batched else "(V, 3)"
        raise ValueError(f"{name} must be a floating {wanted} tensor, got {points.dtype} {tuple(points.shape)}")
    if points.shape[-2] == 0:
        raise ValueError(f"{name} {tuple(points.shape)} holds no vertex")
    if not torch.isfinite(points).all():
        raise ValueError(f"{name} holds NaN or infinity")


def _check_key_points(pairs: Tensor, targets: int, sources: int) -> None:
    if pairs.dim() != 2 or pairs.shape[1] != 2 or pairs.is_floating_point() or pairs.dtype == torch.bool:
        raise ValueError(f"key_points must be an integer (K, 2) tensor, got {pairs.dtype} {tuple(pairs.shape)}")
    if len(pairs) < 4:
        raise ValueError(f"{len(pairs)} key points do not span space; give at least 4")
    for column, size, name in ((0, targets, "target"), (1, sources, "source")):
        low, high = (int(v) for v in torch.aminmax(pairs[:, column]))
        if low < 0 or high >= size:
            raise ValueError(f"{name} vertices of key_points must lie in [0, {size}), got a range of [{low}, {high}]")
    repeated = len(pairs) - len(pairs[:, 0].unique())
    if repeated:
        raise ValueError(f"{repeated} key points name a target vertex again; list each once")


def _spline(knots: Tensor, values: Tensor, points: Tensor, smoothing: float) -> Tensor:
    """Interpolate values at knots by the triharmonic spline in space, evaluated at points."""
    count = len(knots)
    spread = torch.linalg.svdvals(knots - knots.mean(0))
    if spread[2] <= 1e-9 * spread[0]:
        raise ValueError("the key points of the target lie in one plane, which fixes no map of space; add one off it")
    affine = torch.cat([knots, knots.new_ones(count, 1)], 1)
    system = knots.new_zeros(count + 4, count + 4)
    # -r is conditionally positive definite
    system[:count, :count] = -torch.cdist(knots, knots) + smoothing * torch.diag(knots.new_ones(count))
    system[:count, count:], system[count:, :count] = affine, affine.T
    solved = torch.linalg.solve(system, torch.cat([values, values.new_zeros(4, 3)]))
    basis = torch.cat([-torch.cdist(points, knots), points, points.new_ones(len(points), 1)], 1)
    return basis @ solved


def face_gradients(rest: Tensor, posed: Tensor, faces: Tensor) -> Tensor:
    """Linear maps (P, F, 3, 3) that take each face at rest, and its normal, to each pose (P, V, 3)."""
    before = _frames(rest[faces])
    flat = int((cotangent_weights(rest, faces) == 0).all(-1).sum())
    if flat:
        raise ValueError(f"{flat} faces of the source have area zero at rest; repair the mesh")
    return _frames(posed[:, faces]) @ torch.linalg.inv(before)


def _frames(corners: Tensor) -> Tensor:
    """(..., 3, 3): two edges and the normal over the square root of its length, as columns."""
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = torch.linalg.cross(first, second, dim=-1)
    squared = normal.square().sum(-1, keepdim=True)
    flat = squared == 0
    normal = torch.where(flat, 0.0, normal / torch.where(flat, 1.0, squared) ** 0.25)
    return torch.stack([first, second, normal], -1)


def mapped(
    gradients: Tensor, moved: Tensor, rest: Tensor, faces: Tensor, correspondence: Correspondence, count: int
) -> tuple[Tensor, Tensor]:
    """Rotations and stretches (P, N, 2, 3, 3), and displacements (P, N, 3), at the vertices of another mesh."""
    shape = tuple(correspondence.shape)
    is_tensor = isinstance(correspondence, Tensor)
    listed = is_tensor and len(shape) == 1
    wanted = ((count,),) if listed else ((count, len(rest)),) if is_tensor else ((1, count, len(rest)),)
    if shape not in wanted:
        raise ValueError(
            f"correspondence must hold {count} target vertices, as an index ({count},), a matrix "
            f"({count}, {len(rest)}) or a plan (1, {count}, {len(rest)}); got {shape}"
        )
    rotations = closest_rotation(gradients)
    parts = torch.stack([rotations, rotations.mT @ gradients], 2)
    poses = len(parts)
    areas = 0.5 * torch.linalg.cross(rest[faces[:, 1]] - rest[faces[:, 0]], rest[faces[:, 2]] - rest[faces[:, 0]])
    weights = areas.norm(dim=1)
    spread = (parts * weights[:, None, None, None]).flatten(2)[:, :, None].expand(-1, -1, 3, -1)
    around = parts.new_zeros(poses, len(rest), 18).index_add(1, faces.flatten(), spread.flatten(1, 2))
    total = weights.new_zeros(len(rest)).index_add(0, faces.flatten(), weights.repeat_interleave(3))
    used = total > 0
    # A vertex of no face says nothing: it keeps its weight in no row.
    values = torch.cat([around, moved * total[:, None], total.expand(poses, -1)[..., None]], 2)
    values = values / torch.where(used, total, 1.0)[:, None]
    columns = _carry(correspondence, values.permute(1, 0, 2).flatten(1), listed)
    carried = columns.view(count, poses, 22).permute(1, 0, 2)
    mass = carried[..., 21:]
    starved = int((mass[0] <= 0).sum())
    if starved:
        raise ValueError(f"{starved} target vertices correspond to no source vertex of a face: their rows weigh 0")
    carried = carried / mass
    return carried[..., :18].unflatten(2, (2, 3, 3)), carried[..., 18:21]


def _carry(correspondence: Correspondence, values: Tensor, listed: bool) -> Tensor:
    if not isinstance(correspondence, Tensor):
        device = getattr(correspondence, "device", values.device)
        return correspondence.barycentric(values[None].to(device))[0].cpu().double()
    matrix = correspondence.detach().cpu()
    if listed:
        if matrix.is_floating_point() or matrix.dtype == torch.bool:
            raise ValueError(f"a correspondence ({len(matrix)},) must hold integer indices, got {matrix.dtype}")
        low, high = (int(v) for v in torch.aminmax(matrix))
        if low < 0 or high >= len(values):
            raise ValueError(f"correspondence must index [0, {len(values)}), got a range of [{low}, {high}]")
        return values[matrix.long()]
    return matrix.double() @ values


def recombined(parts: Tensor) -> Tensor:
    """Mean rotation, projected, times mean stretch."""
    return closest_rotation(parts[..., 0, :, :]) @ parts[..., 1, :, :]
