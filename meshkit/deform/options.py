"""The choices of a deformation, and what it reports."""

import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from meshkit._checks import check_whole
from meshkit.deform.factor import SOLVERS, check_choice

__all__ = ["ARAPInfo", "Options", "check_options"]

DEFAULT_TOL = 1e-7


@dataclass(frozen=True)
class ARAPInfo:
    """How a deformation ended; every field is (B,), or () for one mesh, on the device that did the work.

    Attributes:
        energy: float64, detached; with the soft term, if any.
        evaluations: int64, local steps: evaluations of the energy by L-BFGS, or iterations of local-global.
        residual: float64, the decrease m gᵀL⁻¹g of the energy (g half its gradient, L its stiffness, both over m) that
            one more local-global iteration is sure to bring, relative to the energy. Where the energy is below 1e-6
            (1e-10 with float64 rotations) of that of collapsing the mesh to a point, relative to that share.
        converged: bool, whether `tol` was met. Implicit gradients presume it.
        negative_curvature: bool, whether the last step met it, or, after the backward pass, whether the adjoint solve
            did: the deformation is then a saddle and its gradient is truncated.
    """

    energy: Tensor
    evaluations: Tensor
    residual: Tensor
    converged: Tensor
    negative_curvature: Tensor


@dataclass(frozen=True)
class Options:
    """The choices of :func:`~meshkit.deform.arap_deform` that all meshes share."""

    method: str
    max_iter: int
    tol: float
    grad: str
    grad_tol: float
    solver: str
    compiled: bool

    @property
    def unroll(self) -> bool:
        """Whether autograd is to record the iterations."""
        return self.grad == "unroll" and torch.is_grad_enabled()

    def batched(self, device: torch.device) -> bool:
        """Whether the whole batch is to be solved at once where its tensors are."""
        if self.solver == "dense":
            return True
        return device.type != "cpu" and self.solver in ("auto", "pcg")


def check_options(
    method: str, max_iter: int, tol: float, grad: str, grad_tol: float, solver: str, degenerate: str
) -> None:
    """Raise ValueError on an option that neither the function nor the module knows."""
    check_choice("method", method, ("lbfgs", "local_global"))
    check_choice("grad", grad, ("implicit", "unroll", "none"))
    check_choice("degenerate", degenerate, ("raise", "ignore"))
    check_choice("solver", solver, SOLVERS)
    if grad == "unroll" and method != "local_global":
        raise ValueError('grad="unroll" needs method="local_global"; "lbfgs" goes with grad="implicit"')
    check_whole(max_iter, "max_iter")
    if not tol >= 0:
        raise ValueError(f"tol must be at least 0, got {tol}")
    if not 0 < grad_tol < 1:
        raise ValueError(f"grad_tol must be in (0, 1), got {grad_tol}")


def refuse_partial_gradient(**tensors: Tensor | None) -> None:
    """Raise ValueError if unrolling would leave out a gradient that is wanted."""
    for name, value in tensors.items():
        if value is not None and value.requires_grad and torch.is_grad_enabled():
            raise ValueError(f'grad="unroll" has no gradient for {name}: detach() them or take grad="implicit"')


def warn_unconverged(residual: float, tol: float) -> None:
    """Say that an implicit gradient is taken where there is no minimum, unless it is as near as the default asks.

    The residual is given by its power of ten, so that Python shows one warning and not one per step.
    """
    if not residual > max(tol, DEFAULT_TOL):
        return
    power = math.floor(math.log10(residual)) if residual < math.inf else 308
    warnings.warn(
        f'grad="implicit" is exact at a minimum only, and the deformation ended at a residual above 1e{power:+03d}: '
        'raise max_iter, lower tol, take method="lbfgs", or differentiate the iterations of "local_global" with '
        'grad="unroll"',
        stacklevel=2,
    )
