"""Dual reconstruction: learn pose transfer without ground truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from meshkit._repr import settings
from meshkit.batching import check_verts
from meshkit.consistency._passes import Mesh, check_stop_gradient, generate

__all__ = ["DualOutput", "DualReconstruction"]

StopGradient = Literal["none", "deformed", "released"]


class DualOutput(NamedTuple):
    """What the three passes give.

    Args:
        output: ``(B, N, 3)`` G(A, B): the identity of A in the pose of B.
        deformed: ``(B, N, 3)`` A deformed towards the output, or the output itself without a deformer.
        reconstruction_a: ``(B, n, 3)`` G(deformed, A), at the vertices ``target_a`` holds.
        reconstruction_b: ``(B, m, 3)`` G(B, deformed).
        target_a: ``(B, n, 3)`` what ``reconstruction_a`` should be: A.
        target_b: ``(B, m, 3)`` B.
        mask_a: ``(B, n)`` real vertices of ``target_a``, or ``None``.
        mask_b: ``(B, m)``.
        warped: ``(B, N, 3)`` B's vertices in A's order, or ``None`` if the generator does not tell.
        plan: matching of the main pass, between A and the vertices of ``target_b``; or ``None``.
    """

    output: Tensor
    deformed: Tensor
    reconstruction_a: Tensor
    reconstruction_b: Tensor
    target_a: Tensor
    target_b: Tensor
    mask_a: Tensor | None
    mask_b: Tensor | None
    warped: Tensor | None
    plan: Any


class DualReconstruction(nn.Module):
    r"""Cross consistency and dual reconstruction around any generator.

    .. math:: O = G(A, B), \qquad \hat O = \mathrm{deform}(A, O), \qquad
              A' = G(\hat O, A) \approx A, \qquad B' = G(B, \hat O) \approx B

    All three passes run in one ``forward``, so that DistributedDataParallel wraps once.

    Args:
        generator: callable ``generator(identity, pose)`` that returns vertices ``(B, N, 3)``, or an object with
            ``vertices`` and optionally ``warped`` and ``plan``. Masks and descriptors given to ``forward`` are passed
            on as ``identity_mask``, ``pose_mask``, ``identity_descriptors``, ``pose_descriptors``. If it has
            ``encode(verts, mask=, descriptors=)``, each mesh is encoded once and its features are passed on as
            ``identity_features`` and ``pose_features``: three encodings instead of six.
        deform: callable ``deform(rest, target, faces, *, mask=)``, such as :class:`meshkit.deform.ARAPDeformer`.
        points: match this many random vertices of B in the main pass, and run the two auxiliary passes on as many
            vertices of each mesh. The output, the deformer and features see whole meshes. ``None``: all vertices.
            Needs a generator with ``encode``, and no masks.
        stop_gradient: ``"none"``: all gradients. ``"deformed"``: the auxiliary passes take the mesh they start from as
            a constant, whether it was deformed or not. ``"released"``: only where the deformer ran. Where the gradient
            stops, the deformer runs without recording one.

    Raises:
        ValueError: an unknown policy, ``points`` below 1, or ``points`` without an encoder.

    Reference:
        X-DualNet, "Cross consistency and dual reconstruction" and "ARAP deformer".

    Deviations:
        The released code runs the deformer outside the graph, which is ``stop_gradient="released"``: in the first
        epochs, without deformer, gradients pass through the output, later they do not. The default keeps them
        throughout, as the objective is printed.

    Example:
        >>> generator = lambda identity, pose: identity * 0.5
        >>> result = DualReconstruction(generator)(torch.ones(1, 4, 3), torch.ones(1, 5, 3))
        >>> result.reconstruction_a[0, 0].tolist(), result.reconstruction_b.shape
        ([0.25, 0.25, 0.25], torch.Size([1, 5, 3]))
    """

    def __init__(
        self,
        generator: Callable[..., Any],
        deform: Callable[..., Tensor] | None = None,
        *,
        points: int | None = None,
        stop_gradient: StopGradient = "none",
    ) -> None:
        super().__init__()
        check_stop_gradient(stop_gradient, get_args(StopGradient))
        if points is not None and points < 1:
            raise ValueError(f"points must be at least 1, or None for all vertices, got {points}")
        if points is not None and not hasattr(generator, "encode"):
            raise ValueError("points needs a generator with an encode method: features must come from whole meshes")
        self.generator, self.deform = generator, deform
        self.points, self.stop_gradient = points, stop_gradient

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "points", "stop_gradient")

    def forward(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_faces: Tensor | None = None,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
        identity_descriptors: Tensor | None = None,
        pose_descriptors: Tensor | None = None,
        use_deform: bool = True,
    ) -> DualOutput:
        """Run the three passes on identity meshes A ``(B, N, 3)`` and pose meshes B ``(B, M, 3)``.

        Args:
            identity: A.
            pose: B.
            identity_faces: of A, needed by the deformer.
            identity_mask: ``(B, N)``.
            pose_mask: ``(B, M)``.
            identity_descriptors: ``(B, N, D)``; the generated mesh takes them too, as constants.
            pose_descriptors: ``(B, M, D)``.
            use_deform: leave the deformer out of this step when ``False`` (the paper adds it in the last 50 epochs).

        Raises:
            ValueError: a deformer without faces, ``points`` together with masks, meshes that are not (B, V, 3), or a
                generator that does not return vertices of the identity's shape.
        """
        check_verts(identity, name="identity")
        check_verts(pose, name="pose")
        if self.points is not None and (identity_mask is not None or pose_mask is not None):
            raise ValueError(
                "points works on unpadded batches; meshes of different vertex counts need points=None (--points None)"
            )
        a = Mesh(identity, identity_mask, identity_descriptors).encoded(self.generator)
        b = Mesh(pose, pose_mask, pose_descriptors).encoded(self.generator)
        b = b.subset(self._choose(pose))
        main = generate(self.generator, a, b)
        deformed = main.vertices
        deform = self.deform if use_deform else None
        constant = self.stop_gradient == "deformed" or (self.stop_gradient == "released" and deform is not None)
        if deform is not None:
            if identity_faces is None:
                raise ValueError("the deformer needs identity_faces")
            with torch.set_grad_enabled(torch.is_grad_enabled() and not constant):
                deformed = deform(identity, deformed, identity_faces, mask=identity_mask)
        if constant:
            deformed = deformed.detach()
        generated = a.moved(deformed).encoded(self.generator)
        chosen = self._choose(identity)
        a, generated = a.subset(chosen), generated.subset(chosen)
        return DualOutput(
            output=main.vertices,
            deformed=deformed,
            reconstruction_a=generate(self.generator, generated, a).vertices,
            reconstruction_b=generate(self.generator, b, generated).vertices,
            target_a=a.verts,
            target_b=b.verts,
            mask_a=a.mask,
            mask_b=b.mask,
            warped=getattr(main, "warped", None),
            plan=getattr(main, "plan", None),
        )

    def _choose(self, verts: Tensor) -> Tensor | None:
        """Random vertices of each mesh, ``(B, points)``."""
        if self.points is None or self.points >= verts.shape[1]:
            return None
        return torch.rand(verts.shape[:2], device=verts.device).topk(self.points, dim=1).indices
