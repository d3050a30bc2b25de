"""The weights that come with meshkit, as networks that take any two meshes."""

from __future__ import annotations

import json
import warnings
from typing import Any

import torch
from torch import Tensor, nn

from meshkit._names import did_you_mean, shipped_weights, weights_folder
from meshkit.batching import bounding_box_center, center, check_mask
from meshkit.descriptors import intrinsic_descriptors
from meshkit.models.generator import PoseTransferGenerator
from meshkit.models.npt import NPT
from meshkit.models.output import GeneratorOutput
from meshkit.models.presets import GeneratorConfig

_SMALLEST, _LARGEST = 0.1, 20.0  # longest sides of meshes that may be in metres
_ANIMALS = {"animals", "smal"}  # whose unit is arbitrary
_USUAL = {"people": (0.5, 2.6), "animals": (0.5, 4.0)}  # the shipped bodies' longest sides are .92-2.55 and .78-2.08

__all__ = ["PretrainedTransfer", "load_pretrained", "pretrained_names"]


class PretrainedTransfer(nn.Module):
    """A generator that centres meshes, computes their descriptors itself, and puts the result where the pose mesh is.

    Meshes must stand in the frame that the weights were trained in: metres, z up, facing -y;
    :func:`meshkit.transfer.transfer_pose` brings others there. Shipped weights warn of a mesh that is longer or shorter
    than such bodies are. Vertices are differentiable. Constants are the
    descriptors, the relative positions in set convolutions and the weights of the rigid moving least squares, so the
    gradient to the vertices is not whole: ``docs/deviations.md``.

    Args:
        generator: :class:`PoseTransferGenerator` or :class:`NPT`.
        config: its configuration, which says whether it takes descriptors.
        card: what is known about the weights; see :attr:`card`.

    Attributes:
        card: the model card's facts: command, seed, data, figures, licence. Empty for weights of one's own.

    Shape:
        ``identity (V, 3)`` or ``(B, V, 3)``, ``pose (W, 3)`` or ``(B, W, 3)``; a single mesh beside a batch serves all
        of it, and is described and encoded once. Masks ``(V,)`` or ``(B, V)``. Faces ``(F, 3)``, or per mesh
        ``(B, F, 3)`` padded with -1. Result ``(V, 3)`` if both are single meshes, else ``(B, V, 3)``.

    Raises:
        ValueError: a mesh whose size cannot be metres (shipped weights), wrong shapes, unequal batches, fewer vertices
            than the network looks at, or no faces where the weights use descriptors.

    Example:
        >>> config = GeneratorConfig(extractor_widths=(8, 16), k=4, widths=(32, 16))
        >>> net = PretrainedTransfer(config.build(), config)
        >>> net(torch.randn(30, 3), torch.randn(5, 40, 3)).shape
        torch.Size([5, 30, 3])
    """

    def __init__(
        self, generator: PoseTransferGenerator | NPT, config: GeneratorConfig, *, card: dict[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.generator, self.config, self.card = generator, config, card or {}

    def forward(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_faces: Tensor | None = None,
        pose_faces: Tensor | None = None,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
    ) -> Tensor:
        """Vertices of the identity mesh in the pose of the pose mesh."""
        return self.output(
            identity,
            pose,
            identity_faces=identity_faces,
            pose_faces=pose_faces,
            identity_mask=identity_mask,
            pose_mask=pose_mask,
        ).vertices

    def output(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_faces: Tensor | None = None,
        pose_faces: Tensor | None = None,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
        identity_descriptors: Tensor | None = None,
        pose_descriptors: Tensor | None = None,
    ) -> GeneratorOutput:
        """As calling the module, with the warped mesh and the matching besides; the plan is always of a batch.

        ``identity_descriptors`` and ``pose_descriptors`` are what :meth:`describe` gives, where it was asked already.
        """
        first = self._side(identity, identity_faces, identity_mask, identity_descriptors, "identity")
        second = self._side(pose, pose_faces, pose_mask, pose_descriptors, "pose")
        single = identity.dim() == pose.dim() == 2
        batch = max(len(first["identity"]), len(second["pose"]))
        inputs = {name: _repeated(value, batch) for name, value in (first | second).items() if value is not None}
        result = self.generator(**inputs)
        where = bounding_box_center(pose if pose.dim() == 3 else pose[None], second["pose_mask"])
        vertices = result.vertices + where
        warped = None if result.warped is None else result.warped + where
        identity_mask = first["identity_mask"]
        if identity_mask is not None:
            vertices = vertices.masked_fill(~identity_mask[..., None], 0.0)
            warped = None if warped is None else warped.masked_fill(~identity_mask[..., None], 0.0)
        if single:
            vertices, warped = vertices[0], None if warped is None else warped[0]
        return GeneratorOutput(vertices, warped, result.plan)

    def describe(self, verts: Tensor, faces: Tensor | None, mask: Tensor | None = None) -> Tensor | None:
        """The descriptors ``(..., V, D)`` that the weights take of a mesh; ``None`` if they take none.

        Raises:
            ValueError: they take some, and there are no faces; or as :func:`meshkit.descriptors.intrinsic_descriptors`.
        """
        if self.config.descriptors == "none":
            return None
        if faces is None:
            raise ValueError("these weights use descriptors of the surface: give identity_faces and pose_faces")
        return intrinsic_descriptors(
            verts, faces, num_signatures=self.config.num_signatures, mask=mask, method="fast"
        ).to(verts.dtype)

    def _side(
        self, verts: Tensor, faces: Tensor | None, mask: Tensor | None, descriptors: Tensor | None, name: str
    ) -> dict[str, Any]:
        """What the generator is told of one of the two meshes, or batches of meshes."""
        if not isinstance(verts, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(verts).__name__}; torch.as_tensor makes one of arrays")
        if verts.dim() not in (2, 3) or verts.shape[-1] != 3:
            raise ValueError(f"{name} must be (V, 3) or (B, V, 3), got {tuple(verts.shape)}")
        verts = (verts if verts.dim() == 3 else verts[None]).to(next(self.generator.parameters()).dtype)
        if isinstance(mask, Tensor) and mask.dim() == 1:
            mask = mask[None]
        check_mask(mask, *verts.shape[:2], name=f"{name}_mask")
        if self.card:
            advice = "meshkit.transfer.transfer_pose brings others there"
            check_extent(verts.detach(), name, mask=mask, advice=advice)
            odd = unusual_extent(verts.detach(), str(self.card.get("data")), mask=mask)
            if odd is not None:
                said = f"{name} is {odd:.3g} long; these weights were trained on bodies of about 1 to 2: {advice}"
                warnings.warn(said, stacklevel=2)
        k = self.config.k if self.config.architecture == "matching" and self.config.extractor == "setconv" else 1
        if verts.shape[1] < k:
            raise ValueError(f"{name} has {verts.shape[1]} vertices; these weights look at {k} neighbours of each")
        if descriptors is None:
            try:
                descriptors = self.describe(verts, faces, mask)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        elif descriptors.dim() == 2:
            descriptors = descriptors[None]
        centred = center(verts, mask)
        sides: dict[str, Any] = {name: centred, f"{name}_mask": mask}
        if isinstance(self.generator, PoseTransferGenerator):
            if name == "identity" and self.generator.symmetry and faces is not None:
                sides["identity_faces"] = faces if faces.dim() == 3 else faces[None]
            sides[f"{name}_descriptors"] = descriptors
            sides[f"{name}_features"] = self.generator.encode(centred, mask=mask, descriptors=descriptors)
        return sides


def extents(verts: Tensor, mask: Tensor | None = None) -> Tensor:
    """Sides (..., 3) of the box along the axes around each mesh (..., V, 3); 0 if it has no vertices."""
    if verts.shape[-2] == 0:
        return verts.new_zeros(*verts.shape[:-2], 3)
    if mask is None:
        return verts.amax(-2) - verts.amin(-2)
    low, high = (torch.where(mask[..., None], verts, end) for end in (torch.inf, -torch.inf))
    return (high.amax(-2) - low.amin(-2)).clamp_min(0)


def check_extent(verts: Tensor, name: str, *, advice: str, mask: Tensor | None = None) -> None:
    """Refuse meshes (..., V, 3) if a longest side cannot be metres; ``advice`` says what can be done with them."""
    sides = extents(verts, mask).amax(-1).flatten().tolist()
    for number, side in enumerate(sides):
        if not _SMALLEST < side < _LARGEST:
            raise ValueError(
                f"{name if len(sides) == 1 else f'{name} {number}'} is {side:.3g} long, but these weights take meshes "
                f"of about 1 to 2 (metres, z up, facing -y): {advice}"
            )


def usual_extents(data: str) -> tuple[float, float]:
    """Between what the longest sides of bodies of this kind of data lie."""
    return _USUAL["animals" if data.partition(":")[0] in _ANIMALS else "people"]


def unusual_extent(verts: Tensor, data: str, mask: Tensor | None = None) -> float | None:
    """The longest side of the first of meshes (..., V, 3) that no body of this kind of data has; None if all may be."""
    low, high = usual_extents(data)
    sides = extents(verts, mask).amax(-1).flatten().tolist()
    return next((side for side in sides if not low <= side <= high), None)


def _repeated(value: Tensor, batch: int) -> Tensor:
    return value.expand(batch, *value.shape[1:]) if len(value) == 1 else value


def pretrained_names() -> list[str]:
    """Names that :func:`load_pretrained` knows.

    Example:
        >>> all(isinstance(name, str) for name in pretrained_names())
        True
    """
    return shipped_weights()


def instead_of(name: str) -> str:
    """What to say after a name that no weights have: the nearest one, if one is near, and all there are."""
    names = pretrained_names()
    meant, there_are = did_you_mean(name, names), f"here are {', '.join(names) or 'none'}"
    return f"{meant} T{there_are}" if meant else f"; t{there_are}"


def read_card(name: str) -> dict[str, Any]:
    """The model card of shipped weights, without the weights.

    Raises:
        ValueError: no weights of that name.
    """
    if name not in pretrained_names():
        raise ValueError(f"no weights are named {name!r}{instead_of(name)}")
    return dict(json.loads((weights_folder() / f"{name}.json").read_text(encoding="utf-8")))


def load_pretrained(name: str, *, device: torch.device | str = "cpu") -> PretrainedTransfer:
    """Load weights that come with meshkit, in evaluation mode.

    Most parameters are stored with 16 bits; all are used as float32. ``net.card`` holds how they were trained, their
    figures on unseen pairs, and their licence; the weights for animals are CC BY-SA 3.0, as the art they were trained
    on.

    Args:
        name: one of :func:`pretrained_names`, such as ``"xdualnet-humans"``.
        device: where to put them.

    Raises:
        ValueError: no weights of that name.

    Example:
        >>> from meshkit.data import load_humans
        >>> body = load_humans()
        >>> identity, pose = body(torch.tensor([3, 50]), torch.tensor([10, 500]))
        >>> if "xdualnet-humans" in pretrained_names():
        ...     net = load_pretrained("xdualnet-humans")
        ...     posed = net(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
    """
    from safetensors.torch import load

    card = read_card(name)
    folder = weights_folder()
    config = GeneratorConfig.from_json(json.dumps(card["model"]))
    state = load((folder / f"{name}.safetensors").read_bytes())
    with torch.device("cpu"):  # read there whatever the default device, then moved
        generator = config.build()
    generator.load_state_dict({key: v.float() if v.is_floating_point() else v for key, v in state.items()})
    return PretrainedTransfer(generator, config, card=card).to(device).eval()
