"""A batch of meshes joined into one disjoint union: validation, index bookkeeping, and the way back."""

import torch
from torch import Tensor

from meshkit.deform.operators import RestOperators
from meshkit.topology import check_faces

__all__ = ["Problem"]


class Problem:
    """Rest shape of a batch, flattened to the N real vertices of all meshes, in float64 on the CPU.

    Attributes:
        shape: shape of the given positions, (V, 3) or (B, V, 3).
        batch: number of meshes B; 1 for unbatched input.
        real: (N,) indices of the real vertices among the B * V.
        sample: (N,) mesh of every real vertex.
        verts: (N, 3) rest positions.
        operators: the rest operators of the union.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor | None, energy: str) -> None:
        if energy not in ("spokes_and_rims", "spokes"):
            raise ValueError(f'energy must be "spokes_and_rims" or "spokes", got {energy!r}')
        if verts.dim() not in (2, 3) or verts.shape[-1] != 3 or not verts.is_floating_point():
            raise ValueError(
                f"verts must be a floating (V, 3) or (B, V, 3) tensor, got {verts.dtype} {tuple(verts.shape)}"
            )
        self.shape, self.dtype, self.device = verts.shape, verts.dtype, verts.device
        self.batch, self.size = (1 if verts.dim() == 2 else len(verts)), verts.shape[-2]
        self.real = self._real(mask)
        self.sample = self.real // self.size
        # index of every padded-layout vertex in the union, -1 at padding
        self.position = torch.full((self.batch * self.size,), -1, dtype=torch.int64)
        self.position[self.real] = torch.arange(len(self.real))
        self.verts = self.join(verts.detach(), "verts")
        self.operators = RestOperators(self.verts, self._join_faces(faces), energy)

    def _real(self, mask: Tensor | None) -> Tensor:
        if mask is None:
            return torch.arange(self.batch * self.size)
        if mask.dtype != torch.bool or mask.shape != self.shape[:-1]:
            raise ValueError(
                f"mask must be bool of shape {tuple(self.shape[:-1])}, got {mask.dtype} {tuple(mask.shape)}"
            )
        return mask.cpu().flatten().nonzero().squeeze(1)

    def _join_faces(self, faces: Tensor) -> Tensor:
        check_faces(faces, self.size, batched=len(self.shape) == 3)
        if faces.dim() == 3 and len(faces) != self.batch:
            raise ValueError(f"faces {tuple(faces.shape)} and verts {tuple(self.shape)} differ in batch size")
        joined = self._offset(faces.detach().cpu().long().expand(self.batch, -1, 3))
        joined = self.position[joined[joined[..., 0] >= 0]]
        padded = int((joined < 0).any(-1).sum())
        if padded:
            raise ValueError(f"{padded} faces use a vertex that mask declares padding")
        return joined

    def _offset(self, indices: Tensor) -> Tensor:
        """Per-mesh indices to indices of the padded layout; -1 stays -1."""
        offsets = self.size * torch.arange(self.batch).view(-1, *([1] * (indices.dim() - 1)))
        return torch.where(indices >= 0, indices + offsets, -1)

    def join(self, positions: Tensor, name: str) -> Tensor:
        """(N, 3) positions of the real vertices; differentiable."""
        if positions.shape != self.shape:
            raise ValueError(f"{name} must have the shape of verts {tuple(self.shape)}, got {tuple(positions.shape)}")
        joined = positions.reshape(-1, 3).cpu().double().index_select(0, self.real)
        if not torch.isfinite(joined).all():
            raise ValueError(f"{name} holds NaN or infinity at a real vertex")
        return joined

    def split(self, joined: Tensor) -> Tensor:
        """Inverse of `join`, with zeros at padding."""
        flat = joined.new_zeros(self.batch * self.size, 3).index_copy(0, self.real, joined)
        return flat.view(self.shape).to(self.device, self.dtype)

    def join_handles(self, handles: Tensor) -> tuple[Tensor, Tensor]:
        """Union indices (H,) of the handles of all meshes, and which of the (B, H) given ones they are."""
        dims = (1, 2) if len(self.shape) == 3 else (1,)
        if handles.is_floating_point() or handles.dtype == torch.bool or handles.dim() not in dims:
            wanted = "(H,) or (B, H)" if len(dims) == 2 else "(H,)"
            raise ValueError(f"handles must be an integer {wanted} tensor, got {handles.dtype} {tuple(handles.shape)}")
        if handles.dim() == 2 and len(handles) != self.batch:
            raise ValueError(f"handles {tuple(handles.shape)} and verts {tuple(self.shape)} differ in batch size")
        handles = handles.detach().cpu().long().expand(self.batch, -1)
        if handles.numel() and (int(handles.max()) >= self.size or int(handles.min()) < -1):
            raise ValueError(
                f"handles must lie in [0, {self.size}) (or be -1 padding), "
                f"got a range of [{int(handles.min())}, {int(handles.max())}]"
            )
        used = handles >= 0
        bare = int((~used.any(1)).sum())
        if bare:
            raise ValueError(f"{bare} of {self.batch} meshes have no handle; give each at least one")
        fixed = self.position[self._offset(handles)[used]]
        padded = int((fixed < 0).sum())
        if padded:
            raise ValueError(f"{padded} handles are vertices that mask declares padding")
        repeated = len(fixed) - len(fixed.unique())
        if repeated:
            raise ValueError(f"{repeated} handles repeat an earlier one of the same mesh; list each vertex once")
        self._check_anchored(fixed)
        return fixed, used

    def join_targets(self, handle_pos: Tensor, used: Tensor) -> Tensor:
        """Positions (H, 3) of the used handles; differentiable."""
        wanted = (used.shape[1], 3)
        if handle_pos.shape not in (wanted, (*self.shape[:-2], *wanted)):
            either = f"{wanted} or {(self.batch, *wanted)}" if len(self.shape) == 3 else f"{wanted}"
            raise ValueError(f"handle_pos must have shape {either} like handles, got {tuple(handle_pos.shape)}")
        targets = handle_pos.cpu().double().expand(self.batch, *wanted)[used]
        if not torch.isfinite(targets).all():
            raise ValueError("handle_pos holds NaN or infinity")
        return targets

    def _check_anchored(self, fixed: Tensor) -> None:
        sizes = torch.bincount(self.operators.components)
        loose = torch.ones(len(sizes), dtype=torch.bool)
        loose[self.operators.components[fixed]] = False
        isolated = int((loose & (sizes == 1)).sum())
        if isolated:
            raise ValueError(
                f"{isolated} vertices are in no face of positive area and are no handles, so nothing determines them; "
                "remove them, mask them out, or make them handles"
            )
        if loose.any():
            raise ValueError(
                f"{int(loose.sum())} connected components have no handle, so nothing holds them; "
                "give each component at least one handle"
            )

    def per_mesh(self, values: Tensor) -> Tensor:
        """Sum (N,) values over each mesh: (B,), or () for unbatched input."""
        summed = values.new_zeros(self.batch).index_add(0, self.sample, values)
        return summed if len(self.shape) == 3 else summed[0]
