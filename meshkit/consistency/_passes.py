"""What the wrappers share: meshes with their features, and one pass of a generator."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from meshkit.neighbors import gather_vertices


class Mesh(NamedTuple):
    """A batch of meshes and all a generator may want to know of it."""

    verts: Tensor
    mask: Tensor | None
    descriptors: Tensor | None
    features: Tensor | None = None

    def encoded(self, generator: Any) -> Mesh:
        """With features, if the generator tells them: a mesh that serves in several passes is encoded once."""
        if not hasattr(generator, "encode"):
            return self
        return self._replace(features=generator.encode(self.verts, mask=self.mask, descriptors=self.descriptors))

    def moved(self, verts: Tensor) -> Mesh:
        """The same meshes at other positions, in their dtype; descriptors go along as constants."""
        # A generator of half precision may give float32, which it does not take itself.
        return Mesh(
            verts.to(self.verts.dtype), self.mask, None if self.descriptors is None else self.descriptors.detach()
        )

    def subset(self, index: Tensor | None) -> Mesh:
        """The vertices ``(B, n)``."""
        if index is None or self.features is None:
            return self
        descriptors = None if self.descriptors is None else gather_vertices(self.descriptors, index)
        return Mesh(gather_vertices(self.verts, index), None, descriptors, gather_vertices(self.features, index))


class Vertices(NamedTuple):
    """What a generator is taken to have returned, if that was a bare tensor."""

    vertices: Tensor


def generate(generator: Any, identity: Mesh, pose: Mesh) -> Any:
    """One pass; the result has ``vertices``."""
    arguments = {"identity_mask": identity.mask, "pose_mask": pose.mask}
    arguments |= {"identity_descriptors": identity.descriptors, "pose_descriptors": pose.descriptors}
    if identity.features is not None:
        arguments |= {"identity_features": identity.features, "pose_features": pose.features}
    result = generator(identity.verts, pose.verts, **{k: v for k, v in arguments.items() if v is not None})
    result = Vertices(result) if isinstance(result, Tensor) else result
    shape = getattr(getattr(result, "vertices", None), "shape", None)
    if shape != identity.verts.shape:
        raise ValueError(
            "the generator must return vertices of the identity's shape, as a tensor or as an object with them as "
            f".vertices (GeneratorAdapter reads other results): expected {tuple(identity.verts.shape)}, got "
            f"{shape and tuple(shape)} in {type(result)}"
        )
    return result


def check_stop_gradient(stop_gradient: str, policies: tuple[str, ...]) -> None:
    """Raise ValueError on a policy the wrapper does not know."""
    if stop_gradient not in policies:
        raise ValueError(f"stop_gradient must be one of {policies}, got {stop_gradient!r}")
