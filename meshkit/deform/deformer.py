"""The ARAP deformer of X-DualNet: bend a mesh until a few random vertices meet a target."""

from typing import Any

import torch
from torch import Tensor, nn

from meshkit._compile import uncompiled
from meshkit._repr import settings
from meshkit.deform.dispatch import Kind, dispatch
from meshkit.deform.options import ARAPInfo, Options, check_options, refuse_partial_gradient
from meshkit.deform.topology import check_energy

__all__ = ["ARAPDeformer"]


class ARAPDeformer(nn.Module):
    r"""Deform `rest` so that a random fraction of its vertices meets `target`, as rigidly as possible.

    .. math:: \hat M_{output} = \mathrm{ARAP}(M_A, M_{output})

    keeps the shape of the identity mesh :math:`M_A` where the generated mesh :math:`M_{output}` lost it. Handles are
    drawn anew in every call and differ between the meshes of a batch: round(fraction * real vertices) of them, but at
    least one in every connected component, isolated vertices included.

    Args:
        fraction: share of the vertices that are handles, in (0, 1].
        energy: see :func:`meshkit.deform.arap_energy`. The paper's setting is "spokes".
        method: "lbfgs" or "local_global", see :func:`meshkit.deform.arap_deform`. None takes "local_global" for
            ``grad="unroll"``, which needs it, and for "spokes", the paper's setting, and "lbfgs" otherwise.
        max_iter: evaluations, or iterations from rest, at most.
        tol: residual at which to stop; None is 0 for "local_global", which then does all its iterations, else 1e-7.
        grad: "implicit" differentiates the minimum with respect to `rest` and `target`; "unroll" the iterations with
            respect to `target`; "none" returns a constant.
        grad_tol, solver, compiled, degenerate: see :func:`meshkit.deform.arap_deform`.
        generator: source of the random handles; None uses the global CPU generator, so that ``torch.manual_seed``
            repeats a run on any device and differently seeded processes draw different handles.

    Raises:
        ValueError: `fraction` is not in (0, 1], or an unknown option.

    Reference:
        X-DualNet, section "ARAP deformer" and implementation details: 10 % of the vertices, 50 iterations:
        ``ARAPDeformer(**PRESETS["xdualnet"])``.

    Deviations:
        The released code records no gradient (``grad="none"``), so its losses on the deformed mesh are constants.

    Example:
        >>> rest = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
        >>> faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        >>> deformed = ARAPDeformer(fraction=0.75, max_iter=10)(rest, rest + 1.0, faces)
        >>> torch.allclose(deformed, rest + 1.0, atol=1e-5)
        True
    """

    def __init__(
        self,
        fraction: float = 0.1,
        *,
        energy: str = "spokes_and_rims",
        method: str | None = None,
        max_iter: int = 50,
        tol: float | None = None,
        grad: str = "implicit",
        grad_tol: float = 1e-3,
        solver: str = "auto",
        compiled: bool = False,
        degenerate: str = "raise",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if not 0 < fraction <= 1:
            raise ValueError(f"fraction must be in (0, 1], got {fraction}")
        check_energy(energy)
        if method is None:
            method = "local_global" if grad == "unroll" or energy == "spokes" else "lbfgs"
        if tol is None:
            tol = 0.0 if method == "local_global" else 1e-7
        check_options(method, max_iter, tol, grad, grad_tol, solver, degenerate)
        self.fraction, self.energy, self.generator = fraction, energy, generator
        self.degenerate = degenerate
        self.options = Options(method, max_iter, tol, grad, grad_tol, solver, compiled)
        self.info: ARAPInfo | None = None

    def forward(
        self,
        rest: Tensor,
        target: Tensor,
        faces: Tensor,
        *,
        mask: Tensor | None = None,
        handles: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Deform.

        Args:
            rest: (B, V, 3) or (V, 3) rest positions; differentiable for ``grad="implicit"``.
            target: positions of the shape of `rest`; differentiable at the handles.
            faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1.
            mask: (B, V) bool (or (V,)), True at real vertices.
            handles: (H,) or (B, H) vertex indices padded with -1, instead of random ones.
            generator: source of the random handles for this call, instead of the module's.

        Returns:
            Deformed positions of the shape, dtype and device of `rest`; zeros at padding. How it ended is in the
            attribute ``info``, an :class:`meshkit.deform.ARAPInfo`.

        Raises:
            ValueError: see :func:`meshkit.deform.arap_deform`.
        """
        if self.options.grad == "unroll":
            refuse_partial_gradient(rest=rest)
        deformed, self.info = self._deform(rest, target, faces, mask, handles, generator)
        return deformed

    @uncompiled
    def _deform(
        self,
        rest: Tensor,
        target: Tensor,
        faces: Tensor,
        mask: Tensor | None,
        handles: Tensor | None,
        generator: torch.Generator | None,
    ) -> tuple[Tensor, ARAPInfo]:
        def work(kind: Kind) -> tuple[Tensor, ARAPInfo] | None:
            problem: Any = kind(rest, faces, mask, self.energy, self.degenerate)
            positions = problem.positions(target, "target")
            if handles is None:
                chosen = problem.random_handles(self.fraction, generator or self.generator)
            else:
                chosen = problem.handles(handles)
            return problem.deform(chosen, problem.goal_at(chosen, positions), self.options, None, None, None)

        return dispatch(self.options.batched(rest.device), work)

    def extra_repr(self) -> str:
        """Options in the printed form of the module."""
        choices = ", ".join(f"{name}={value!r}" for name, value in vars(self.options).items())
        return f"{settings(self, 'fraction', 'energy', 'degenerate', 'generator')}, {choices}"
