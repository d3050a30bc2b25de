"""The energy of one mesh on the CPU."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.conjugate_gradients import conjugate_gradients
from meshkit.deform.factor import ARAPFactor
from meshkit.deform.objective import Objective
from meshkit.deform.options import ARAPInfo
from meshkit.deform.rotation import ClosestRotation, RotationDifferential
from meshkit.deform.sparse import csr_of_scipy, linear
from meshkit.deform.tracker import RotationTracker

__all__ = ["MeshObjective"]


class MeshObjective(Objective):
    """Energy of one mesh; its evaluations take rotations of `dtype`, which Newton's method finds from the last ones.

    Matrices of cells are stored transposed and component first, (column, row, cell), the order in which the products
    come.
    """

    def __init__(
        self, factor: ARAPFactor, soft_targets: Tensor | None, *, dtype: torch.dtype, compiled: bool = False
    ) -> None:
        self.factor, self.dtype = factor, dtype
        rest, size = factor.rest, factor.rest.topology.num_verts
        self.tracker = RotationTracker(compiled=compiled)
        self.evaluations = 0
        # Rotations ignore scale: bring the matrices near 1, where float32 has room.
        cells = rest.topology.num_cells
        self.scale = rest.rest_energy / rest.topology.multiplicity / max(cells, 1) or 1.0
        # On the CPU torch's products with three columns are twice as fast as scipy's.
        self.moments, self.moments_t = csr_of_scipy(rest.moments, 1 / self.scale), csr_of_scipy(rest.moments_t)
        self.free = torch.zeros(size, 1, dtype=torch.bool, device="cpu")
        self.free[factor.free] = True
        soft = None if factor.soft is None else factor.soft[:, None]
        super().__init__(rest, csr_of_scipy(factor.stiffness), soft, soft_targets)

    @property
    def floor(self) -> float:  # type: ignore[override]
        """See :class:`Objective`: float32 rotations do not resolve less."""
        return 1e-6 if self.dtype == torch.float32 else 1e-10

    def start_from_rest(self) -> None:
        """Let the tracked rotations start from the identity."""
        self.tracker.start(self.factor.rest.topology.num_cells, self.dtype)

    def refine(self) -> None:
        """Go over to float64 rotations."""
        self.dtype, self.tracker.slack = torch.float64, 1e-4

    def matrices(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """S of every cell over `scale`, or its change if x is one; differentiable."""
        stacked = linear(x, self.moments.matmul, lambda S: self.moments_t @ S / self.scale)
        return stacked.to(dtype).view(-1, 9).t().contiguous().view(3, 3, -1)

    def pulled_back(self, rotations: Tensor) -> Tensor:
        """B^T R (V, 3); differentiable."""
        stacked = rotations.reshape(9, -1).t().contiguous().double().view(-1, 3)
        return linear(stacked, self.moments_t.matmul, lambda x: self.moments @ x * self.scale)

    def rotations(self, x: Tensor, guess: Any) -> tuple[Tensor, Any]:
        """Best rotations, and their quaternions as the next guess."""
        rotations, quaternions = ClosestRotation.apply(self.matrices(x, self.dtype), guess)
        return rotations, quaternions

    def ended(self, x: Tensor, iterations: Tensor, tol: float) -> ARAPInfo:
        """The report on iterations that ended at x, by float64 rotations."""
        self.tracker.last = None
        self.refine()
        return super().ended(x, iterations, tol)

    def tracked_rotations(self, x: Tensor) -> Tensor:
        """Best rotations for an x near that of the last call."""
        self.evaluations += 1
        return self.tracker(self.matrices(x, self.dtype))

    def linearise(self, x: Tensor, *, precise: bool) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Best rotations at x, and the map D[B p] from a direction p (V, 3) to their change."""
        dtype = torch.float64 if precise else torch.float32
        S = self.matrices(x, torch.float64)
        last = self.tracker.last
        R = ClosestRotation.apply(S, None if last is None else last[0].double())[0].to(dtype)
        differential = RotationDifferential(S.to(dtype), R)
        return R, lambda direction: differential(self.matrices(direction, dtype))

    def component_first(self, rotations: Tensor) -> Tensor:
        """Rotations as they are."""
        return rotations

    def solve(self, right: Tensor) -> Tensor:
        """Apply the inverse of the stiffness of the free vertices; 0 at the others."""
        free = self.factor.free
        solved = self.factor.solve(right.index_select(0, free).numpy())
        # Unlike a copy to rows of a slice, this one is not slow where the factor gives columns.
        return torch.zeros_like(right).index_copy_(0, free, torch.from_numpy(solved))

    def solve_hessian(self, product: Callable[[Tensor], Tensor], right: Tensor, *, tol: float) -> tuple[Tensor, Tensor]:
        """Solve H x = b for the free vertices, given H; and whether it is not positive."""
        solution, negative = conjugate_gradients(product, self.solve, right, dot=self.dot, tol=tol, max_iter=500)
        return solution, torch.tensor(negative, device="cpu")

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner product () of vectors."""
        return torch.dot(a.view(-1), b.view(-1))

    def spread(self, values: Tensor) -> Tensor:
        """The value, which broadcasts as it is."""
        return values
