"""Largest eigenvectors of Horn's 4 x 4 matrices: the unit quaternions of the closest rotations.

Matrices are stored component first, see :mod:`meshkit.deform.matrices`.
"""

from typing import Any

import torch
from torch import Tensor

from meshkit.deform.matrices import transposed_product

__all__ = ["horn_matrix", "project", "rotation_matrix"]


def project(S: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor]:
    """Iterate from the guess, then from a closed form, then SVD: each stage only for what the last left open."""
    S = S / S.abs().amax((0, 1)).clamp_min(torch.finfo(S.dtype).tiny)
    K, c2, c1 = horn_matrix(S)
    q, left = _rayleigh(K, c2, c1, _closed_form(S, K, c2, c1) if guess is None else guess)
    if guess is not None and len(left):
        K, c2, c1 = K[:, :, left], c2[left], c1[left]
        q[:, left], still = _rayleigh(K, c2, c1, _closed_form(S[:, :, left], K, c2, c1))
        left = left[still]
    R = rotation_matrix(q)
    if len(left):
        R[:, :, left] = exact = _svd(S[:, :, left])
        q[:, left] = _closed_form(exact, *horn_matrix(exact))
    return q, R


def horn_matrix(S: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Horn's symmetric K, with q^T K q = tr(R(q)^T S), and c2, c1 of det(r I - K) = r^4 + c2 r^2 + c1 r + c0."""
    (a, b, c), (d, e, f), (g, h, i) = S.unbind(0)
    x, y, z, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    K = torch.stack([a + e + i, x, y, z, x, a - e - i, xy, xz, y, xy, e - a - i, yz, z, xz, yz, i - a - e])
    det = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    return K.unflatten(0, (4, 4)), -2 * S.square().sum((0, 1)), -8 * det


def _rayleigh(K: Tensor, c2: Tensor, c1: Tensor, q: Tensor, steps: int = 3) -> tuple[Tensor, Tensor]:
    """Rayleigh quotient iteration q <- adj(r I - K) q, r = q^T K q; returns q and the indices left uncertified.

    It converges cubically and divides by nothing. All roots of the quartic are real, so r is the largest one when
    every derivative there is positive; the first derivative is the product of its gaps to the other three.
    """
    q, eps = q.clone(), torch.finfo(K.dtype).eps
    active: Any = slice(None)
    for _ in range(steps):
        K_, c2_, c1_, q_ = K[:, :, active], c2[active], c1[active], q[:, active]
        image = (K_ * q_).sum(1)
        root = (q_ * image).sum(0)
        updated, slope = _deflate(K_, c2_, c1_, root, q_, image)
        square = root * root
        # Rounding perturbs q by about eps r^3 / slope.
        certified = (slope > 1e4 * eps * root * square) & (6 * square + c2_ > 0) & (root > 0)
        done = certified & ((updated - q_).square().sum(0) < eps ** (2 / 3))
        q[:, active] = updated
        remaining = (~done).nonzero().squeeze(1)
        active = remaining if isinstance(active, slice) else active[remaining]
        if not len(active):
            break
    return q, active


def _deflate(K: Tensor, c2: Tensor, c1: Tensor, root: Tensor, q: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector along adj(r I - K) q, given K q; and the derivative of the quartic at r."""
    # adj(r I - K) = K^3 + r K^2 + (r^2 + c2) K + (r^3 + c2 r + c1) I, by Horner's scheme
    shift = root * root + c2
    constant = torch.addcmul(c1, root, shift)
    image = (K * torch.addcmul(image, root, q)).sum(1)
    image = torch.addcmul((K * image.addcmul_(shift, q)).sum(1), constant, q)
    image[0] += (
        torch.finfo(K.dtype).tiny ** 0.5
    )  # at a double root the adjugate vanishes: the identity is as good a guess as any
    return image * image.square().sum(0).rsqrt(), constant + root * (2 * root * root + shift)


def _closed_form(S: Tensor, K: Tensor, c2: Tensor, c1: Tensor, steps: int = 6) -> Tensor:
    """Near the largest eigenvector of K: Newton on its quartic from an upper bound, then deflate a generic vector."""
    squared = -0.5 * c2
    c0 = 2 * transposed_product(S, S).square().sum((0, 1)) - squared * squared
    root = (3 * squared).sqrt()
    for _ in range(steps):
        square = root * root
        slope = (4 * square + 2 * c2) * root + c1
        root = root - ((square + c2) * square + c1 * root + c0) / slope.clamp_min(torch.finfo(S.dtype).eps)
    # No special rotation (a half turn about an axis, say) is orthogonal to this quaternion.
    generic = torch.tensor([0.83, 0.41, 0.29, 0.23], dtype=S.dtype, device=S.device)[:, None].expand_as(K[0])
    return _deflate(K, c2, c1, root, generic, (K * generic).sum(1))[0]


def _svd(S: Tensor) -> Tensor:
    """Literal projection, for the few matrices whose closest rotation is ill-determined; NaN where S is not finite."""
    matrices = S.permute(2, 0, 1)
    finite = torch.isfinite(matrices).all(-1).all(-1)
    with torch.autocast(S.device.type, enabled=False):
        U, _, Vh = torch.linalg.svd(torch.where(finite[:, None, None], matrices, 0.0))
        U[:, :, 2] *= torch.linalg.det(U @ Vh).sign()[:, None]
        return torch.where(finite, (U @ Vh).permute(1, 2, 0), torch.nan)


def rotation_matrix(q: Tensor) -> Tensor:
    """Rotations (3, 3, N) of unit quaternions (4, N)."""
    w, x, y, z = q.unbind(0)
    x2, y2, z2 = (2 * q[1:]).unbind(0)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    rows = [1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy]
    return torch.stack(rows).unflatten(0, (3, 3))
