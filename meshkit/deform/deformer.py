"""The ARAP deformer of X-DualNet: bend a mesh until a few random vertices meet a target."""

import torch
from torch import Tensor, nn

from meshkit.deform.arap import check_options, solve
from meshkit.deform.problem import Problem

__all__ = ["ARAPDeformer"]


class ARAPDeformer(nn.Module):
    r"""Deform `rest` so that a random fraction of its vertices meets `target`, as rigidly as possible.

    .. math:: \hat M_{output} = \mathrm{ARAP}(M_A, M_{output})

    keeps the shape of the identity mesh :math:`M_A` where the generated mesh :math:`M_{output}` lost it. Handles are
    drawn anew in every call and differ between the meshes of a batch: round(fraction * real vertices) of them, but at
    least one in every connected component, isolated vertices included.

    Args:
        fraction: share of the vertices that are handles, in (0, 1].
        energy: see :func:`meshkit.deform.arap_deform`. The paper's setting is "spokes".
        max_iter: local-global iterations from rest.
        grad: "unroll" lets the gradient reach `target` through the handles; "none" returns a constant.
        generator: source of the random handles; None uses the global CPU generator, so that ``torch.manual_seed``
            repeats a run on any device and differently seeded processes draw different handles.

    Raises:
        ValueError: `fraction` is not in (0, 1], or an unknown `grad` or `max_iter`.

    Reference:
        X-DualNet, section "ARAP deformer" and implementation details: 10 % of the vertices, 50 iterations.

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
        max_iter: int = 50,
        grad: str = "unroll",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if not 0 < fraction <= 1:
            raise ValueError(f"fraction must be in (0, 1], got {fraction}")
        check_options(max_iter, grad)
        self.fraction, self.energy, self.max_iter, self.grad = fraction, energy, max_iter, grad
        self.generator = generator

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
            rest: (B, V, 3) or (V, 3) rest positions. Treated as constants.
            target: positions of the shape of `rest`; differentiable at the handles.
            faces: (F, 3) shared by the batch, or (B, F, 3) padded with -1.
            mask: (B, V) bool (or (V,)), True at real vertices.
            handles: (H,) or (B, H) vertex indices padded with -1, instead of random ones.
            generator: source of the random handles for this call, instead of the module's.

        Returns:
            Deformed positions of the shape, dtype and device of `rest`; zeros at padding.

        Raises:
            ValueError: see :func:`meshkit.deform.arap_deform`.
        """
        problem = Problem(rest, faces, mask, self.energy)
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.grad == "unroll"):
            joined = problem.join(target, "target")
            if handles is None:
                fixed = random_handles(problem, self.fraction, generator or self.generator)
            else:
                fixed, _ = problem.join_handles(handles)
            return solve(problem, fixed, joined[fixed], None, self.max_iter, 0.0)[0]

    def extra_repr(self) -> str:
        """Options in the printed form of the module."""
        return f"fraction={self.fraction}, energy={self.energy!r}, max_iter={self.max_iter}, grad={self.grad!r}"


def random_handles(problem: Problem, fraction: float, generator: torch.Generator | None) -> Tensor:
    """Union indices of random handles: a share of every mesh, after one vertex of every component."""
    components, sample = problem.operators.components, problem.sample
    device = "cpu" if generator is None else generator.device
    score = torch.rand(len(sample), generator=generator, device=device, dtype=torch.float64).cpu()
    best = score.new_zeros(int(components.max()) + 1).scatter_reduce(0, components, score, "amax")
    forced = score == best[components]
    score = score + forced
    # Sort by mesh, then by falling score; a vertex is a handle when its rank in its mesh is below the mesh's quota.
    order = torch.argsort(2.5 * sample - score)
    sizes = torch.bincount(sample, minlength=problem.batch)
    quota = torch.maximum((fraction * sizes).round().long(), torch.bincount(sample, forced.double()).long())
    rank = torch.arange(len(order)) - (sizes.cumsum(0) - sizes)[sample[order]]
    return order[rank < quota[sample[order]]]
