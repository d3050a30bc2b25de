"""Signatures as weighted sums of squared eigenvectors, mesh by mesh."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from meshkit.batching import check_mask
from meshkit.descriptors._spectrum import Cache, spectrum
from meshkit.topology import check_faces

# (eigenvalues (K,) of the pairs that vary over the surface) -> (S, K) weights of their squared eigenvectors, and (S,)
# what the constant ones add.
Bands = Callable[[Tensor], tuple[Tensor, Tensor]]


def wave_bands(count: int, width: float) -> Bands:
    """Gaussian bands in the logarithm of the eigenvalue, each with weights of sum 1; nothing from constants."""
    _check_count(count)

    def bands(eigenvalues: Tensor) -> tuple[Tensor, Tensor]:
        log_values = eigenvalues.log()
        first, last = float(log_values[0]), 0.98 * float(log_values[-1])
        energies = torch.linspace(first, last, count, dtype=log_values.dtype, device=log_values.device)
        spread = width * (energies[1] - energies[0]).abs().clamp_min(1e-9)
        weights = torch.exp(-(energies[:, None] - log_values).square() / (2 * spread**2))
        return weights / weights.sum(1, keepdim=True), torch.zeros_like(energies)

    return bands


def heat_bands(count: int) -> Bands:
    """Exponentials at times in geometric progression; the constants stay."""
    _check_count(count)

    def bands(eigenvalues: Tensor) -> tuple[Tensor, Tensor]:
        first, last = (math.log(4 * math.log(10) / float(eigenvalues[i])) for i in (-1, 0))
        times = torch.linspace(first, last, count, dtype=eigenvalues.dtype, device=eigenvalues.device).exp()
        return torch.exp(-times[:, None] * eigenvalues), torch.ones_like(times)

    return bands


def _check_count(count: int) -> None:
    if count < 2:
        raise ValueError(f"num_signatures must be at least 2, got {count}")


def signatures_of_each(
    verts: Tensor,
    faces: Tensor | None,
    mask: Tensor | None,
    bands: Bands,
    num_eigenpairs: int,
    method: str,
    robust: bool,
    cache: Cache,
) -> tuple[Tensor, Tensor]:
    """Signatures ``(..., V, S)`` of one mesh or each of a batch, and the areas ``(...)``."""
    if num_eigenpairs < 3:
        raise ValueError(f"num_eigenpairs must be at least 3, got {num_eigenpairs}")

    def compute(points: Tensor, triangles: Tensor | None) -> tuple[Tensor, Tensor]:
        return _signature(points, triangles, bands, num_eigenpairs, method, robust, cache)

    if verts.dim() == 2:
        if mask is not None:
            raise ValueError("mask needs a batch: verts (B, V, 3) with mask (B, V), or drop the padded rows")
        return compute(verts, faces)
    if verts.dim() != 3 or len(verts) == 0:
        raise ValueError(f"verts must have shape (V, 3) or (B, V, 3), got {tuple(verts.shape)}")
    check_mask(mask, *verts.shape[:2])
    if faces is not None:
        check_faces(faces, verts.shape[1], batched=True)
        if faces.dim() == 3 and len(faces) != len(verts):
            raise ValueError(f"faces {tuple(faces.shape)} and verts {tuple(verts.shape)} differ in their batch size")
    signatures, areas = [], []
    for b in range(len(verts)):
        triangles = faces[b] if faces is not None and faces.dim() == 3 else faces
        if mask is None:
            signature, area = compute(verts[b], triangles)
        else:
            real, triangles = _without_padding(mask[b], triangles)
            part, area = compute(verts[b, real], triangles)
            signature = part.new_zeros(len(mask[b]), part.shape[1]).index_copy_(0, real, part)
        signatures.append(signature)
        areas.append(area)
    return torch.stack(signatures), torch.stack(areas)


def _without_padding(mask: Tensor, faces: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Indices of the real vertices, and faces that count only them."""
    real = mask.nonzero()[:, 0]
    if faces is None:
        return real, None
    faces = faces[faces[:, 0] >= 0].long()
    padded = ~mask.to(faces.device)[faces]
    if bool(padded.any()):
        raise ValueError(f"{int(padded.any(1).sum())} faces refer to vertices that the mask calls padding")
    return real, (mask.to(faces.device).cumsum(0) - 1)[faces]


def _signature(
    verts: Tensor, faces: Tensor | None, bands: Bands, num_eigenpairs: int, method: str, robust: bool, cache: Cache
) -> tuple[Tensor, Tensor]:
    if len(verts) < 4:
        raise ValueError(f"a signature needs a surface of at least 4 vertices, got {len(verts)}")
    k = min(num_eigenpairs, len(verts) - 1)
    eigenvalues, vectors, area = spectrum(verts, faces, k, tol=0.0, method=method, robust=robust, cache=cache)
    # Each connected component has one constant eigenvector of eigenvalue 0, which says nothing about the shape.
    varying = eigenvalues > 1e-6
    if int(varying.sum()) < 2:
        raise ValueError(
            f"only {int(varying.sum())} of {len(eigenvalues)} eigenpairs vary over the surface, which has too many "
            "components: keep the largest, or ask for more eigenpairs"
        )
    weights, constant = bands(eigenvalues[varying])
    squares = vectors.square()
    signature = squares[:, varying] @ weights.mT + squares[:, ~varying].sum(1, keepdim=True) * constant
    return signature.to(verts), area.to(verts)
