"""The matching of the released codes, with the constants they add to the denominators."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from meshkit._numerics import safe_log

STABILIZER = 1e-8


class DensePlan:
    """A batch of stored transport plans ``(B, N, M)``, read like a :class:`~meshkit.ot.TransportPlan`.

    Args:
        matrix: the plans.
        floor: added to the row sums that :meth:`barycentric` divides by.
    """

    def __init__(self, matrix: Tensor, *, floor: float = 0.0) -> None:
        self._matrix, self._floor = matrix, floor

    @property
    def shape(self) -> torch.Size:
        """``(B, N, M)``."""
        return self._matrix.shape

    @property
    def dtype(self) -> torch.dtype:
        """Of the masses."""
        return self._matrix.dtype

    @property
    def device(self) -> torch.device:
        """Of the masses."""
        return self._matrix.device

    @property
    def T(self) -> DensePlan:
        """The transposed plan."""
        return DensePlan(self._matrix.mT, floor=self._floor)

    def __matmul__(self, values: Tensor) -> Tensor:
        """``T @ values`` for ``values (B, M, C)``."""
        with torch.autocast(values.device.type, enabled=False):
            return self._matrix @ values.to(self.dtype)

    def barycentric(self, values: Tensor) -> Tensor:
        """Row-normalised product; rows without mass give 0."""
        mass = self.row_sums()[..., None] + self._floor
        return torch.where(mass > 0, (self @ values) / torch.where(mass > 0, mass, 1.0), 0.0)

    def row_sums(self) -> Tensor:
        """Mass that leaves each row, ``(B, N)``."""
        return self._matrix.sum(2)

    def marginals(self) -> tuple[Tensor, Tensor]:
        """Row sums ``(B, N)`` and column sums ``(B, M)``."""
        return self._matrix.sum(2), self._matrix.sum(1)

    def argmax(self, dim: int = 2) -> Tensor:
        """Index of the heaviest entry of each row (``dim=2``) or column (``dim=1``)."""
        return self._matrix.argmax(dim)

    def topk(self, k: int, *, dim: int = 2) -> tuple[Tensor, Tensor]:
        """Masses and indices of the ``k`` heaviest entries of each row or column; both 0 where there is no mass."""
        if dim not in (1, 2, -1, -2):
            raise ValueError(f"dim must be 1 (best rows of each column) or 2 (best columns of each row), got {dim}")
        if not 1 <= k <= self.shape[dim]:
            raise ValueError(f"k must be between 1 and {self.shape[dim]}, the number of candidates, got {k}")
        masses, index = (self._matrix if dim in (2, -1) else self._matrix.mT).topk(k, 2)
        return masses, torch.where(masses > 0, index, 0)

    def log_at(self, columns: Tensor) -> Tensor:
        """Logarithm of the entry at one column of each row, ``(B, N)``; -inf at negative columns."""
        masses = self._matrix.gather(2, columns.clamp_min(0)[..., None])[..., 0]
        return safe_log(masses.masked_fill(columns < 0, 0.0))

    def mutual(self) -> tuple[Tensor, Tensor]:
        """The heaviest column of each row, and whether that column prefers this row too."""
        best, back = self.argmax(2), self.argmax(1)
        rows = torch.arange(best.shape[1], device=self.device)
        return best, (back.gather(1, best) == rows) & (self.row_sums() > 0)

    def entropy(self) -> Tensor:
        r"""Entropy :math:`-\sum_{ij} T_{ij} \log T_{ij}` of each sample, ``(B,)``, in nats."""
        return torch.special.entr(self._matrix).sum((1, 2))

    def dense(self) -> Tensor:
        """The matrix itself."""
        return self._matrix


def stabilized_matching(
    fx: Tensor,
    fy: Tensor,
    *,
    eps: float,
    n_iters: int,
    mask_x: Tensor | None,
    mask_y: Tensor | None,
    floor: float,
) -> DensePlan:
    r"""Sinkhorn iterations :math:`b = \nu / (K^\top a + \delta)`, :math:`a = \mu / (K b + \delta)`, delta 1e-8.

    Where the features of the two meshes are far apart, or the meshes large, delta is not small beside the sums: it
    moves the warped vertices by up to a few per cent. Autograd differentiates through the stored matrices.
    """
    with torch.autocast(fx.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(fx.dtype, fy.dtype), torch.float32)
        x, mu = _prepare(fx.to(dtype), mask_x)
        y, nu = _prepare(fy.to(dtype), mask_y)
        kernel = ((x @ y.mT - 1) / eps).exp()
        a = mu
        for _ in range(n_iters):
            b = nu / (kernel.mT @ a + STABILIZER)
            a = mu / (kernel @ b + STABILIZER)
        return DensePlan(a * kernel * b.mT, floor=floor)


def _prepare(features: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Unit features and uniform weights ``(B, N, 1)``; none of either in the padding."""
    if mask is None:
        return normalize(features, dim=2), features.new_full((*features.shape[:2], 1), 1 / features.shape[1])
    weights = mask[..., None].to(features.dtype)
    features = features.masked_fill(~mask[..., None], 0.0)
    return normalize(features, dim=2), weights / weights.sum(1, keepdim=True).clamp_min(1.0)
