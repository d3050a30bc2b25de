"""The transport plan: a matrix known through its factors."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["TransportPlan"]


class TransportPlan:
    r"""A batch of transport plans :math:`T = \mathrm{diag}(a)\, K\, \mathrm{diag}(b)`.

    Rows belong to the source (the identity mesh), columns to the target (the pose mesh). Padded rows and columns
    have :math:`a_i = 0`, :math:`b_j = 0` and so carry no mass.

    Args:
        kernel: ``(B, N, M)``, :math:`K`, non-negative.
        a: ``(B, N)`` row scaling.
        b: ``(B, M)`` column scaling.

    Example:
        >>> plan = TransportPlan(torch.eye(2)[None], torch.full((1, 2), 0.5), torch.ones(1, 2))
        >>> (plan @ torch.tensor([[[2.0], [4.0]]]))[0, :, 0].tolist()
        [1.0, 2.0]
        >>> plan.barycentric(torch.tensor([[[2.0], [4.0]]]))[0, :, 0].tolist()
        [2.0, 4.0]
    """

    __slots__ = ("a", "b", "kernel")

    def __init__(self, kernel: Tensor, a: Tensor, b: Tensor) -> None:
        self.kernel, self.a, self.b = kernel, a, b

    @property
    def shape(self) -> torch.Size:
        """``(B, N, M)``."""
        return self.kernel.shape

    @property
    def T(self) -> TransportPlan:
        """The transposed plan; ``plan.T @ values`` carries values from rows to columns."""
        return TransportPlan(self.kernel.mT, self.b, self.a)

    def __matmul__(self, values: Tensor) -> Tensor:
        """``T @ values`` for ``values`` of shape ``(B, M, C)``: ``(B, N, C)``. Each row holds its mass times a mean."""
        self._check(values)
        return self.a[..., None] * self._product(self.b[..., None] * values)

    def barycentric(self, values: Tensor) -> Tensor:
        r"""Row-normalised product :math:`\sum_j T_{ij} v_j / \sum_j T_{ij}`, the warp of the released code.

        The row scaling cancels, so it is not needed. Rows without mass give 0.

        Args:
            values: ``(B, M, C)``.

        Returns:
            ``(B, N, C)``, each row a convex combination of the values.
        """
        self._check(values)
        weighted = torch.cat([values, values.new_ones(*values.shape[:2], 1)], 2) * self.b[..., None]
        product = self._product(weighted)
        alive = (self.a[..., None] > 0) & (product[..., -1:] > 0)
        mass = torch.where(alive, product[..., -1:], 1.0)
        return torch.where(alive, product[..., :-1] / mass, 0.0)

    def row_sums(self) -> Tensor:
        """Mass that leaves each row, ``(B, N)``."""
        return self.a * self._product(self.b[..., None])[..., 0]

    def marginals(self) -> tuple[Tensor, Tensor]:
        """Row sums ``(B, N)`` and column sums ``(B, M)``."""
        return self.row_sums(), self.T.row_sums()

    def argmax(self, dim: int = 2) -> Tensor:
        """Index of the heaviest entry of each row (``dim=2``, ``(B, N)``) or column (``dim=1``, ``(B, M)``)."""
        if dim not in (1, 2):
            raise ValueError(f"dim must be 1 (best row of each column) or 2 (best column of each row), got {dim}")
        scale = self.b[:, None] if dim == 2 else self.a[..., None]
        return (self.kernel.detach() * scale.detach()).argmax(dim)

    def dense(self) -> Tensor:
        """The matrix itself, ``(B, N, M)``."""
        return self.a[..., None] * self.kernel * self.b[:, None]

    def _product(self, columns: Tensor) -> Tensor:
        """``kernel @ columns``, outside autocast: in bfloat16 exact marginals would be off by half a per cent."""
        with torch.autocast(columns.device.type, enabled=False):
            return self.kernel @ columns.to(self.kernel.dtype)

    def _check(self, values: Tensor) -> None:
        if values.dim() != 3 or values.shape[:2] != self.b.shape:
            raise ValueError(
                f"values must have shape (B, M, C) with (B, M) = {tuple(self.b.shape)}, got {tuple(values.shape)}"
            )
