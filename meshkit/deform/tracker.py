"""Closest rotations of matrices that change little from one call to the next."""

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from meshkit.deform.matrices import axial, cofactors_of, curvature, symmetric_product, transposed_product
from meshkit.deform.quaternion import project, rotation_matrix

__all__ = ["RotationTracker", "newton_step"]


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
        self.last = q, rotation_matrix(q)

    def __call__(self, S: Tensor) -> Tensor:
        """Rotations of (3, 3, N) matrices of a scale near 1."""
        if self.last is None:
            self.last = project(S, None)
            return self.last[1]
        q, R = (last.to(S.dtype) for last in self.last)
        for attempt in range(3):
            q, R, angle = self.step(q, R, S)
            if float(angle.amax()) < self.slack:
                break
            far = (angle > 0.06).nonzero().squeeze(1)
            if attempt < 2 and len(far):
                q[:, far], R[:, :, far] = project(S[:, :, far], None)
        self.last = q, R
        return R


def newton_step(q: Tensor, R: Tensor, S: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Move unit quaternions (4, N), and their R, towards the rotations closest to S; also the squared half angles.

    The angle is 9 where the second derivatives do not certify a maximum.
    """
    P = transposed_product(R, S)
    M = curvature(P)
    cofactors, det = cofactors_of(M)
    certified = (M[0] >= 0) & (cofactors[2] >= 0) & (det >= 0)
    x, y, z = half = symmetric_product(cofactors, axial(P)) * (0.5 / det.clamp_min(1e-30))
    angle = half.square().sum(0)
    a, b, c, d = q
    q = torch.stack(
        [a - b * x - c * y - d * z, b + a * x + c * z - d * y, c + a * y + d * x - b * z, d + a * z + b * y - c * x]
    )
    q = q * q.square().sum(0).rsqrt()
    return q, rotation_matrix(q), torch.where(certified, angle, 9.0)


@cache
def _compiled_step() -> Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
    return torch.compile(newton_step, dynamic=True)
