"""Generators with other arguments or results, made to fit the wrappers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from torch import Tensor, nn

from meshkit._repr import settings

__all__ = ["AdaptedOutput", "GeneratorAdapter"]

KEYWORDS = ("identity", "pose", "identity_mask", "pose_mask", "identity_descriptors", "pose_descriptors")
Selector = str | int | Callable[[Any], Any]


class AdaptedOutput(NamedTuple):
    """What the wrappers read: ``vertices (B, N, 3)``, and ``warped`` and ``plan`` or ``None``."""

    vertices: Tensor
    warped: Tensor | None
    plan: Any


class GeneratorAdapter(nn.Module):
    """Call any pose-transfer model as the wrappers call a generator.

    Features that a wrapped model encodes are not shared between passes; give the model an ``encode`` of its own, see
    :class:`DualReconstruction`, if that matters.

    Args:
        generator: the model, any callable.
        keywords: what the model calls its inputs: a map from ``identity``, ``pose``, ``identity_mask``, ``pose_mask``,
            ``identity_descriptors``, ``pose_descriptors`` to its own keywords. Meshes are passed by position, identity
            first, unless named here; masks and descriptors are passed only if named here.
        vertices: where the vertices are in the model's result: a key of a dictionary, an index into a tuple, the name
            of an attribute, or a function of the result. ``None``: the result is the vertices.
        warped: likewise for the warped pose mesh; ``None`` if the model has none.
        plan: likewise for the matching.
        channels_first: the model takes and returns meshes as ``(B, 3, N)``; of the results, ``vertices`` and
            ``warped`` are turned.

    Raises:
        ValueError: an unknown key of ``keywords``.

    Example:
        >>> import torch
        >>> def model(source, template, valid=None):  # another order, other names, two results
        ...     return {"mesh": template + source.mean(1, keepdim=True), "loss": 0.0}
        >>> names = {"identity": "template", "pose": "source", "pose_mask": "valid"}
        >>> generator = GeneratorAdapter(model, keywords=names, vertices="mesh")
        >>> generator(torch.zeros(1, 4, 3), torch.ones(1, 5, 3)).vertices[0, 0].tolist()
        [1.0, 1.0, 1.0]
    """

    def __init__(
        self,
        generator: Callable[..., Any],
        *,
        keywords: Mapping[str, str] | None = None,
        vertices: Selector | None = None,
        warped: Selector | None = None,
        plan: Selector | None = None,
        channels_first: bool = False,
    ) -> None:
        super().__init__()
        self.keywords = dict(keywords or {})
        if unknown := sorted(set(self.keywords) - set(KEYWORDS)):
            raise ValueError(f"keywords may name {KEYWORDS}, got {unknown}")
        self.generator = generator
        self.vertices, self.warped, self.plan = vertices, warped, plan
        self.channels_first = channels_first

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "keywords", "vertices", "warped", "plan", "channels_first")

    def forward(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
        identity_descriptors: Tensor | None = None,
        pose_descriptors: Tensor | None = None,
    ) -> AdaptedOutput:
        """Call the model on identity ``(B, N, 3)`` and pose ``(B, M, 3)`` meshes."""
        given = (self._turned(identity), self._turned(pose), identity_mask, pose_mask)
        inputs = dict(zip(KEYWORDS, (*given, identity_descriptors, pose_descriptors), strict=True))
        positional = [inputs[name] for name in ("identity", "pose") if name not in self.keywords]
        named = {self.keywords[name]: value for name, value in inputs.items() if name in self.keywords}
        result = self.generator(*positional, **{name: value for name, value in named.items() if value is not None})
        vertices = result if self.vertices is None else _select(result, self.vertices)
        warped, plan = (None if where is None else _select(result, where) for where in (self.warped, self.plan))
        return AdaptedOutput(self._turned(vertices), None if warped is None else self._turned(warped), plan)

    def _turned(self, mesh: Tensor) -> Tensor:
        return mesh.mT if self.channels_first else mesh


def _select(result: Any, where: Selector) -> Any:
    if callable(where):
        return where(result)
    if isinstance(where, str) and not isinstance(result, Mapping):
        return getattr(result, where)
    return result[where]
