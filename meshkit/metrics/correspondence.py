"""Correspondence error: how far matched vertices lie from the true ones."""

from typing import Literal, get_args

import torch
from torch import Tensor

from meshkit._connectivity import check_batch_faces
from meshkit.batching import check_mask, check_verts, masked_mean
from meshkit.neighbors import gather_vertices
from meshkit.topology import mass_matrix

__all__ = ["correspondence_auc", "correspondence_curve", "correspondence_error"]

Distance = Literal["euclidean", "geodesic", "heat"]
PointReduction = Literal["mean", "none"]


def correspondence_error(
    matches: Tensor,
    target_verts: Tensor,
    truth: Tensor,
    *,
    faces: Tensor | None = None,
    distance: Distance = "euclidean",
    normalize: bool = False,
    mask: Tensor | None = None,
    point_reduction: PointReduction = "mean",
) -> Tensor:
    r"""Mean distance, on the target mesh, between the matched and the true vertex.

    .. math:: E_b = \frac{1}{N_b} \sum_n \frac{d(q_{b, m_{bn}},\, q_{b, t_{bn}})}{\sqrt{A_b}}

    with the Euclidean or a geodesic distance d, and the surface area :math:`A_b` of the target mesh if ``normalize``,
    else 1. The Princeton protocol is ``distance="geodesic", normalize=True``.

    Args:
        matches: m, ``(B, N)`` integer: the target vertex that each source vertex is matched to, e.g. the row-wise
            argmax of a plan.
        target_verts: q, ``(B, M, 3)``, in pose transfer the pose mesh.
        truth: t, ``(B, N)`` integer: the true target vertex.
        faces: of the target, ``(F, 3)`` shared by the batch, or ``(B, F, 3)`` padded with -1. Needed for geodesic
            distances and for the area.
        distance: ``"euclidean"``, through space; ``"geodesic"``, on the surface, exact; ``"heat"``, on the surface, by
            the heat method, off by a few per cent but at a cost that does not depend on how bad the matches are.
        normalize: divide by the square root of the area.
        mask: ``(B, N)`` bool, True = real source vertex with a known truth; None if that holds for all. Elsewhere the
            indices are ignored and may be -1.
        point_reduction: ``"none"`` for the error of each vertex, e.g. for :func:`correspondence_curve`.

    Returns:
        ``(B,)``, or ``(B, N)`` with 0 where masked. In units of length, or without unit if normalised; at least
        float32. Geodesic distances have no gradient, are infinite between parts that are not connected, and NaN if a
        vertex of the sample is not finite.

    Raises:
        ValueError: if shapes or dtypes do not fit, an index is out of range, a sample has no real vertex, an option is
            unknown, faces are missing, or a mesh has an edge of more than two faces (``"geodesic"`` only).

    Reference:
        Kim, Lipman and Funkhouser, "Blended Intrinsic Maps" (the Princeton protocol). Exact distances: Mitchell, Mount
        and Papadimitriou, "The Discrete Geodesic Problem"; heat method: Crane, Weischedel and Wardetzky, "Geodesics in
        Heat". Both by libigl.

    Example:
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]])
        >>> correspondence_error(torch.tensor([[0, 1, 1]]), line, torch.tensor([[0, 1, 2]]))  # (0 + 0 + 4) / 3
        tensor([1.3333])
    """
    check_verts(target_verts, name="target_verts")
    batch, num = target_verts.shape[:2]
    if matches.ndim != 2 or len(matches) != batch or matches.shape != truth.shape or matches.shape[1] == 0:
        raise ValueError(
            f"matches and truth must have the same shape (B, N) with B = {batch} and N > 0, got "
            f"{tuple(matches.shape)} and {tuple(truth.shape)}"
        )
    if distance not in get_args(Distance):
        raise ValueError(f"distance must be one of {get_args(Distance)}, got {distance!r}")
    if point_reduction not in get_args(PointReduction):
        raise ValueError(f"point_reduction must be one of {get_args(PointReduction)}, got {point_reduction!r}")
    check_mask(mask, batch, matches.shape[1], nonempty=True)
    verts = target_verts.to(torch.promote_types(target_verts.dtype, torch.float32))
    matches, truth = (_checked_indices(i, num, mask, name) for i, name in ((matches, "matches"), (truth, "truth")))
    if faces is not None:
        check_batch_faces(verts, faces)
    elif distance != "euclidean" or normalize:
        raise ValueError("geodesic distances and normalize=True need the faces of the target: pass faces=")
    if distance == "euclidean":
        error = (gather_vertices(verts, matches) - gather_vertices(verts, truth)).norm(dim=2)
    else:
        assert faces is not None
        error = _on_surface(verts, faces, matches, truth, exact=distance == "geodesic")
    if mask is not None:
        error = torch.where(mask, error, 0)
    if normalize:
        assert faces is not None
        error = error / _area(verts, faces).sqrt()[:, None]
    return error if point_reduction == "none" else masked_mean(error, mask)


