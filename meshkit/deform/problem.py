"""What there is to deform: the checks of shapes, which need no look at the values."""

from dataclasses import fields

import torch
from torch import Tensor

from meshkit.deform.options import ARAPInfo
from meshkit.topology import check_faces

__all__ = ["Problem"]


class Problem:
    """The meshes of a batch; `MeshByMesh` takes them apart, `WholeBatch` keeps them together.

    Tensors may come with any strides; the rows that are made of them here are contiguous, and so is all that follows.

    Both have the same methods, ``positions``, ``weights``, ``handles``, ``random_handles``, ``goal``, ``goal_at``,
    ``deform`` and ``energies``, each with handles and positions of its own kind.

    Attributes:
        shape, dtype, device: of the given positions, (V, 3) or (B, V, 3).
        batch: number of meshes B; 1 for unbatched input.
        size: number of vertices V of each, padding included.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor | None) -> None:
        if verts.dim() not in (2, 3) or verts.shape[-1] != 3 or not verts.is_floating_point():
            raise ValueError(
                f"verts must be a floating (V, 3) or (B, V, 3) tensor, got {verts.dtype} {tuple(verts.shape)}"
            )
        if not verts.numel():
            raise ValueError(f"verts {tuple(verts.shape)} holds no vertex")
        self.shape, self.dtype, self.device = verts.shape, verts.dtype, verts.device
        self.batched = verts.dim() == 3
        self.batch, self.size = (len(verts) if self.batched else 1), verts.shape[-2]
        if mask is not None and (mask.dtype != torch.bool or mask.shape != self.shape[:-1]):
            raise ValueError(
                f"mask must be bool of shape {tuple(self.shape[:-1])}, got {mask.dtype} {tuple(mask.shape)}"
            )
        check_faces(faces, self.size, batched=self.batched)
        if faces.dim() == 3 and len(faces) != self.batch:
            raise ValueError(f"faces {tuple(faces.shape)} and verts {tuple(self.shape)} differ in batch size")

    def report(self, info: ARAPInfo) -> ARAPInfo:
        """The report (B,) as it is given out, () for one mesh."""
        if self.batched:
            return info
        return ARAPInfo(*(getattr(info, field.name)[0] for field in fields(info)))

    def rows(self, positions: Tensor, name: str) -> Tensor:
        """Positions of the shape of `verts` as (B, V, 3)."""
        if positions.shape != self.shape:
            raise ValueError(f"{name} must have the shape of verts {tuple(self.shape)}, got {tuple(positions.shape)}")
        return positions.contiguous().view(self.batch, self.size, 3)

    def weight_rows(self, weights: Tensor, name: str) -> Tensor:
        """Weights (V,) or of one more dimension as (B, V)."""
        either = {tuple(self.shape[:-1]), (self.size,)}
        if tuple(weights.shape) not in either:
            wanted = " or ".join(str(shape) for shape in sorted(either, key=len))
            raise ValueError(f"{name} must have shape {wanted}, got {tuple(weights.shape)}")
        return weights.expand(self.batch, self.size).contiguous()

    def handle_rows(self, handles: Tensor) -> Tensor:
        """Handles as (B, H)."""
        dims = (1, 2) if self.batched else (1,)
        if handles.is_floating_point() or handles.dtype == torch.bool or handles.dim() not in dims:
            wanted = "(H,) or (B, H)" if len(dims) == 2 else "(H,)"
            raise ValueError(f"handles must be an integer {wanted} tensor, got {handles.dtype} {tuple(handles.shape)}")
        if handles.dim() == 2 and len(handles) != self.batch:
            raise ValueError(f"handles {tuple(handles.shape)} and verts {tuple(self.shape)} differ in batch size")
        return handles.detach().long().expand(self.batch, -1)

    def target_rows(self, handle_pos: Tensor, count: int) -> Tensor:
        """Positions of `count` handles as (B, H, 3)."""
        wanted = (count, 3)
        if handle_pos.shape not in (wanted, (*self.shape[:-2], *wanted)):
            either = f"{wanted} or {(self.batch, *wanted)}" if self.batched else f"{wanted}"
            raise ValueError(f"handle_pos must have shape {either} like handles, got {tuple(handle_pos.shape)}")
        return handle_pos.expand(self.batch, *wanted)
