"""A batch of meshes taken apart: validation, index bookkeeping, and the way back."""

import torch
from torch import Tensor

from meshkit.deform.rest import ARAPRest
from meshkit.deform.topology import ARAPTopology, check_energy
from meshkit.topology import check_faces

__all__ = ["Problem"]

_CPU = torch.device("cpu")


class Problem:
    """The meshes of a batch one by one, without padding, in float64 on the CPU.

    Attributes:
        shape, dtype, device: of the given positions, (V, 3) or (B, V, 3).
        batch: number of meshes B; 1 for unbatched input.
        real: per mesh, the indices of its real vertices.
        verts: per mesh, the (n, 3) rest positions; differentiable.
        rests: per mesh, the operators of its rest shape.
    """

    def __init__(self, verts: Tensor, faces: Tensor, mask: Tensor | None, energy: str, degenerate: str) -> None:
        check_energy(energy)
        if verts.dim() not in (2, 3) or verts.shape[-1] != 3 or not verts.is_floating_point():
            raise ValueError(
                f"verts must be a floating (V, 3) or (B, V, 3) tensor, got {verts.dtype} {tuple(verts.shape)}"
            )
        self.shape, self.dtype, self.device = verts.shape, verts.dtype, verts.device
        self.batch, self.size = (1 if verts.dim() == 2 else len(verts)), verts.shape[-2]
        self.real = self._real(mask)
        # index of every vertex among the real ones of its mesh, -1 at padding
        self.place = torch.full((self.batch, self.size), -1, dtype=torch.int64, device=_CPU)
        for place, real in zip(self.place, self.real, strict=True):
            place[real] = torch.arange(len(real), device=_CPU)
        self.verts = self.split(verts, "verts")
        self.rests = [
            ARAPRest(ARAPTopology.cached(own, len(rows), energy=energy), rows, degenerate=degenerate)
            for own, rows in zip(self._faces(faces), self.verts, strict=True)
        ]

    def _real(self, mask: Tensor | None) -> list[Tensor]:
        if mask is None:
            return [torch.arange(self.size, device=_CPU)] * self.batch
        if mask.dtype != torch.bool or mask.shape != self.shape[:-1]:
            raise ValueError(
                f"mask must be bool of shape {tuple(self.shape[:-1])}, got {mask.dtype} {tuple(mask.shape)}"
            )
        return [row.nonzero().squeeze(1) for row in mask.cpu().view(self.batch, -1)]

    def _faces(self, faces: Tensor) -> list[Tensor]:
        check_faces(faces, self.size, batched=len(self.shape) == 3)
        if faces.dim() == 3 and len(faces) != self.batch:
            raise ValueError(f"faces {tuple(faces.shape)} and verts {tuple(self.shape)} differ in batch size")
        rows = faces.detach().cpu().long().expand(self.batch, -1, 3)
        own = [place[row[row[:, 0] >= 0]] for place, row in zip(self.place, rows, strict=True)]
        padded = sum(int((f < 0).any(-1).sum()) for f in own)
        if padded:
            raise ValueError(f"{padded} faces use a vertex that mask declares padding")
        return own

    def split(self, positions: Tensor, name: str) -> list[Tensor]:
        """Positions (n, 3) of the real vertices of each mesh; differentiable."""
        if positions.shape != self.shape:
            raise ValueError(f"{name} must have the shape of verts {tuple(self.shape)}, got {tuple(positions.shape)}")
        return self._rows(positions.reshape(self.batch, self.size, 3), name)

    def split_weights(self, weights: Tensor, name: str) -> list[Tensor]:
        """Weights (n,) of the real vertices of each mesh; differentiable."""
        either = {tuple(self.shape[:-1]), (self.size,)}
        if tuple(weights.shape) not in either:
            wanted = " or ".join(str(shape) for shape in sorted(either, key=len))
            raise ValueError(f"{name} must have shape {wanted}, got {tuple(weights.shape)}")
        rows = self._rows(weights.expand(self.shape[:-1]).reshape(self.batch, self.size), name)
        negative = sum(int((row < 0).sum()) for row in rows)
        if negative:
            raise ValueError(f"{negative} {name} are negative; use 0 where there is no target")
        return rows

    def _rows(self, values: Tensor, name: str) -> list[Tensor]:
        values = values.cpu().double()
        rows = [row.index_select(0, real) for row, real in zip(values.unbind(0), self.real, strict=True)]
        if not all(bool(torch.isfinite(row).all()) for row in rows):
            raise ValueError(f"{name} holds NaN or infinity at a real vertex")
        return rows

    def join(self, rows: list[Tensor]) -> Tensor:
        """Inverse of `split`, with zeros at padding."""
        padded = [
            row.new_zeros(self.size, 3).index_copy(0, real, row) for row, real in zip(rows, self.real, strict=True)
        ]
        return torch.stack(padded).view(self.shape).to(self.device, self.dtype)

    def per_mesh(self, values: list[Tensor]) -> Tensor:
        """One value per mesh as (B,), or () for unbatched input."""
        return torch.stack(values) if len(self.shape) == 3 else values[0]

    def handles(self, handles: Tensor, *, needed: bool) -> tuple[list[Tensor], Tensor]:
        """Handles of each mesh as indices of its real vertices, and which of the given (B, H) they are."""
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
        if bare and needed:
            raise ValueError(f"{bare} of {self.batch} meshes have no handle; give each at least one, or soft targets")
        own = [place[row[taken]] for place, row, taken in zip(self.place, handles, used, strict=True)]
        padded = sum(int((h < 0).sum()) for h in own)
        if padded:
            raise ValueError(f"{padded} handles are vertices that mask declares padding")
        return own, used

    def targets(self, handle_pos: Tensor, used: Tensor) -> list[Tensor]:
        """Positions (h, 3) of the used handles of each mesh; differentiable."""
        wanted = (used.shape[1], 3)
        if handle_pos.shape not in (wanted, (*self.shape[:-2], *wanted)):
            either = f"{wanted} or {(self.batch, *wanted)}" if len(self.shape) == 3 else f"{wanted}"
            raise ValueError(f"handle_pos must have shape {either} like handles, got {tuple(handle_pos.shape)}")
        rows = handle_pos.cpu().double().expand(self.batch, *wanted).unbind(0)
        own = [row[taken] for row, taken in zip(rows, used, strict=True)]
        if not all(bool(torch.isfinite(row).all()) for row in own):
            raise ValueError("handle_pos holds NaN or infinity")
        return own
