"""Nearest neighbours without an N x N argsort, and gathering by index."""

from __future__ import annotations

import torch
from torch import Tensor

from meshkit._numerics import launch_bound, safe_sqrt
from meshkit.batching import check_mask

__all__ = ["gather_vertices", "knn"]

_TILE_ELEMENTS = 1 << 22  # distances held at once by the tiled search: 16 MiB in float32
_SMALL = 128 * 128  # distances of a sample, up to which tiles are faster than a tree on a CPU
_OTHER_TILE_ELEMENTS = 1 << 26  # elsewhere than on a CPU


def knn(
    points: Tensor,
    k: int,
    *,
    query: Tensor | None = None,
    mask: Tensor | None = None,
    include_self: bool = True,
    method: str = "auto",
) -> Tensor:
    r"""Indices of the ``k`` nearest points of each query, nearest first.

    .. math:: \mathrm{knn}(q) = \operatorname{arg\,min}^{k}_{j} \lVert q - p_j \rVert_2

    A query that is itself one of the points has itself as first neighbour (up to ties between coincident points),
    unless ``include_self`` is False. The search carries no gradient and never holds the N x N distances. A graph that
    torch.compile traces breaks at the tree and at the mask's values, which the error message depends on.

    Args:
        points: ``(B, N, 3)`` (or any number of coordinates).
        k: number of neighbours, at most the smallest number of real points in the batch.
        query: ``(B, Q, 3)``; the points themselves when ``None``.
        mask: ``(B, N)`` bool, True = real point. Padded points are never returned. Rows of padded queries hold valid
            but meaningless indices.
        include_self: False to search the k nearest others of each point; for the points themselves as queries.
        method: ``"tree"`` (SciPy's KD-tree, CPU), ``"tiles"`` (blocks of the distance matrix, any device) or
            ``"auto"``: the tree on the CPU for more than 128 x 128 distances per sample, below which setting up a
            tree takes longer; tiles elsewhere.

    Returns:
        ``(B, Q, k)`` int64.

    Raises:
        ValueError: shapes do not fit, ``k`` is not positive, a sample has fewer than ``k`` real points (others, if
            not ``include_self``), or ``include_self`` is False for other queries.

    Example:
        >>> line = torch.arange(5.0)[None, :, None]
        >>> knn(line, 2)[0, 0].tolist()
        [0, 1]
    """
    if points.dim() != 3:
        raise ValueError(f"points must have shape (B, N, C), got {tuple(points.shape)}")
    if query is not None and (query.dim() != 3 or query.shape[::2] != points.shape[::2]):
        raise ValueError(f"query must have shape (B, Q, C) like points {tuple(points.shape)}, got {tuple(query.shape)}")
    if method not in ("auto", "tree", "tiles"):
        raise ValueError(f'method must be "auto", "tree" or "tiles", got {method!r}')
    if query is not None and not include_self:
        raise ValueError("include_self=False is for the points among themselves: leave query out")
    check_mask(mask, *points.shape[:2])
    fewest = points.shape[1] if mask is None or not len(mask) else int(mask.sum(1).min())
    if not 1 <= k <= fewest - (not include_self):
        raise ValueError(
            f"k={k} neighbours were asked for, but the smallest mesh of the batch has {fewest} vertices"
            f"{'' if include_self else ', itself included'}: use a smaller k or a larger mesh"
        )
    if not len(points):
        return torch.empty(0, (points if query is None else query).shape[1], k, dtype=torch.int64, device=points.device)
    dtype = torch.promote_types(points.dtype, torch.float32)
    points = points.detach().to(dtype)
    query = points if query is None else query.detach().to(dtype)
    if method == "auto":
        many = points.shape[1] * query.shape[1] > _SMALL
        method = "tree" if many and points.device.type == "cpu" else "tiles"
    search = _knn_tree if method == "tree" else _knn_tiles
    return search(points, query, k, mask, include_self)


