"""Self reconstruction: a mesh given its own pose should come back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor, nn

from meshkit.batching import check_verts
from meshkit.consistency._passes import Mesh, generate

__all__ = ["SelfOutput", "SelfReconstruction"]


class SelfOutput(NamedTuple):
    """What the pass gives.

    Args:
        reconstruction: ``(B, N, 3)`` G(A, A).
        target: ``(B, N, 3)`` A, which it should be.
        mask: ``(B, N)`` real vertices, or ``None``.
        warped: ``(B, N, 3)`` A's vertices as the generator redistributes them, or ``None``.
        plan: matching of A with itself, or ``None``. The true one is known: the identity.
    """

    reconstruction: Tensor
    target: Tensor
    mask: Tensor | None
    warped: Tensor | None
    plan: Any


class SelfReconstruction(nn.Module):
    r"""Transfer a mesh's pose to itself, :math:`A'' = G(A, A) \approx A`.

    Fixes the orientation of a cycle, see :class:`CycleReconstruction`, and serves to warm a generator up.

    Args:
        generator: as for :class:`DualReconstruction`. With ``encode``, the mesh is encoded once.

    Reference:
        X-DualNet, appendix "Proposed unsupervised baseline".

    Example:
        >>> import torch
        >>> mesh = torch.rand(1, 4, 3)
        >>> result = SelfReconstruction(lambda identity, pose: (identity + pose) / 2)(mesh)
        >>> torch.equal(result.reconstruction, result.target)
        True
    """

    def __init__(self, generator: Callable[..., Any]) -> None:
        super().__init__()
        self.generator = generator

    def forward(self, verts: Tensor, *, mask: Tensor | None = None, descriptors: Tensor | None = None) -> SelfOutput:
        """Run the pass on meshes A ``(B, N, 3)`` with mask ``(B, N)`` and descriptors ``(B, N, D)``.

        Raises:
            ValueError: meshes that are not (B, V, 3), or a generator that does not return vertices of that shape.
        """
        check_verts(verts)
        mesh = Mesh(verts, mask, descriptors).encoded(self.generator)
        result = generate(self.generator, mesh, mesh)
        warped, plan = getattr(result, "warped", None), getattr(result, "plan", None)
        return SelfOutput(result.vertices, verts, mask, warped, plan)
