"""The rotation closest to a 3 x 3 matrix, without an SVD in the common case, and with a gradient that stays finite.

Inside this file matrices are stored component first, (3, 3, N): each elementwise operation then runs over one long
contiguous row, which on a CPU is an order of magnitude faster than batched 3 x 3 linear algebra.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["closest_rotation"]


def closest_rotation(S: Tensor) -> Tensor:
    r"""Project matrices onto the rotations.

    .. math:: R = \arg\max_{R \in SO(3)} \operatorname{tr}(R^\top S) = \arg\min_{R \in SO(3)} \lVert R - S \rVert_F

    R is the unit quaternion that is the largest eigenvector of Horn's symmetric 4 x 4 matrix, found by Rayleigh
    quotient iteration and certified by the derivatives of the characteristic quartic; the few matrices that fail the
    certificate go through an SVD. A matrix of negative determinant gets its closest proper rotation.

    With :math:`P = R^\top S` the gradient solves
    :math:`(\operatorname{tr}(P) I - P)\,\omega = \operatorname{axl}(R^\top dS)`, :math:`dR = R[\omega]_\times`.
    It is exact while the smallest sum of two singular values (the last one signed like det S) is above the square root
    of machine epsilon times their total. Below that R is one of several (nearly) best rotations and the gradient is
    damped to a finite value. It is finite at repeated singular values, where that of an SVD is not. First derivatives
    only.

    Args:
        S: (..., 3, 3) matrices of any scale. float16 and bfloat16 are computed in float32.

    Returns:
        (..., 3, 3) rotations in the dtype of `S`; NaN where `S` is not finite; the identity, with zero gradient, at 0.

    Raises:
        ValueError: `S` is not a floating (..., 3, 3) tensor.

    Reference:
        Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987.

    Example:
        >>> closest_rotation(torch.diag(torch.tensor([3.0, -2.0, -1.0]))).diagonal().tolist()
        [1.0, -1.0, -1.0]
    """
    if not S.is_floating_point() or S.shape[-2:] != (3, 3):
        raise ValueError(f"S must be a floating (..., 3, 3) tensor, got {S.dtype} {tuple(S.shape)}")
    matrices = S.to(torch.promote_types(S.dtype, torch.float32)).reshape(-1, 3, 3).permute(1, 2, 0).contiguous()
    rotations, _ = ClosestRotation.apply(matrices, None)
    return rotations.permute(2, 0, 1).reshape(S.shape).to(S.dtype)


class ClosestRotation(torch.autograd.Function):
    """Component-first core: S (3, 3, N) and a guess (4, N) or None to R (3, 3, N) and its unit quaternions (4, N)."""

    @staticmethod
    def forward(ctx: Any, S: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor]:
        """Project."""
        q, R = _project(S, guess)
        ctx.save_for_backward(S, R)
        ctx.mark_non_differentiable(q)
        return R, q

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, None]:
        """Solve the self-adjoint 3 x 3 system for the axial vector of the upstream gradient."""
        return RotationDifferential(*ctx.saved_tensors)(grad), None


class RotationDifferential:
    """The self-adjoint linear map from a change of S to that of its rotation R, component first."""

    def __init__(self, S: Tensor, R: Tensor) -> None:
        tiny, eps = torch.finfo(S.dtype).tiny, torch.finfo(S.dtype).eps
        self.R, self.scale = R, S.abs().amax((0, 1)).clamp_min(tiny)
        M = _curvature(_transposed_product(R, S / self.scale))
        cofactors, det = _cofactors(M)
        # 1 / tr(M^-1) is the smallest eigenvalue of M up to a factor of 3: shift only where that is negligible.
        smallest = det / (cofactors[0] + cofactors[1] + cofactors[2]).clamp_min(tiny)
        shift = torch.relu(eps**0.5 * (M[0] + M[1] + M[2]) - smallest)
        cofactors, det = _cofactors(torch.cat([M[:3] + shift, M[3:]]))
        self.inverse = cofactors / det.clamp_min(tiny)

    def __call__(self, dS: Tensor) -> Tensor:
        """Apply the map to (3, 3, N)."""
        x, y, z = _symmetric_product(self.inverse, _axial(_transposed_product(self.R, dS)) / self.scale).unbind(0)
        a, b, c = self.R.unbind(1)
        return torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], 1)


class RotationTracker:
    """Closest rotations of matrices that change little between calls: Newton's method on SO(3) from the last ones.

    Args:
        compiled: run the step through torch.compile, which pays after some dozens of calls.
        slack: squared half angle of a last step that is small enough; the error left is about its 3/2th power.
    """

    def __init__(self, *, compiled: bool = False, slack: float = 1e-2) -> None:
        self.step = _compiled_step() if compiled else newton_step
        self.slack = slack
        self.last: tuple[Tensor, Tensor] | None = None

    def start(self, count: int, dtype: torch.dtype) -> None:
        """Begin at the identity."""
        q = torch.eye(4, 1, dtype=dtype, device="cpu").repeat(1, count)
        self.last = q, _rotation_matrix(q)

    def __call__(self, S: Tensor) -> Tensor:
        """Rotations of (3, 3, N) matrices of a scale near 1."""
        if self.last is None:
            self.last = _project(S, None)
            return self.last[1]
        q, R = (last.to(S.dtype) for last in self.last)
        for attempt in range(3):
            q, R, angle = self.step(q, R, S)
            if float(angle.amax()) < self.slack:
                break
            far = (angle > 0.06).nonzero().squeeze(1)
            if attempt < 2 and len(far):
                q[:, far], R[:, :, far] = _project(S[:, :, far], None)
        self.last = q, R
        return R


def newton_step(q: Tensor, R: Tensor, S: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Move unit quaternions (4, N), and their R, towards the rotations closest to S; also the squared half angles.

    The angle is 9 where the second derivatives do not certify a maximum.
    """
    P = _transposed_product(R, S)
    M = _curvature(P)
    cofactors, det = _cofactors(M)
    certified = (M[0] >= 0) & (cofactors[2] >= 0) & (det >= 0)
    x, y, z = half = _symmetric_product(cofactors, _axial(P)) * (0.5 / det.clamp_min(1e-30))
    angle = half.square().sum(0)
    a, b, c, d = q
    q = torch.stack(
        [a - b * x - c * y - d * z, b + a * x + c * z - d * y, c + a * y + d * x - b * z, d + a * z + b * y - c * x]
    )
    q = q * q.square().sum(0).rsqrt()
    return q, _rotation_matrix(q), torch.where(certified, angle, 9.0)


