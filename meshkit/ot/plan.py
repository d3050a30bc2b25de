"""The transport plan: a matrix known through its factors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from torch import Tensor

from meshkit._compile import uncompiled
from meshkit.ot.costs import number
from meshkit.ot.sample import SamplePlan, pad_columns, spread
from meshkit.ot.stacked import split

__all__ = ["TransportPlan"]


class TransportPlan:
    r"""A batch of transport plans :math:`T = \mathrm{diag}(a)\, K\, \mathrm{diag}(b)` that are never stored.

    Rows belong to the source (the identity mesh), columns to the target (the pose mesh). Padded rows and columns, and
    those of zero weight, carry no mass. Every reading is one sweep over blocks of the kernel, :math:`O(N + M)` memory,
    except :meth:`dense` and :meth:`assign`; :meth:`topk` gathers N k features. Readings are differentiable, except
    indices; the gradients of several readings of one plan are gathered into a single sweep.

    Plans come from :func:`~meshkit.ot.sinkhorn` and :func:`~meshkit.ot.sinkhorn_from_cost`.

    Example:
        >>> from meshkit.ot import sinkhorn
        >>> plan = sinkhorn(torch.eye(3)[None], torch.eye(3)[None, [2, 0, 1]])
        >>> plan.shape, plan.argmax().tolist()
        (torch.Size([1, 3, 3]), [[1, 2, 0]])
        >>> plan.barycentric(torch.tensor([[[1.0], [2.0], [3.0]]]))[0, :, 0]
        tensor([2., 3., 1.])
    """

    def __init__(
        self, samples: Sequence[SamplePlan] | SamplePlan, shape: tuple[int, int, int], *, transposed: bool = False
    ) -> None:
        self._given = samples
        self._shape = shape
        self._transposed = transposed

    @cached_property
    def _samples(self) -> Sequence[SamplePlan]:
        return split(self._given) if isinstance(self._given, SamplePlan) else self._given

    @property
    def _any(self) -> SamplePlan:
        """A sample, or all of them: what tells dtype and settings."""
        return self._given if isinstance(self._given, SamplePlan) else self._given[0]

    @property
    def shape(self) -> torch.Size:
        """``(B, N, M)``."""
        batch, rows, columns = self._shape
        return torch.Size((batch, columns, rows) if self._transposed else self._shape)

    def __repr__(self) -> str:
        """Shape, type and regularisation."""
        eps = number(self._any.eps)
        return f"TransportPlan(shape={tuple(self.shape)}, dtype={self.dtype}, eps={eps:g}, n_iters={self.n_iters})"

    @property
    def dtype(self) -> torch.dtype:
        """Of all values, float32 or float64."""
        return self._any.mu.dtype

    @property
    def device(self) -> torch.device:
        """Of all values."""
        return self._any.mu.device

    @property
    def T(self) -> TransportPlan:
        """The transposed plan; ``plan.T @ values`` carries values from rows to columns."""
        return TransportPlan(self._given, self._shape, transposed=not self._transposed)

    @property
    def n_iters(self) -> list[int]:
        """Iterations done for each sample; fewer than allowed where ``tol`` was reached."""
        if isinstance(self._given, SamplePlan):
            return [self._given.n_iters] * self._shape[0]
        return [sample.n_iters for sample in self._given]

    def detach(self) -> TransportPlan:
        """The same plan as a constant, without the graph and without a stored kernel: to keep for logging.

        Readings compute the kernel again.

        Example:
            >>> from meshkit.ot import sinkhorn
            >>> features = torch.eye(3, requires_grad=True)[None]
            >>> plan = sinkhorn(features, features)
            >>> plan.cost().requires_grad, plan.detach().cost().requires_grad
            (True, False)
        """
        with torch.autocast(self.device.type, enabled=False):
            samples = [sample.detach() for sample in self._samples]
        return TransportPlan(samples, self._shape, transposed=self._transposed)

    def __matmul__(self, values: Tensor) -> Tensor:
        """``T @ values`` for ``values`` of shape ``(B, M, C)``: ``(B, N, C)``. Each row holds its mass times a mean."""
        values = self._checked(values)
        if self._transposed:
            return self._per_row(lambda s, v: s.b[..., None] * s.columns(v), values)
        return self._per_row(lambda s, v: s.product(v), values)

    def barycentric(self, values: Tensor) -> Tensor:
        r"""Row-normalised product :math:`\sum_j T_{ij} v_j / \sum_j T_{ij}`, the warp of the released code.

        The row scaling cancels, so it is not needed. Rows without mass give 0.

        Args:
            values: ``(B, M, C)``.

        Returns:
            ``(B, N, C)``, each row a convex combination of the values.
        """

        def warp(sample: SamplePlan, values: Tensor) -> Tensor:
            if self._transposed:
                product = sample.columns(torch.cat([values, values.new_ones(*values.shape[:-1], 1)], -1))
                product, mass = product[..., :-1], product[..., -1:]
            else:
                product, mass = sample.rows(values)
            starved = mass <= 0
            return torch.where(starved, 0.0, product / torch.where(starved, 1.0, mass))

        return self._per_row(warp, self._checked(values))

    def row_sums(self) -> Tensor:
        """Mass that leaves each row, ``(B, N)``."""
        return self._per_row(lambda s: s.column_mass() if self._transposed else s.row_mass())

    def marginals(self) -> tuple[Tensor, Tensor]:
        """Row sums ``(B, N)`` and column sums ``(B, M)``."""
        return self.row_sums(), self.T.row_sums()

    @property
    def residual(self) -> Tensor:
        r"""Violation of the marginals, ``(B,)``, as a sum of absolute differences over both sides.

        Zero once balanced transport has converged; rows alone are exact after any number of iterations.
        """
        return self.read_samples(lambda s: (s.row_mass() - s.mu).abs().sum() + (s.column_mass() - s.nu).abs().sum())

    @property
    @uncompiled
    def potentials(self) -> tuple[Tensor, Tensor]:
        r"""Dual potentials ``f (B, N)`` and ``g (B, M)`` in units of the cost.

        :math:`T_{ij} = \exp((f_i + g_j - C_{ij}) / \varepsilon)`; -inf where there is no mass. In balanced transport a
        constant may move from f to g: it is that of the iterations, but with ``grad="implicit"``, whose gradient is of
        the limit, the one that makes :math:`\sum_j \nu_j g_j = 0`.
        """
        rows, columns = zip(*(sample.potentials() for sample in self._samples), strict=True)
        f = self._spread(rows, over_rows=True, empty=-torch.inf)
        g = self._spread(columns, over_rows=False, empty=-torch.inf)
        return (g, f) if self._transposed else (f, g)

    def cost(self) -> Tensor:
        r"""Transport cost :math:`\sum_{ij} T_{ij} C_{ij}` of each sample, ``(B,)``."""
        return self.read_samples(SamplePlan.cost)

    def entropy(self) -> Tensor:
        r"""Entropy :math:`-\sum_{ij} T_{ij} \log T_{ij}` of each sample, ``(B,)``, in nats."""
        return self.read_samples(SamplePlan.entropy)

    def argmax(self, dim: int = 2) -> Tensor:
        """Index of the heaviest entry of each row (``dim=2``, ``(B, N)``) or column (``dim=1``, ``(B, M)``).

        0 for rows (columns) without mass.
        """
        return self._heaviest(1, dim)[1][..., 0]

    @uncompiled
    def topk(self, k: int, *, dim: int = 2) -> tuple[Tensor, Tensor]:
        """The ``k`` heaviest entries of each row (``dim=2``) or column (``dim=1``), heaviest first.

        Returns:
            masses (differentiable) and int64 indices, each ``(B, N, k)`` (``(B, M, k)`` for columns); both 0 for rows
            without mass, and beyond the number of real columns.
        """
        local, index = self._heaviest(k, dim)
        over_rows = (dim in (2, -1)) != self._transposed
        with torch.autocast(self.device.type, enabled=False):
            masses = [s.log_masses(near, over_rows).exp() for s, near in zip(self._samples, local, strict=True)]
        return self._spread([pad_columns(mass, k) for mass in masses], over_rows=over_rows), index

    @uncompiled
    def log_at(self, columns: Tensor) -> Tensor:
        r"""Logarithm of one entry of each row, :math:`\log T_{i, c(i)}`, differentiable.

        Args:
            columns: int64 ``(B, N)``, the column c(i) of each row; negative where there is none.

        Returns:
            ``(B, N)``; -inf at negative columns, in padded columns, and for rows without mass.

        Raises:
            ValueError: another shape, or columns that are not integers.
            IndexError: columns beyond M (on a CPU; on CUDA the device asserts).

        Example:
            >>> from meshkit.ot import sinkhorn
            >>> plan = sinkhorn(torch.eye(3)[None], torch.eye(3)[None, [2, 0, 1]])
            >>> plan.log_at(torch.tensor([[1, 2, -1]])).exp()  # a third each, the mass of a row
            tensor([[0.3333, 0.3333, 0.0000]])
        """
        batch, rows, size = self.shape
        if columns.shape != (batch, rows) or columns.dtype not in (torch.int64, torch.int32):
            raise ValueError(
                f"columns must be integers of shape (B, N) = {(batch, rows)}, got {columns.dtype} of "
                f"{tuple(columns.shape)}"
            )
        found = []
        with torch.autocast(self.device.type, enabled=False):
            for sample, wanted in zip(self._samples, columns.long(), strict=True):
                own, other = (sample.index_x, sample.index_y)[:: -1 if self._transposed else 1]
                near = wanted if own is None else wanted[own]
                if other is not None:  # from the padded batch's columns to those that have weight
                    local = torch.full((size,), -1, device=self.device)
                    local[other] = torch.arange(len(other), device=self.device)
                    near = torch.where(near < 0, near, local[near.clamp_min(0)])
                none = near < 0
                values = sample.log_masses(near.clamp_min(0)[:, None], not self._transposed)[:, 0]
                found.append(values.masked_fill(none, -torch.inf))
        return self._spread(found, over_rows=not self._transposed, empty=-torch.inf)

    def _heaviest(self, k: int, dim: int) -> tuple[list[Tensor], Tensor]:
        """Positions among the rows (columns) that have weight, and in the padded batch."""
        if dim not in (1, 2, -1, -2):
            raise ValueError(f"dim must be 1 (best rows of each column) or 2 (best columns of each row), got {dim}")
        if not 1 <= k <= self.shape[dim]:
            raise ValueError(f"k must be between 1 and {self.shape[dim]}, the number of candidates, got {k}")
        over_rows = (dim in (2, -1)) != self._transposed
        local = [sample.heaviest(k, over_rows) for sample in self._samples]
        index = []
        for sample, near in zip(self._samples, local, strict=True):
            positions = sample.index_y if over_rows else sample.index_x
            index.append(pad_columns(near if positions is None else positions[near], k))
        return local, self._spread(index, over_rows=over_rows)

    def mutual(self) -> tuple[Tensor, Tensor]:
        """Mutual nearest neighbours: the heaviest column of each row, and whether that column prefers this row too.

        Returns:
            int64 indices and a bool mask, both ``(B, N)``; False for rows without mass.
        """
        best, back = self.argmax(2), self.argmax(1)
        alive = self._per_row(lambda s: s.nu > 0 if self._transposed else s.mu > 0)
        rows = torch.arange(best.shape[1], device=best.device)
        return best, (back.gather(1, best) == rows) & alive

    def assign(self) -> Tensor:
        r"""One-to-one matching of the largest :math:`\sum \log T`, by the Hungarian method on the stored matrix.

        With as many rows as columns this is the exact assignment of the least total cost. :math:`O(N^3)` time.

        Returns:
            int64 ``(B, N)``, the column of each row; -1 for rows left over or without mass.
        """
        from scipy.optimize import linear_sum_assignment

        def solve(sample: SamplePlan) -> Tensor:
            with torch.no_grad():
                scores = sample.log_dense().double().nan_to_num(neginf=-1e300).cpu()
            scores = scores.mT if self._transposed else scores
            row, column = linear_sum_assignment(scores.numpy(), maximize=True)
            matched = torch.full((len(scores),), -1, device="cpu")
            matched[torch.from_numpy(row)] = torch.from_numpy(column)
            positions = sample.index_x if self._transposed else sample.index_y
            if positions is not None:
                matched = torch.where(matched < 0, -1, positions.cpu()[matched])
            return matched.to(self.device)

        return self._spread([solve(sample) for sample in self._samples], over_rows=not self._transposed, empty=-1)

    def dense(self) -> Tensor:
        """The matrix itself, ``(B, N, M)``."""
        return self._dense(lambda s: s.log_dense().exp(), 0.0)

    def log_dense(self) -> Tensor:
        """Its logarithm, ``(B, N, M)``; -inf where there is no mass."""
        return self._dense(SamplePlan.log_dense, -torch.inf)

    @uncompiled
    def _dense(self, read: Callable[[SamplePlan], Tensor], empty: float) -> Tensor:
        _, rows, columns = self._shape
        full = []
        for sample in self._samples:
            with torch.autocast(self.device.type, enabled=False):
                matrix = spread(read(sample), sample.index_x, rows, empty)
                full.append(spread(matrix.mT, sample.index_y, columns, empty).mT)
        result = torch.stack(full)
        return result.mT if self._transposed else result

    @uncompiled
    def read_samples(self, read: Callable[[SamplePlan], Tensor]) -> Tensor:
        """Read one number of each sample, ``(B,)``."""
        with torch.autocast(self.device.type, enabled=False):
            return torch.stack([read(sample) for sample in self._samples])

    @uncompiled
    def _per_row(self, read: Callable[..., Tensor], values: Tensor | None = None, *, empty: float = 0.0) -> Tensor:
        """Read each sample, and spread what it says of its rows over the padded rows; ``values`` belong to columns."""
        result = []
        with torch.autocast(self.device.type, enabled=False):
            if isinstance(self._given, SamplePlan):
                return read(self._given) if values is None else read(self._given, values)
            for b, sample in enumerate(self._samples):
                columns = sample.index_x if self._transposed else sample.index_y
                arguments = []
                if values is not None:
                    arguments.append(values[b] if columns is None else values[b].index_select(0, columns))
                result.append(read(sample, *arguments))
        return self._spread(result, over_rows=not self._transposed, empty=empty)

    def _spread(self, values: Sequence[Tensor], *, over_rows: bool, empty: float = 0.0) -> Tensor:
        """Stack what belongs to the samples' rows (or columns), with ``empty`` in the padding."""
        size = self._shape[1 if over_rows else 2]
        indices = [sample.index_x if over_rows else sample.index_y for sample in self._samples]
        return torch.stack([spread(v, index, size, empty) for v, index in zip(values, indices, strict=True)])

    def _checked(self, values: Tensor) -> Tensor:
        batch, _, columns = self.shape
        if values.dim() != 3 or values.shape[:2] != (batch, columns):
            raise ValueError(
                f"values must have shape (B, M, C) with (B, M) = {(batch, columns)}, got {tuple(values.shape)}"
            )
        return values.to(self.dtype)
