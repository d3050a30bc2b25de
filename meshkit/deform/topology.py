"""What the as-rigid-as-possible energies need to know of the connectivity of one mesh."""

from collections import OrderedDict
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from meshkit._checks import check_whole
from meshkit.topology import check_faces

__all__ = ["ENERGIES", "ARAPTopology"]

ENERGIES = ("spokes_and_rims", "spokes", "spokes_unclamped", "elements")
_CACHED: OrderedDict[tuple[str, int, bytes], "ARAPTopology"] = OrderedDict()


class ARAPTopology:
    r"""Cells and sparsity patterns of an energy; depends on the faces alone and serves any rest shape.

    A cell is a set of edges that share one rotation: the three edges of every face around a vertex for
    ``"spokes_and_rims"``, the edges at a vertex for ``"spokes"`` and ``"spokes_unclamped"``, the three edges of one
    face for ``"elements"``. Every edge of a face lies in m cells: 3, 2 and 1. The two spokes differ in the weights:
    ``"spokes"`` replaces a negative cotangent weight of an edge by 0.

    Args:
        faces: (F, 3) integer tensor; rows of -1 are padding and are dropped. Edges of more than two faces are allowed.
        num_verts: number V of vertices.
        energy: one of the four names above.

    Attributes:
        faces: (F, 3) int64 on the CPU, without padding.
        cells: (F, 3), or (F, 1) for elements: the cells that hold edges of a face.
        num_cells: number K of cells.
        multiplicity: m.

    Raises:
        ValueError: an unknown energy, or faces that are no triangle list of `num_verts` vertices.

    Example:
        >>> ARAPTopology(torch.tensor([[0, 1, 2], [0, 2, 3]]), 4, energy="elements").num_cells
        2
    """

    def __init__(self, faces: Tensor, num_verts: int, *, energy: str = "spokes_and_rims") -> None:
        import numpy as np

        check_energy(energy)
        check_whole(num_verts, "num_verts", least=0)
        check_faces(faces, num_verts)
        faces = faces.detach().cpu().long()
        self.faces = faces[faces[:, 0] >= 0]
        self.num_verts, self.energy = num_verts, energy
        f = self.faces.numpy()
        count = len(f)
        per_face = energy == "elements"
        cells = np.arange(count)[:, None] if per_face else f
        self.cells = torch.from_numpy(cells)
        self.num_cells = count if per_face else num_verts
        templates = local_templates(energy, torch.device("cpu"))
        self.multiplicity, self.membership = templates.multiplicity, templates.membership
        self.stiffness, self.moment = templates.stiffness.numpy(), templates.moment.numpy()
        self.square = Pattern(np.repeat(f.T, 3, 0).ravel(), np.tile(f.T, (3, 1)).ravel(), (num_verts, num_verts))
        self.tall = (
            Pattern(np.repeat(cells.T, 3, 0).ravel(), f.T.ravel(), (self.num_cells, num_verts))
            if per_face
            else self.square
        )
        self.interleaved = Interleaved(self.tall)
        ends = np.sort(np.stack([f[:, [1, 2, 0]], f[:, [2, 0, 1]]], -1).reshape(-1, 2), 1)
        self.edge = np.unique(ends[:, 0] * max(num_verts, 1) + ends[:, 1], return_inverse=True)[1].ravel()

    @classmethod
    def cached(cls, faces: Tensor, num_verts: int, *, energy: str = "spokes_and_rims", keep: int = 8) -> "ARAPTopology":
        """Return the topology of equal faces from before, if it is among the last `keep` asked for."""
        from hashlib import blake2b

        content = faces.detach().cpu().long()
        key = (energy, num_verts, blake2b(content.numpy().tobytes(), digest_size=16).digest())
        topology = _CACHED.pop(key, None) or cls(content, num_verts, energy=energy)
        _CACHED[key] = topology
        while len(_CACHED) > keep:
            _CACHED.popitem(last=False)
        return topology

    def kept(self, weights: Any) -> Any:
        """Which half cotangents (F, 3) count: all, or for "spokes" those of edges whose sum is positive."""
        import numpy as np

        if self.energy != "spokes":
            return np.ones(weights.shape, dtype=bool)
        total = np.bincount(self.edge, weights.ravel(), minlength=1)
        return (total > 0)[self.edge].reshape(weights.shape)


