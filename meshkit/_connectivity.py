"""Edges, hinges and faces of a batch of meshes as lists of rows, found once for each tensor of faces."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from meshkit._compile import uncompiled
from meshkit._numerics import full_precision, safe_sqrt
from meshkit.topology import check_faces


@dataclass(frozen=True)
class Connectivity:
    """What losses and metrics know of the faces of a batch, read as rows and lanes.

    Faces shared by the batch: row n is vertex n, and its L = B lanes are the samples, so that an index is looked up
    once for all of them. Faces of each mesh: the batch is one mesh of B N rows, row b N + n is vertex n of sample b,
    and L = 1.

    Args:
        batch: samples B, or ``None`` for faces shared by any number of them.
        num: padded number of vertices N.
        faces: ``(F, 3)`` rows, without padding.
        edges: ``(2, E)`` rows of both ends of every undirected edge, listed once.
        around: ``(E,)`` number of faces that share the edge.
        corners: ``(H,)`` position among the 3 F face corners, ordered by the edge opposite.
        corner_edges: ``(H,)`` that edge.
        hinges: ``(4, Q)`` rows of edges with exactly two faces: both ends, then the corners opposite.
        edge_counts: ``(B,)`` edges of each sample, in whose order they are listed; ``(1,)`` for shared faces.
        face_counts: ``(B,)`` faces likewise.
        hinge_counts: ``(B,)`` hinges likewise.
        incidence: ``(R, E)`` sparse, +1 and -1 at both ends of each edge, as needed in each dtype.
    """

    batch: int | None
    num: int
    faces: Tensor
    edges: Tensor
    around: Tensor
    corners: Tensor
    corner_edges: Tensor
    hinges: Tensor
    edge_counts: Tensor
    face_counts: Tensor
    hinge_counts: Tensor
    incidence: dict[torch.dtype, Tensor] = field(default_factory=dict)

    def lanes(self, x: Tensor) -> Tensor:
        """``(B, N, ...)`` as ``(L, R, ...)``."""
        return x if self.batch is None else x.flatten(0, 1)[None]

    def rows(self, x: Tensor) -> Tensor:
        """``(B, N, ...)`` as ``(R, ..., L)``."""
        return self.lanes(x).movedim(0, -1).contiguous()

    def real(self, mask: Tensor, corners: Tensor) -> Tensor:
        """Whether all k corners ``(k, E)`` are real vertices, ``(E, L)``."""
        rows = self.rows(mask)
        return rows.index_select(0, corners.flatten()).view(*corners.shape, -1).all(0)

    def divergence(self, flow: Tensor) -> Tensor:
        """Sum of what ``flow (E, C, L)`` brings to the first end of every edge and takes from the second."""
        ends = self.edges.flatten()
        out = flow.new_zeros(self.num * (self.batch or 1), *flow.shape[1:])
        if flow.device.type != "cpu" or flow.requires_grad:
            return out.index_add_(0, ends, torch.cat([flow, -flow]))
        if flow.dtype not in self.incidence:
            order, edges = ends.argsort(stable=True), len(flow)
            start = torch.searchsorted(ends[order], torch.arange(len(out) + 1, device=ends.device))
            sign = torch.where(order < edges, 1, -1).to(flow.dtype)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # CSR is called beta
                matrix = torch.sparse_csr_tensor(start, order % edges, sign, (len(out), edges))
            self.incidence[flow.dtype] = matrix
        return (self.incidence[flow.dtype] @ flow.flatten(1)).view_as(out) if len(flow) else out

    def totals(self, terms: Tensor, counts: Tensor) -> Tensor:
        """Sums ``(B,)`` of terms ``(E, L)`` over each sample, of which ``counts (B,)`` are each sample's."""
        if self.batch is None:
            return terms.sum(0)
        sums: Tensor = _RunSums.apply(terms[:, 0], counts)
        return sums

    def counts(self, real: Tensor | None, counts: Tensor, like: Tensor) -> Tensor:
        """Number of real terms in each sample, ``(B,)`` or ``(1,)``; ``real (E, L)``, or None for all."""
        return counts if real is None else self.totals(real.to(like.dtype), counts)


class _RunSums(torch.autograd.Function):
    """Sums of consecutive runs of a vector; ``segment_reduce`` itself has no second derivative."""

    @staticmethod
    def forward(ctx: Any, terms: Tensor, lengths: Tensor) -> Tensor:
        ctx.save_for_backward(lengths)
        sums: Tensor = torch.segment_reduce(terms, "sum", lengths=lengths, unsafe=True)
        return sums

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        (lengths,) = ctx.saved_tensors
        return upstream.repeat_interleave(lengths), None


