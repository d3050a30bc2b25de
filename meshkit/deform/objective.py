"""The energy with its rotations eliminated, and its minimisation by preconditioned L-BFGS."""

import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.factor import ARAPFactor
from meshkit.deform.tracker import RotationTracker

__all__ = ["Objective", "Outcome", "minimise"]

# Of L-BFGS, for one mesh as for a batch.
MEMORY, HALVINGS, SUFFICIENT = 5, 8, 2e-4
LONGEST = 4.0  # times the step of local-global


@dataclass
class Outcome:
    """Where one minimisation ended; see :class:`meshkit.deform.ARAPInfo`."""

    x: Tensor
    energy: float
    evaluations: int
    residual: float
    converged: bool
    negative_curvature: bool


class Objective:
    r"""Energy over m and half its gradient, :math:`g = (L + W) x - B^\top R(x) - W t`, W the soft weights.

    Positions and sums are float64, about the origin of the rest shape; the rotations are those of `dtype`. Matrices of
    cells are stored transposed and component first, (column, row, cell), the order in which the products come.
    """

    def __init__(
        self, factor: ARAPFactor, soft_targets: Tensor | None, *, dtype: torch.dtype, compiled: bool = False
    ) -> None:
        self.factor, self.rest, self.dtype = factor, factor.rest, dtype
        self.tracker = RotationTracker(compiled=compiled)
        self.evaluations = 0
        self.image = torch.empty(0, device="cpu")  # of the last evaluation: free rows of (L + W) x
        topology = self.rest.topology
        self.constant = self.rest.rest_energy / topology.multiplicity
        # Rotations ignore scale: bring the matrices near 1, where float32 has room.
        self.scale = self.constant / max(topology.num_cells, 1) or 1.0
        # On the CPU torch's products with three columns are twice as fast as scipy's.
        self.moments = _tensor(self.rest.moments, 1 / self.scale)
        self.moments_t, self.stiffness = _tensor(self.rest.moments_t), _tensor(factor.stiffness)
        self.pull: Tensor | None = None
        if factor.soft is not None and soft_targets is not None:
            self.pull = factor.soft[:, None] * soft_targets
            self.constant += dot(self.pull, soft_targets)
        count = len(factor.free)
        self._padded = torch.zeros(count + 1, 3, dtype=torch.float64, device="cpu")
        self._place = torch.full((topology.num_verts,), count, dtype=torch.int32, device="cpu")
        self._place[factor.free] = torch.arange(count, dtype=torch.int32, device="cpu")

    def start_from_rest(self) -> None:
        """Let the rotations start from the identity."""
        self.tracker.start(self.rest.topology.num_cells, self.dtype)

    def spread(self, free: Tensor) -> Tensor:
        """Vectors of the free vertices as (V, 3), zero at the handles."""
        self._padded[:-1] = free
        return self._padded.index_select(0, self._place)

    def solve(self, right: Tensor) -> Tensor:
        """Apply the inverse of the stiffness of the free vertices."""
        return torch.from_numpy(self.factor.solve(right.numpy())).contiguous()

    def matrices(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """S of every cell over `scale`, or its change if x is one."""
        return (self.moments @ x).to(dtype).view(-1, 9).t().contiguous().view(3, 3, -1)

    def pulled_back(self, rotations: Tensor) -> Tensor:
        """B^T R."""
        return self.moments_t @ rotations.view(9, -1).t().contiguous().double().view(-1, 3)

    def __call__(self, x: Tensor) -> tuple[float, Tensor]:
        """Energy over m, and the free rows of half the gradient."""
        self.evaluations += 1
        force = self.pulled_back(self.tracker(self.matrices(x, self.dtype)))
        if self.pull is not None:
            force += self.pull
        image = self.stiffness @ x
        energy = dot(x, torch.sub(image, force, alpha=2)) + self.constant
        self.image = image.index_select(0, self.factor.free)
        return energy, self.image - force.index_select(0, self.factor.free)

    def global_step(self, x: Tensor) -> Tensor:
        """Positions that minimise the energy while every rotation is the identity."""
        force = self.moments_t @ torch.eye(3, dtype=torch.float64, device="cpu").repeat(self.rest.topology.num_cells, 1)
        if self.pull is not None:
            force += self.pull
        gradient = (self.stiffness @ x - force).index_select(0, self.factor.free)
        return x - self.spread(self.solve(gradient))

    def residual(self, energy: float, gradient: Tensor) -> float:
        """Decrease g^T L^-1 g that one local-global iteration is sure to bring, relative."""
        return self.relative(dot(gradient, self.solve(gradient)), energy)

    def relative(self, decrease: float, energy: float) -> float:
        """A decrease over the energy, or over a share of the energy of collapsing the mesh if that is more."""
        floor = 1e-6 if self.dtype == torch.float32 else 1e-10
        return decrease / max(energy, floor * abs(self.constant), 1e-300)


def minimise(objective: Objective, x: Tensor, *, max_iter: int, tol: float, refine: bool) -> Outcome:
    """L-BFGS whose metric is the factored stiffness, so that its first step is one of local-global.

    The turning of the rotations makes the energy flatter than its stiffness L says. By how much, the last step s and
    change y of the gradient tell: the metric is L over s^T L s / s^T y, at least 1.

    Args:
        objective: what to minimise.
        x: (V, 3) positions that meet the handles.
        max_iter: evaluations at most.
        tol: residual at which to stop.
        refine: go over to float64 rotations once float32 ones have done what they can.
    """
    history: list[tuple[Tensor, Tensor, float]] = []
    energy, gradient = objective(x)
    image, stretch = objective.image, 1.0
    slack = 1e-13 * abs(objective.constant)
    negative = False
    while True:
        direction = _two_loops(objective, history, gradient, stretch)
        decrease = dot(gradient, direction)
        # Without a history this is g^T L^-1 g; with one it knows the curvature too, and is mostly larger.
        residual = objective.relative(decrease, energy)
        if refine and tol < 1e-7 and objective.dtype == torch.float32 and residual <= 1e-7:
            energy, gradient = _in_float64(objective, x)
            history.clear()
            image, stretch = objective.image, 1.0
            continue
        if residual <= tol or objective.evaluations >= max_iter:
            break
        step, accepted, along = 1.0, False, objective.spread(direction)
        for _ in range(HALVINGS):
            candidate = torch.sub(x, along, alpha=step)
            new_energy, new_gradient = objective(candidate)
            accepted = new_energy <= energy - SUFFICIENT * step * decrease + slack
            if accepted or objective.evaluations >= max_iter:
                break
            step *= 0.5
        if not accepted:
            if history:
                history.clear()
            elif refine and objective.dtype == torch.float32:
                energy, gradient = _in_float64(objective, x)
                image = objective.image
            else:
                break
            stretch = 1.0
            continue
        move, change = direction.mul_(-step), new_gradient - gradient
        curvature = dot(move, change)
        negative = curvature < 0
        if curvature > 0:
            history = [*history[1 - MEMORY :], (move, change, 1 / curvature)]
            stretch = min(max(dot(move, objective.image - image) / curvature, 1.0), LONGEST)
        else:
            history.clear()
            stretch = 1.0
        x, energy, gradient, image = candidate, new_energy, new_gradient, objective.image
    converged = residual <= tol
    if history:
        residual = objective.residual(energy, gradient)
    return Outcome(x, energy, objective.evaluations, residual, converged, negative)


def _in_float64(objective: Objective, x: Tensor) -> tuple[float, Tensor]:
    objective.dtype = torch.float64
    objective.tracker.slack = 1e-4
    return objective(x)


def _two_loops(
    objective: Objective, history: list[tuple[Tensor, Tensor, float]], gradient: Tensor, stretch: float
) -> Tensor:
    """The L-BFGS inverse Hessian applied to a gradient."""
    right, shares = gradient.clone(), []
    for move, change, inverse in reversed(history):
        shares.append(inverse * dot(move, right))
        right.sub_(change, alpha=shares[-1])
    direction = objective.solve(right).mul_(stretch)
    for (move, change, inverse), share in zip(history, reversed(shares), strict=True):
        direction.add_(move, alpha=share - inverse * dot(change, direction))
    return direction


def dot(a: Tensor, b: Tensor) -> float:
    return float(torch.dot(a.view(-1), b.view(-1)))


def _tensor(matrix: Any, factor: float = 1.0) -> Tensor:
    """A scipy CSR matrix times a number."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
        indptr, indices = torch.from_numpy(matrix.indptr), torch.from_numpy(matrix.indices)
        data = torch.from_numpy(matrix.data * factor)
        return torch.sparse_csr_tensor(indptr, indices, data, size=matrix.shape, device="cpu", check_invariants=False)