def _knn_tree(points: Tensor, query: Tensor, k: int, mask: Tensor | None, include_self: bool) -> Tensor:
    import numpy as np
    from scipy.spatial import cKDTree

    rows = []
    for b in range(len(points)):
        real = None if mask is None else mask[b].nonzero()[:, 0].cpu()
        cloud = points[b].double().cpu() if real is None else points[b].double().cpu()[real]
        # A NaN would make the tree raise from inside SciPy; far away it simply is nobody's neighbour.
        cloud = torch.nan_to_num(cloud, nan=1e30, posinf=1e30, neginf=-1e30)
        asked = torch.nan_to_num(query[b].double().cpu(), nan=1e30, posinf=1e30, neginf=-1e30)
        wanted = range(1, k + 1 if include_self else k + 2)
        index = cKDTree(cloud.numpy()).query(asked.numpy(), k=wanted, workers=torch.get_num_threads())[1]
        index = torch.from_numpy(np.ascontiguousarray(index, dtype=np.int64))
        index = index if real is None else real[index]
        if not include_self:
            surplus = index == torch.arange(len(index), device="cpu")[:, None]
            surplus[:, -1] |= ~surplus.any(1)  # among coincident points it need not have found itself
            index = index[~surplus].view(-1, k)
        rows.append(index)
    return torch.stack(rows).to(points.device)


def _knn_tiles(points: Tensor, query: Tensor, k: int, mask: Tensor | None, include_self: bool) -> Tensor:
    batch, num = points.shape[:2]
    far = torch.finfo(points.dtype).max
    step = max(1, (_OTHER_TILE_ELEMENTS if launch_bound(points) else _TILE_ELEMENTS) // (batch * num))
    rows = []
    for start in range(0, query.shape[1], step):
        asked = query[:, start : start + step]
        if launch_bound(points):
            tile = _squared_distances(asked, points)
        else:  # the direct form keeps tiny distances exact, where |a|^2 - 2ab + |b|^2 would lose them
            tile = torch.cdist(asked, points, compute_mode="donot_use_mm_for_euclid_dist")
        # As in the tree, what is not finite is far away, but nearer than padding.
        tile = torch.nan_to_num(tile, nan=far, posinf=far)
        if mask is not None:
            tile = tile.masked_fill(~mask[:, None], torch.inf)
        if not include_self:
            tile[:, :, start : start + step].diagonal(dim1=1, dim2=2).fill_(torch.inf)
        rows.append(tile.topk(k, dim=2, largest=False).indices)
    return torch.cat(rows, 1)


def _squared_distances(query: Tensor, points: Tensor) -> Tensor:
    """``(B, Q, N)``, directly as well, coordinate by coordinate: cdist's direct form takes long on a GPU."""
    total = query.new_zeros(len(query), query.shape[1], points.shape[1])
    for a, b in zip(query.unbind(2), points.unbind(2), strict=True):
        difference = a[:, :, None] - b[:, None]
        total.addcmul_(difference, difference)
    return total


def distance_to_nearest(
    points: Tensor, others: Tensor, mask: Tensor | None, others_mask: Tensor | None, *, squared: bool
) -> Tensor:
    """Distance ``(B, N)`` of each point to the nearest of the others, 0 where masked.

    Found without a gradient, and taken again from the index with one.
    """
    difference = points - gather_vertices(others, knn(others, 1, query=points, mask=others_mask)[..., 0])
    if mask is not None:
        difference = torch.where(mask[..., None], difference, 0)
    distance = difference.square().sum(2)
    return distance if squared else safe_sqrt(distance)


def gather_vertices(x: Tensor, index: Tensor) -> Tensor:
    """Rows of ``x`` picked per sample: ``out[b, ...] = x[b, index[b, ...]]``.

    Args:
        x: ``(B, N, C)``.
        index: ``(B, ...)`` int64 with values in ``[0, N)``.

    Returns:
        ``(B, ..., C)``.

    Raises:
        ValueError: batch sizes differ.

    Example:
        >>> gather_vertices(torch.tensor([[[1.0], [2.0]]]), torch.tensor([[1, 1, 0]]))[0, :, 0].tolist()
        [2.0, 2.0, 1.0]
    """
    if x.dim() != 3 or len(index) != len(x):
        raise ValueError(f"x must be (B, N, C) and index (B, ...), got {tuple(x.shape)} and {tuple(index.shape)}")
    batch, num, channels = x.shape
    offset = torch.arange(batch, device=x.device).mul_(num).view(-1, *[1] * (index.dim() - 1))
    return x.reshape(-1, channels).index_select(0, (index + offset).reshape(-1)).view(*index.shape, channels)
