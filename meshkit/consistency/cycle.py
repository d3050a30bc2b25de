"""Cycle and self reconstruction: the unsupervised baseline that dual reconstruction is compared with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

from torch import Tensor, nn

from meshkit._repr import settings
from meshkit.batching import check_verts
from meshkit.consistency._passes import Mesh, check_stop_gradient, generate

__all__ = ["CycleOutput", "CycleReconstruction"]

StopGradient = Literal["none", "generated"]


class CycleOutput(NamedTuple):
    """What the five passes give.

    Args:
        output: ``(B, N, 3)`` G(A, B): the identity of A in the pose of B.
        output_b: ``(B, M, 3)`` G(B, A): the identity of B in the pose of A.
        reconstruction_a: ``(B, N, 3)`` G(G(A, B), G(B, A)), which should be A.
        reconstruction_b: ``(B, M, 3)`` G(G(B, A), G(A, B)), which should be B.
        self_reconstruction: ``(B, N, 3)`` G(A, A), which should be A.
        target_a: ``(B, N, 3)`` A.
        target_b: ``(B, M, 3)`` B.
        mask_a: ``(B, N)`` real vertices of A, or ``None``.
        mask_b: ``(B, M)``.
        warped: ``(B, N, 3)`` B's vertices in A's order, from the first pass, or ``None``.
        plan: matching of the first pass, or ``None``.
    """

    output: Tensor
    output_b: Tensor
    reconstruction_a: Tensor
    reconstruction_b: Tensor
    self_reconstruction: Tensor
    target_a: Tensor
    target_b: Tensor
    mask_a: Tensor | None
    mask_b: Tensor | None
    warped: Tensor | None
    plan: Any


class CycleReconstruction(nn.Module):
    r"""Exchange the poses of two meshes, exchange them back, and transfer a mesh's pose to itself.

    .. math::

        M_{AB} = G(A, B), \quad M_{BA} = G(B, A), \qquad
        A' = G(M_{AB}, M_{BA}) \approx A, \quad B' = G(M_{BA}, M_{AB}) \approx B, \qquad A'' = G(A, A) \approx A

    Three reconstruction losses train it: A', B' and A''. The last one excludes mirrored and flipped poses, which the
    cycle alone cannot tell from right ones. All five passes run in one ``forward``, so that
    DistributedDataParallel wraps once.

    Args:
        generator: as for :class:`DualReconstruction`. With ``encode``, A, B and both generated meshes are encoded once
            each: four encodings instead of ten.
        stop_gradient: ``"none"``, or ``"generated"``: the way back takes both generated meshes as constants.

    Raises:
        ValueError: an unknown policy.

    Reference:
        X-DualNet, appendix "Proposed unsupervised baseline".

    Example:
        >>> import torch
        >>> def generator(identity, pose):  # shape about its mean, at the mean of the other
        ...     return identity - identity.mean(1, keepdim=True) + pose.mean(1, keepdim=True)
        >>> a, b = torch.rand(1, 4, 3), torch.rand(1, 5, 3)
        >>> result = CycleReconstruction(generator)(a, b)
        >>> torch.allclose(result.reconstruction_a, a, atol=1e-6), torch.allclose(result.reconstruction_b, b, atol=1e-6)
        (True, True)
    """

    def __init__(self, generator: Callable[..., Any], *, stop_gradient: StopGradient = "none") -> None:
        super().__init__()
        check_stop_gradient(stop_gradient, get_args(StopGradient))
        self.generator, self.stop_gradient = generator, stop_gradient

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "stop_gradient")

    def forward(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
        identity_descriptors: Tensor | None = None,
        pose_descriptors: Tensor | None = None,
    ) -> CycleOutput:
        """Run the five passes on meshes A ``(B, N, 3)`` and B ``(B, M, 3)``.

        Args:
            identity: A.
            pose: B.
            identity_mask: ``(B, N)``.
            pose_mask: ``(B, M)``.
            identity_descriptors: ``(B, N, D)``; the mesh generated from A takes them too, as constants.
            pose_descriptors: ``(B, M, D)``; the mesh generated from B likewise.

        Raises:
            ValueError: meshes that are not (B, V, 3), or a generator that does not return vertices of the shape of its
                identity.
        """
        check_verts(identity, name="identity")
        check_verts(pose, name="pose")
        a = Mesh(identity, identity_mask, identity_descriptors).encoded(self.generator)
        b = Mesh(pose, pose_mask, pose_descriptors).encoded(self.generator)
        first, second = generate(self.generator, a, b), generate(self.generator, b, a)
        ab, ba = first.vertices, second.vertices
        if self.stop_gradient == "generated":
            ab, ba = ab.detach(), ba.detach()
        exchanged_a, exchanged_b = a.moved(ab).encoded(self.generator), b.moved(ba).encoded(self.generator)
        return CycleOutput(
            output=first.vertices,
            output_b=second.vertices,
            reconstruction_a=generate(self.generator, exchanged_a, exchanged_b).vertices,
            reconstruction_b=generate(self.generator, exchanged_b, exchanged_a).vertices,
            self_reconstruction=generate(self.generator, a, a).vertices,
            target_a=identity,
            target_b=pose,
            mask_a=identity_mask,
            mask_b=pose_mask,
            warped=getattr(first, "warped", None),
            plan=getattr(first, "plan", None),
        )