@cache
def _compiled_step() -> Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
    return torch.compile(newton_step, dynamic=True)


def _project(S: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor]:
    """Iterate from the guess, then from a closed form, then SVD: each stage only for what the last left open."""
    S = S / S.abs().amax((0, 1)).clamp_min(torch.finfo(S.dtype).tiny)
    horn, c2, c1 = _horn(S)
    q, left = _rayleigh(horn, c2, c1, _closed_form(S, horn, c2, c1) if guess is None else guess)
    if guess is not None and len(left):
        horn, c2, c1 = horn[:, :, left], c2[left], c1[left]
        q[:, left], still = _rayleigh(horn, c2, c1, _closed_form(S[:, :, left], horn, c2, c1))
        left = left[still]
    R = _rotation_matrix(q)
    if len(left):
        R[:, :, left] = exact = _svd(S[:, :, left])
        q[:, left] = _closed_form(exact, *_horn(exact))
    return q, R


def _horn(S: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
    c0 = 2 * _transposed_product(S, S).square().sum((0, 1)) - squared * squared
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


def _rotation_matrix(q: Tensor) -> Tensor:
    w, x, y, z = q.unbind(0)
    x2, y2, z2 = (2 * q[1:]).unbind(0)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    rows = [1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy]
    return torch.stack(rows).unflatten(0, (3, 3))


def _transposed_product(A: Tensor, B: Tensor) -> Tensor:
    """A^T B of component-first matrices. Not an einsum: autocast would run that in low precision."""
    return (A.unsqueeze(2) * B.unsqueeze(1)).sum(0)


def _axial(P: Tensor) -> Tensor:
    return torch.stack([P[2, 1] - P[1, 2], P[0, 2] - P[2, 0], P[1, 0] - P[0, 1]])


def _curvature(P: Tensor) -> Tensor:
    """Entries 00, 11, 22, 01, 02, 12 of tr(P) I - sym(P), the negative Hessian of tr(R^T S) on SO(3)."""
    a, b, c = P[0, 0], P[1, 1], P[2, 2]
    off = [P[0, 1] + P[1, 0], P[0, 2] + P[2, 0], P[1, 2] + P[2, 1]]
    return torch.stack([b + c, a + c, a + b, *(-0.5 * entry for entry in off)])


def _cofactors(M: Tensor) -> tuple[Tensor, Tensor]:
    a, b, c, d, e, f = M
    first, second, third = b * c - f * f, e * f - d * c, d * f - e * b
    cofactors = torch.stack([first, a * c - e * e, a * b - d * d, second, third, d * e - a * f])
    return cofactors, a * first + d * second + e * third


def _symmetric_product(M: Tensor, v: Tensor) -> Tensor:
    (a, b, c, d, e, f), (x, y, z) = M, v
    return torch.stack([a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z])
