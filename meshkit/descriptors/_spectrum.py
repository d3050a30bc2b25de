"""The spectrum of a surface, solved for or looked up."""

from __future__ import annotations

import os
import secrets
from collections.abc import MutableMapping
from hashlib import sha256
from pathlib import Path

import torch
from torch import Tensor

from meshkit.descriptors._operator import normalised_laplacian
from meshkit.descriptors._solvers import block_krylov, lanczos
from meshkit.topology import check_faces

# Eigenvalues (k,), eigenvectors (V, k), area (); all float64 on the CPU.
Spectrum = tuple[Tensor, Tensor, Tensor]
Cache = str | os.PathLike[str] | MutableMapping[str, Spectrum] | None

_CACHE_VERSION = 1  # raise it when the numbers behind a key change


def spectrum(
    verts: Tensor, faces: Tensor | None, k: int, *, tol: float, method: str, robust: bool, cache: Cache
) -> Spectrum:
    """The eigenpairs in float64 and the area of the surface; shared with the cache, so not to be changed in place."""
    if verts.dim() != 2 or verts.shape[1] != 3:
        raise ValueError(f"verts must have shape (V, 3), got {tuple(verts.shape)}")
    num = len(verts)
    if not 1 <= k < num:
        raise ValueError(f"k must lie in [1, V - 1] = [1, {num - 1}], got {k}")
    if method not in ("exact", "fast"):
        raise ValueError(f'method must be "exact" or "fast", got {method!r}')
    if not bool(torch.isfinite(verts).all()):
        bad = int((~torch.isfinite(verts)).any(1).sum())
        raise ValueError(f"{bad} of {num} vertices are NaN or infinite")
    points = verts.detach().cpu().double().contiguous()
    if faces is not None:
        check_faces(faces, num)
        faces = faces[faces[:, 0] >= 0].cpu().long().contiguous()
    if cache is None:
        return _solve(points, faces, k, tol, method, robust)
    key = _key(points, faces, k, tol, method, robust)
    if isinstance(cache, MutableMapping):
        if key not in cache:
            cache[key] = _solve(points, faces, k, tol, method, robust)
        return cache[key]
    file = Path(cache) / f"{key}.pt"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        # Renamed when complete: another process never reads half a file.
        temporary = file.with_suffix(f".{secrets.token_hex(4)}")
        torch.save(_solve(points, faces, k, tol, method, robust), temporary)
        temporary.replace(file)
    eigenvalues, vectors, area = torch.load(file, weights_only=True)
    return eigenvalues, vectors, area


def _solve(points: Tensor, faces: Tensor | None, k: int, tol: float, method: str, robust: bool) -> Spectrum:
    import numpy as np

    matrix, scale, area = normalised_laplacian(points, faces, robust)
    if method == "exact":
        eigenvalues, vectors = lanczos(matrix, k, tol)
    else:
        eigenvalues, vectors = block_krylov(matrix, k, points.numpy(), scale)
    return (
        torch.from_numpy(eigenvalues.clip(min=0.0)),
        torch.from_numpy(np.ascontiguousarray(vectors * scale[:, None])),
        torch.tensor(area, dtype=torch.float64, device="cpu"),
    )


def _key(points: Tensor, faces: Tensor | None, k: int, tol: float, method: str, robust: bool) -> str:
    shape = None if faces is None else tuple(faces.shape)
    digest = sha256(repr((_CACHE_VERSION, tuple(points.shape), shape, k, tol, method, robust)).encode())
    digest.update(points.numpy().tobytes())
    if faces is not None:
        digest.update(faces.numpy().tobytes())
    return digest.hexdigest()
