"""The energy with its rotations eliminated, as a function of the positions."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.batched_rest import BatchedRest
from meshkit.deform.options import ARAPInfo
from meshkit.deform.rest import ARAPRest

__all__ = ["Objective"]


class Objective(ABC):
    r"""Energy over m and half its gradient, :math:`g = (L + W) x - B^\top R(x) - W t`, W the soft weights.

    Of one mesh, or of a batch whose vertices and cells are numbered through, V and K in all. Positions and sums are
    float64, about the origins of the rest shapes; vectors are (V, 3), and what there is per mesh is (B,), or () for one
    mesh. How the matrices of the cells are stored, and how their rotations are found, is up to the subclass: long rows
    and a search from the last rotations on the CPU, batched products without a branch on a GPU.

    Args:
        rest: the rest shapes.
        stiffness: (V, V) sparse L + W.
        soft: (V, 1) soft weights over m, or None.
        soft_targets: (V, 3) t; differentiable.

    Attributes:
        free: (V, 1) bool, the vertices to solve for.
        constant: (B,) what the energy holds beside its terms in x.
        image: (L + W) x of the last evaluation.
        floor: share of the constant that a residual is relative to where the energy is less.
    """

    free: Tensor
    floor: float

    def __init__(
        self, rest: ARAPRest | BatchedRest, stiffness: Tensor, soft: Tensor | None, soft_targets: Tensor | None
    ) -> None:
        self.verts, self.edges, self.force_at_rest = rest.verts, rest.edges, rest.force_at_rest
        self.stiffness, self.soft, self.image = stiffness, soft, rest.verts
        self.constant = self.dot(self.verts, self.force_at_rest)
        self.pull: Tensor | None = None
        if soft is not None and soft_targets is not None:
            self.pull = soft * soft_targets
            self.constant = self.constant + self.dot(self.pull.detach(), soft_targets.detach())

    @abstractmethod
    def pulled_back(self, rotations: Tensor) -> Tensor:
        """B^T R (V, 3); differentiable."""

    @abstractmethod
    def rotations(self, x: Tensor, guess: Any) -> tuple[Tensor, Any]:
        """Best rotations, differentiable, searched from a guess if it helps; and the guess for the next x."""

    @abstractmethod
    def tracked_rotations(self, x: Tensor) -> Tensor:
        """Best rotations for an x near that of the last call."""

    @abstractmethod
    def linearise(self, x: Tensor, *, precise: bool) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Best rotations at x, and the map D[B p] from a direction p (V, 3) to their change."""

    @abstractmethod
    def component_first(self, rotations: Tensor) -> Tensor:
        """Rotations as :class:`FaceEdges` wants them."""

    @abstractmethod
    def solve(self, right: Tensor) -> Tensor:
        """Apply the inverse of the stiffness of the free vertices; 0 at the others, whatever `right` is there."""

    @abstractmethod
    def solve_hessian(self, product: Callable[[Tensor], Tensor], right: Tensor, *, tol: float) -> tuple[Tensor, Tensor]:
        """Solve H x = b for the free vertices, given H; and for which meshes (B,) it is not positive."""

    @abstractmethod
    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner product (B,) of vectors, for each mesh."""

    @abstractmethod
    def spread(self, values: Tensor) -> Tensor:
        """Values per mesh as a column that broadcasts with vectors."""

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Energies (B,), and half gradients (V, 3), of which the fixed vertices' part is of no concern."""
        force = self.pulled_back(self.tracked_rotations(x))
        if self.pull is not None:
            force += self.pull.detach()
        self.image = self.stiffness @ x
        energy = self.dot(x, torch.sub(self.image, force, alpha=2)) + self.constant
        return energy, self.image - force

    def residual(self, energy: Tensor, gradient: Tensor) -> Tensor:
        """Decrease g^T L^-1 g that one local-global iteration is sure to bring, relative."""
        return self.relative(self.dot(gradient, self.solve(gradient)), energy)

    def relative(self, decrease: Tensor, energy: Tensor) -> Tensor:
        """A decrease over the energy, or over a share of the energy of collapsing the mesh if that is more."""
        return decrease / torch.maximum(energy, self.floor * self.constant.abs()).clamp_min(1e-300)

    def info(
        self, energy: Tensor, evaluations: Tensor, residual: Tensor, converged: Tensor, negative: Tensor
    ) -> ARAPInfo:
        """The report on minimisations that ended at an energy over m."""
        return ARAPInfo(energy * self.edges.multiplicity, evaluations, residual, converged, negative)

    def ended(self, x: Tensor, iterations: Tensor, tol: float) -> ARAPInfo:
        """The report on iterations that ended at x, whose energy they do not know."""
        energy, gradient = self(x)
        residual = self.residual(energy, gradient)
        return self.info(energy, iterations, residual, residual <= tol, torch.zeros_like(residual, dtype=torch.bool))