def correspondence_curve(errors: Tensor, thresholds: Tensor, *, mask: Tensor | None = None) -> Tensor:
    r"""Share of the vertices that are matched within a distance, the curve of the Princeton protocol.

    .. math:: c_b(\tau) = \frac{1}{N_b} \left| \{ n : e_{bn} \le \tau \} \right|

    Args:
        errors: ``(B, N)`` from ``correspondence_error(..., point_reduction="none")``.
        thresholds: τ, ``(K,)``, e.g. ``torch.linspace(0, 0.25, 101)`` for normalised errors.
        mask: ``(B, N)`` bool, as given to :func:`correspondence_error`.

    Returns:
        ``(B, K)`` in [0, 1]; 1 means every vertex. A NaN error is within no distance.

    Raises:
        ValueError: if shapes or dtypes do not fit, or a sample has no real vertex.

    Reference:
        Kim, Lipman and Funkhouser, "Blended Intrinsic Maps", the evaluation.

    Example:
        >>> correspondence_curve(torch.tensor([[0.0, 0.1, 0.2, 0.9]]), torch.tensor([0.0, 0.15, 1.0]))
        tensor([[0.2500, 0.5000, 1.0000]])
    """
    _check_errors(errors, mask)
    if thresholds.ndim != 1 or not thresholds.is_floating_point():
        raise ValueError(f"thresholds must be (K,) floating point, got {tuple(thresholds.shape)} {thresholds.dtype}")
    within = errors[..., None] <= thresholds.to(errors.device)
    return masked_mean(within.to(torch.promote_types(errors.dtype, torch.float32)), mask)


def correspondence_auc(errors: Tensor, *, max_error: float = 0.25, mask: Tensor | None = None) -> Tensor:
    r"""Area under the curve of the Princeton protocol, as a share of the whole: 1 for perfect matches.

    .. math:: \frac1T \int_0^T c_b(\tau)\, d\tau = \frac{1}{N_b} \sum_n \max\left(0,\, 1 - \frac{e_{bn}}{T}\right)

    The integral is exact, no thresholds are sampled.

    Args:
        errors: ``(B, N)`` from ``correspondence_error(..., point_reduction="none")``.
        max_error: T, where the curve ends, in the unit of the errors. The Princeton plots end at 0.25; values for
            different ends do not compare.
        mask: ``(B, N)`` bool, as given to :func:`correspondence_error`.

    Returns:
        ``(B,)`` in [0, 1].

    Raises:
        ValueError: if shapes or dtypes do not fit, a sample has no real vertex, or ``max_error`` is not positive.

    Reference:
        Kim, Lipman and Funkhouser, "Blended Intrinsic Maps", the evaluation.

    Example:
        >>> correspondence_auc(torch.tensor([[0.0, 0.1, 0.9]]), max_error=0.2)  # (1 + 1/2 + 0) / 3
        tensor([0.5000])
    """
    _check_errors(errors, mask)
    if not max_error > 0:
        raise ValueError(f"max_error must be positive, got {max_error}")
    return masked_mean((1 - errors / max_error).clamp_min(0), mask)


def _check_errors(errors: Tensor, mask: Tensor | None) -> None:
    if errors.ndim != 2 or errors.numel() == 0 or not errors.is_floating_point():
        raise ValueError(
            f"errors must be (B, N) floating point and not empty, got {tuple(errors.shape)} {errors.dtype}"
        )
    check_mask(mask, *errors.shape, nonempty=True)


def _checked_indices(index: Tensor, num: int, mask: Tensor | None, name: str) -> Tensor:
    if index.is_floating_point() or index.is_complex() or index.dtype == torch.bool:
        raise ValueError(f"{name} must hold integer indices, got {index.dtype}; convert with .long()")
    if mask is not None:
        index = torch.where(mask, index, 0)
    low, high = (int(bound) for bound in torch.aminmax(index))
    if low < 0 or high >= num:
        raise ValueError(f"{name} must lie in [0, {num}), got a range of [{low}, {high}]; mask what has no match")
    return index.long()


def _on_surface(verts: Tensor, faces: Tensor, matches: Tensor, truth: Tensor, *, exact: bool) -> Tensor:
    from meshkit.metrics._geodesics import geodesic_distances

    rows: list[Tensor] = []
    for b in range(len(verts)):
        chosen = faces if faces.ndim == 2 else faces[b]
        chosen = chosen.long()[_regular(chosen)]
        if not bool(verts[b].isfinite().all()):
            rows.append(verts.new_full((matches.shape[1],), torch.nan))
            continue
        if exact:
            _check_manifold(chosen, b)
        rows.append(geodesic_distances(verts[b], chosen, matches[b], truth[b], exact=exact))
    return torch.stack(rows).to(verts.dtype)


def _regular(faces: Tensor) -> Tensor:
    """Neither padding nor with a repeated vertex."""
    return (faces[:, 0] >= 0) & (faces != faces.roll(1, 1)).all(1)


def _check_manifold(faces: Tensor, sample: int) -> None:
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    count = torch.unique(edges, dim=0, return_counts=True)[1]
    if bool((count > 2).any()):
        raise ValueError(
            f"the mesh of sample {sample} has {int((count > 2).sum())} edges of more than two faces, on which exact "
            'geodesics are not defined; use distance="heat"'
        )


def _area(verts: Tensor, faces: Tensor) -> Tensor:
    return mass_matrix(verts.detach(), faces, kind="barycentric").sum(1)
