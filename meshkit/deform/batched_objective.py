"""The energies of a whole batch on one device."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from meshkit.deform.batched_factor import BatchedFactor
from meshkit.deform.batched_rotation import Differential
from meshkit.deform.conjugate_gradients import conjugate_gradients_batch
from meshkit.deform.objective import Objective
from meshkit.deform.sparse import linear

__all__ = ["BatchedObjective"]


class BatchedObjective(Objective):
    """Energies of a batch, all in float64. Matrices of cells are (K, 3, 3)."""

    floor, look = 1e-10, 8

    def __init__(self, factor: BatchedFactor, soft_targets: Tensor | None) -> None:
        self.rest, self.free, self._solve = factor.rest, factor.free, factor.solve
        super().__init__(self.rest, factor.stiffness, factor.soft, soft_targets)

    def pulled_back(self, rotations: Tensor) -> Tensor:
        """B^T R (V, 3); differentiable."""
        stacked = rotations.permute(2, 0, 1).reshape(-1, 3)
        return linear(stacked, self.rest.moments_t.matmul, self.rest.moments.matmul)

    def rotations(self, x: Tensor, guess: Any) -> tuple[Tensor, Any]:
        """Best rotations; no guess helps."""
        return self.rest.rotations(x), None

    def tracked_rotations(self, x: Tensor) -> Tensor:
        """Best rotations."""
        return self.rest.rotations(x)

    def linearise(self, x: Tensor, *, precise: bool) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Best rotations at x, and the map D[B p] from a direction p (V, 3) to their change; always precise."""
        R = self.rest.rotations(x)
        differential = Differential(self.rest.matrices(x), R)
        return R, lambda direction: differential(self.rest.matrices(direction))

    def component_first(self, rotations: Tensor) -> Tensor:
        """Rotations (K, 3, 3) as (column, row, cell)."""
        return rotations.permute(2, 1, 0).contiguous()

    def solve(self, right: Tensor) -> Tensor:
        """Apply the inverse of the stiffness of the free vertices; 0 at the others, whatever `right` is there."""
        return self._solve(right)

    def solve_hessian(self, product: Callable[[Tensor], Tensor], right: Tensor, *, tol: float) -> tuple[Tensor, Tensor]:
        """Solve H x = b for the free vertices, given H; and for which meshes (B,) it is not positive."""
        settings: dict[str, Any] = {"tol": tol, "max_iter": 500, "look": self.look}
        return conjugate_gradients_batch(product, self.solve, right, dot=self.dot, spread=self.spread, **settings)

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner product (B,) of vectors, for each mesh."""
        return (a * b).view(self.rest.batch, -1).sum(1)

    def spread(self, values: Tensor) -> Tensor:
        """Values (B,) per mesh as a column (V, 1)."""
        return values.repeat_interleave(self.rest.size)[:, None]