@dataclass(frozen=True)
class Templates:
    """What one face adds to the matrices of an energy.

    Attributes:
        multiplicity: m, the number of cells that hold an edge.
        membership: (C, 3), 1 where the cell at corner c (or of the face, C = 1) holds edge k.
        stiffness: (9, 3), from half cotangents of the edges to the entry of corners (a, b), a first.
        moment: (3C, 3), from weighted edge vectors to the entry of cell and corner (c, b), c first.
    """

    multiplicity: int
    membership: Tensor
    stiffness: Tensor
    moment: Tensor


@cache
@torch.inference_mode(False)
def local_templates(energy: str, device: torch.device) -> Templates:
    """Templates of an energy, as float64 tensors; kept, and so fit for training whoever asks first."""
    # Edge k of a face, opposite corner k, runs from corner k + 2 to corner k + 1.
    eye = torch.eye(3, dtype=torch.float64, device="cpu")
    sign = eye.roll(1, 0) - eye.roll(2, 0)
    held = 1 - eye if energy in ("spokes", "spokes_unclamped") else torch.ones_like(eye)
    membership = held[:1] if energy == "elements" else held
    stiffness = (sign[:, None] * sign[None]).reshape(9, 3)
    moment = (membership[:, None] * sign[None]).reshape(-1, 3)
    multiplicity = {"elements": 1, "spokes_and_rims": 3}.get(energy, 2)
    return Templates(multiplicity, membership.to(device), stiffness.to(device), moment.to(device))


def check_energy(energy: str) -> None:
    """Raise ValueError unless the energy is known."""
    if energy not in ENERGIES:
        raise ValueError(f"energy must be one of {', '.join(ENERGIES)}; got {energy!r}")


class Pattern:
    """Sparsity of a matrix that is summed from entries at given rows and columns."""

    def __init__(self, rows: Any, cols: Any, shape: tuple[int, int]) -> None:
        import numpy as np
        from scipy import sparse

        keys = rows * shape[1] + cols
        order = np.argsort(keys, kind="stable").astype(np.int32)
        first = np.flatnonzero(np.diff(keys[order], prepend=-1))
        distinct = keys[order[first]]
        bounds = np.append(first, len(keys)).astype(np.int32)
        self.shape = shape
        self.gather = sparse.csr_array((np.ones(len(keys)), order, bounds), shape=(len(first), len(keys)))
        self.indices = (distinct % max(shape[1], 1)).astype(np.int32)
        counts = np.bincount(distinct // max(shape[1], 1), minlength=shape[0])
        self.indptr = np.append(0, counts.cumsum()).astype(np.int32)

    def matrix(self, entries: Any) -> Any:
        """CSR matrix of the summed entries."""
        from scipy import sparse

        return sparse.csr_array((self.gather @ entries, self.indices, self.indptr), shape=self.shape)


class Interleaved:
    """Three matrices of one pattern with their rows taken in turns, and the transpose of that."""

    def __init__(self, pattern: Pattern) -> None:
        import numpy as np
        from scipy import sparse

        degree = np.diff(pattern.indptr)
        self.pattern, self.shape = pattern, (3 * pattern.shape[0], pattern.shape[1])
        self.indptr = np.append(0, np.repeat(degree, 3).cumsum()).astype(np.int32)
        entry, start = np.arange(len(pattern.indices)), np.repeat(pattern.indptr[:-1], degree)
        self.place = ((3 * start + entry - start)[:, None] + np.repeat(degree, degree)[:, None] * np.arange(3)).ravel()
        self.indices = np.empty(3 * len(entry), dtype=np.int32)
        self.indices[self.place] = np.repeat(pattern.indices, 3)
        numbers = np.arange(len(self.indices), dtype=np.int32)
        transpose = sparse.csr_array((numbers, self.indices, self.indptr), shape=self.shape).T.tocsr()
        self.order, self.t_indices, self.t_indptr = transpose.data, transpose.indices, transpose.indptr

    def matrices(self, entries: Any) -> tuple[Any, Any]:
        """CSR matrices of entries (E, 3): rows 3k + d hold the sums of component d at row k; and the transpose."""
        import numpy as np
        from scipy import sparse

        data = np.empty(len(self.indices))
        data[self.place] = (self.pattern.gather @ entries).ravel()
        return (
            sparse.csr_array((data, self.indices, self.indptr), shape=self.shape),
            sparse.csr_array((data[self.order], self.t_indices, self.t_indptr), shape=self.shape[::-1]),
        )