@uncompiled
def edge_lengths(mesh: Connectivity, verts: Tensor, real: Tensor | None, *, squared: bool = False) -> Tensor:
    """Lengths ``(E, L)`` of the edges of ``(B, N, 3)`` vertices; 0 with gradient 0 where not real or of no length."""
    lengths: Tensor = _EdgeLengths.apply(mesh.rows(verts), mesh, real, squared)
    return lengths


class _EdgeLengths(torch.autograd.Function):
    """``|x_i - x_j|``, squared or not; its gradient through the incidence matrix, faster than by ``index_add``."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, mesh: Connectivity, real: Tensor | None, squared: bool) -> Tensor:
        edge, length = _measure(x, mesh, real, squared)
        ctx.save_for_backward(x, edge, length)
        ctx.mesh, ctx.real, ctx.squared = mesh, real, squared
        return length

    @staticmethod
    @full_precision
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None, None]:
        x, edge, length = ctx.saved_tensors
        if torch.is_grad_enabled():  # for second derivatives the edges must be functions of the vertices
            edge, length = _measure(x, ctx.mesh, ctx.real, ctx.squared)
        scale = 2 * upstream if ctx.squared else upstream / length.masked_fill(length == 0, torch.inf)
        return ctx.mesh.divergence(edge * scale[:, None]), None, None, None


def _measure(x: Tensor, mesh: Connectivity, real: Tensor | None, squared: bool) -> tuple[Tensor, Tensor]:
    edge = x.index_select(0, mesh.edges[0]) - x.index_select(0, mesh.edges[1])
    if real is not None:
        edge = edge.masked_fill(~real[:, None], 0)
    first, second, third = edge.square().unbind(1)  # much faster than a sum over three
    length = first + second + third
    return edge, length if squared else safe_sqrt(length)


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


@uncompiled
def connectivity(verts: Tensor, faces: Tensor) -> Connectivity:
    """Check the faces of a batch, and list its edges.

    Both happen once for a tensor of faces: the result is kept beside the tensor object (by identity, not by value)
    until it is freed, and found anew when the tensor was written to (by its version counter) or meets another padded
    number of vertices. Writing through ``.data`` or a NumPy view escapes the counter. Inference tensors have none:
    nothing is kept for them.

    Args:
        verts: ``(B, N, 3)``.
        faces: ``(F, 3)``, or ``(B, F, 3)`` padded with -1.
    """
    batch, num = verts.shape[:2]
    cached = isinstance(faces, Tensor) and not faces.is_inference()
    if cached and (known := _known.get(faces)) is not None:
        version, connected = known
        same = version == faces._version and connected.num == num and connected.batch in (None, batch)
        if same:
            return connected
    check_batch_faces(verts, faces)
    with torch.inference_mode(False), torch.no_grad():  # else what is kept could not serve a later training step
        connected = _connect(faces.long(), batch if faces.ndim == 3 else None, num)
    if cached:
        _known[faces] = faces._version, connected
    return connected


def check_batch_faces(verts: Tensor, faces: Tensor) -> None:
    """Raise ValueError on faces that do not fit the batch."""
    check_faces(faces, verts.shape[1], batched=True)
    if faces.ndim == 3 and len(faces) != len(verts):
        raise ValueError(
            f"faces {tuple(faces.shape)} must have the batch size of the vertices {tuple(verts.shape)}; pass (F, 3) to "
            "share one face list"
        )


def _connect(faces: Tensor, batch: int | None, num: int) -> Connectivity:
    rows = faces
    if batch is not None:
        rows = (faces + num * torch.arange(batch, device=faces.device)[:, None, None]).flatten(0, 1)
    rows = rows[faces.reshape(-1, 3)[:, 0] >= 0]
    first, second = rows.roll(-1, 1).flatten(), rows.roll(-2, 1).flatten()  # the side opposite each corner
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    proper = (low < high).nonzero()[:, 0]  # a face may repeat a vertex
    key, order = (low * (num * (batch or 1)) + high)[proper].sort()
    corners = proper[order]
    starts = torch.ones_like(key, dtype=torch.bool)
    starts[1:] = key[1:] != key[:-1]
    start = starts.nonzero()[:, 0]
    around = torch.diff(start, append=start.new_full((1,), len(key)))
    edges = torch.stack([low[corners[start]], high[corners[start]]])
    hinge = around == 2
    opposite = rows.flatten()[corners]
    hinges = torch.stack([*edges[:, hinge], opposite[start[hinge]], opposite[start[hinge] + 1]])
    lead = (edges[0], rows[:, 0], hinges[0])
    per_edge, per_face, per_hinge = (torch.bincount(first // num, minlength=batch or 1) for first in lead)
    corner_edges = starts.cumsum(0) - 1
    return Connectivity(batch, num, rows, edges, around, corners, corner_edges, hinges, per_edge, per_face, per_hinge)
