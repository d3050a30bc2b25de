"""The inner, large part of a set convolution: two layers on all (vertex, neighbour) rows, and their maximum.

One operator with a hand-written backward. It works through blocks of vertices that fit the cache, and it is opaque to
torch.compile, which would otherwise unroll the loop over the blocks. On the R = N k rows of a sample:

    h_1 = leaky_relu(u_j - v_i)
    z_2 = W_2 h_1,   h_2 = leaky_relu(a z_2 + b)    a, b: instance norm over the R rows
    z_3 = W_3 h_2    ->  max over the k neighbours; mean and variance over the R rows

A third norm and activation that increase with z_3 commute with the maximum: the caller applies them to N rows.
"""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import leaky_relu

from meshkit._numerics import launch_bound

__all__ = ["EPS", "edge_mlp"]

EPS = 1e-5  # of the instance norms
_CPU_BLOCK = 1 << 18  # elements of a block of rows: 1 MiB in float32 stays in the cache
_OTHER_BLOCK = 1 << 25  # elsewhere a kernel must be worth its launch


def edge_mlp(
    u: Tensor,
    v: Tensor,
    w2: Tensor,
    scale2: Tensor,
    shift2: Tensor,
    w3: Tensor,
    neighbors: Tensor,
    mask: Tensor | None,
    *,
    slope: float,
    recompute: bool,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor, Tensor]:
    """The maximum ``(B, N, C)`` of z_3, and its mean and variance ``(B, C)``.

    Args:
        u: ``(B, N, C)``, read at the neighbours; in the dtype of the statistics.
        v: ``(B, N, C)``, read at the vertices.
        w2: ``(C, C)``, as ``w3``; ``scale2`` and ``shift2``, ``(C,)``, are those of the norm between them.
        scale2: see ``w2``.
        shift2: see ``w2``.
        w3: see ``w2``.
        neighbors: ``(B, N, k)`` int64.
        mask: ``(B, N)`` or None. The maximum is 0 at padded vertices, and so is all of a sample without real ones.
        slope: of the LeakyReLU.
        recompute: hold no tensor of R rows at any time; else z_2 is kept for the backward.
        dtype: of the R rows.
    """
    inputs = (u, v, w2, scale2, shift2, w3)
    keep = not recompute and torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    best, mean, variance, _, _ = _EdgeMLP.apply(*inputs, neighbors, mask, slope, recompute, keep, dtype)
    return best, mean, variance


def _run_forward(*inputs: Any) -> tuple[Tensor, ...]:
    u, v, w2, scale2, shift2, w3, neighbors, mask, slope, recompute, keep, dtype = inputs
    batch, num, channels = u.shape
    best, state = torch.zeros_like(u), u.new_zeros(batch, 4, channels)
    groups = list(_groups(neighbors, mask, channels))
    room = batch if keep else 0 if recompute else max((len(state[b]) for b, _, _ in groups), default=0)
    kept = u.new_empty(room, num * neighbors.shape[2], channels, dtype=dtype)
    with torch.autocast(u.device.type, enabled=False):
        for b, real, nearest in groups:
            rows = _Rows(u[b, real], v[b, real], w2, w3, nearest, slope, dtype)
            z2 = None if recompute else kept[b if keep else slice(0, rows.groups), : rows.size].flatten(0, 1)
            best[b, real], *vectors = _forward(rows, scale2, shift2, z2)
            state[b] = torch.cat(vectors, 1)
    return best, state[:, 0].clone(), state[:, 1].clone(), state, kept if keep else kept.new_empty(0)


def _run_backward(*inputs: Any) -> tuple[Tensor, ...]:
    *grads, u, v, w2, scale2, shift2, w3, neighbors, mask, state, kept, slope = inputs
    grad_u, grad_v = torch.zeros_like(u), torch.zeros_like(v)
    shared = [torch.zeros_like(t, dtype=u.dtype) for t in (w2, scale2, shift2, w3)]
    with torch.autocast(u.device.type, enabled=False):
        for b, real, nearest in _groups(neighbors, mask, u.shape[2]):
            rows = _Rows(u[b, real], v[b, real], w2, w3, nearest, slope, kept.dtype)
            z2 = kept[b, : rows.size].flatten(0, 1) if kept.numel() else None
            grad_best, grad_mean, grad_variance = grads[0][b, real], grads[1][b, None], grads[2][b, None]
            grad_u[b, real], grad_v[b, real], *rest = _backward(
                rows, scale2, shift2, state[b], z2, grad_best, grad_mean, grad_variance
            )
            for total, gradient in zip(shared, rest, strict=True):
                total += gradient
    return grad_u, grad_v, *(total.to(t) for total, t in zip(shared, (w2, scale2, shift2, w3), strict=True))


def _like_forward(*inputs: Any) -> tuple[Tensor, ...]:
    u, *_, neighbors, _, _, _, keep, dtype = inputs
    batch, num, channels = u.shape
    kept = (batch, num * neighbors.shape[2], channels) if keep else (0,)
    moment = u.new_empty(batch, channels)
    return torch.empty_like(u), moment, moment.clone(), u.new_empty(batch, 4, channels), u.new_empty(kept, dtype=dtype)


def _like_backward(*inputs: Any) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(t) for t in inputs[3:9])


_TENSORS = "Tensor u, Tensor v, Tensor w2, Tensor scale2, Tensor shift2, Tensor w3, Tensor neighbors, Tensor? mask, "
_OPERATORS: dict[str, tuple[str, Callable[..., Any], Callable[..., Any]]] = {
    "meshkit::edge_mlp": (
        f"({_TENSORS} float slope, bool recompute, bool keep, ScalarType dtype) -> ({', '.join(['Tensor'] * 5)})",
        _run_forward,
        _like_forward,
    ),
    "meshkit::edge_mlp_backward": (
        f"(Tensor grad_best, Tensor grad_mean, Tensor grad_variance, {_TENSORS} Tensor state, Tensor kept, "
        f"float slope) -> ({', '.join(['Tensor'] * 6)})",
        _run_backward,
        _like_backward,
    ),
}
# Not torch.library.custom_op: its first call imports the compiler, which takes seconds.
for _name, (_schema, _function, _like) in _OPERATORS.items():
    torch.library.define(_name, _schema)
    torch.library.impl(_name, "default", _function)
    torch.library.register_fake(_name, _like)


class _EdgeMLP(torch.autograd.Function):
    """The two operators as one differentiable function; torch.func knows it, too."""

    @staticmethod
    def forward(*inputs: Any) -> Any:
        return torch.ops.meshkit.edge_mlp(*inputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        *tensors, slope, _, _, _ = inputs
        *_, state, kept = output
        ctx.mark_non_differentiable(state, kept)
        ctx.set_materialize_grads(False)  # zeros for the kept rows would cost as much as a pass
        ctx.save_for_backward(*tensors, state, kept)
        ctx.slope = slope

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        u = ctx.saved_tensors[0]
        given = [
            torch.zeros_like(like) if grad is None else grad
            for grad, like in zip(grads[:3], (u, u[:, 0], u[:, 0]), strict=True)
        ]
        results = torch.ops.meshkit.edge_mlp_backward(*given, *ctx.saved_tensors, ctx.slope)
        return *results, None, None, None, None, None, None


def _groups(neighbors: Tensor, mask: Tensor | None, channels: int) -> Iterator[tuple[slice, Tensor | slice, Tensor]]:
    """Samples to go through together, their real vertices, and the neighbours ``(G, n, k)`` numbered among these.

    Together where a launch costs more than a pass over the rows: off the CPU, as long as they are few. With a mask the
    samples differ in size, and each is a group.
    """
    batch = len(neighbors)
    together = launch_bound(neighbors) and mask is None and neighbors.numel() * channels <= _OTHER_BLOCK
    if together and batch:
        yield slice(None), slice(None), neighbors
        return
    for b in range(batch):
        one = slice(b, b + 1)
        if mask is None:
            yield one, slice(None), neighbors[one]
        else:
            real = mask[b].nonzero()[:, 0]
            if len(real):  # no rows have no mean
                yield one, real, (mask[b].cumsum(0) - 1)[neighbors[b, real]][None]


class _Rows:
    """The rows of a group of samples, made a block of vertices at a time; as matrices ``(G n k, C)``."""

    def __init__(
        self, u: Tensor, v: Tensor, w2: Tensor, w3: Tensor, nearest: Tensor, slope: float, dtype: torch.dtype
    ) -> None:
        self.u, self.v, self.nearest, self.slope = u, v, nearest, slope
        self.w2, self.w3 = w2.to(dtype), w3.to(dtype)
        (self.groups, self.num, self.k), self.channels = nearest.shape, u.shape[2]
        self.size = self.num * self.k  # rows of one sample
        if self.groups > 1:  # number the vertices through
            first = self.num * torch.arange(self.groups, device=nearest.device)
            self.nearest = nearest + first[:, None, None]

    def blocks(self) -> Iterator[tuple[slice, slice]]:
        """Slices of the vertices of each sample, and of the group's rows."""
        elements = _CPU_BLOCK if self.u.device.type == "cpu" else _OTHER_BLOCK
        step = max(1, elements // (self.k * self.channels)) if self.groups == 1 else max(1, self.num)
        for start in range(0, self.num, step):
            stop = min(start + step, self.num)
            yield slice(start, stop), slice(start * self.k, stop * self.k if self.groups == 1 else None)

    def per_sample(self, rows: Tensor) -> Tensor:
        """``(G, n k, C)``."""
        return rows.view(self.groups, -1, self.channels)

    def per_vertex(self, rows: Tensor) -> Tensor:
        """``(G, n, k, C)``."""
        return rows.view(self.groups, -1, self.k, self.channels)

    def neighbors(self, vertices: slice) -> Tensor:
        """The vertex of each row."""
        return self.nearest[:, vertices].flatten()

    def first(self, vertices: slice) -> Tensor:
        """h_1."""
        h = self.u.flatten(0, 1).index_select(0, self.neighbors(vertices))
        self.per_vertex(h).sub_(self.v[:, vertices, None])
        return leaky_relu(h, self.slope, inplace=True).to(self.w2)

    def second(self, z2: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
        """h_2."""
        normed = torch.addcmul(shift.to(z2), self.per_sample(z2), scale.to(z2))
        return leaky_relu(normed, self.slope, inplace=True).flatten(0, 1)

    def through(self, gradient: Tensor, h: Tensor) -> Tensor:
        """The gradient before the activation whose result is h, in place."""
        return torch.ops.aten.leaky_relu_backward.grad_input(gradient, h, self.slope, True, grad_input=gradient)


class _Moments:
    """Mean and variance ``(G, 1, C)`` of rows that come in blocks ``(G, R, C)``.

    Each block about its own mean, so that no large squares cancel.
    """

    def __init__(self, dtype: torch.dtype) -> None:
        self.size, self.dtype = 0, dtype

    def add(self, rows: Tensor) -> None:
        mean, size, more = rows.mean(1, keepdim=True, dtype=self.dtype), self.size, rows.shape[1]
        squares = (rows - mean).square_().sum(1, keepdim=True)
        self.size += more
        if not size:
            self.mean, self.squares = mean, squares
            return
        # In place: small tensors that outlive their block would fragment the memory of the large ones.
        difference = mean - self.mean
        self.mean += difference * (more / self.size)
        self.squares += squares + difference.square() * (size * more / self.size)

    def variance(self) -> Tensor:
        return self.squares / self.size


def _forward(rows: _Rows, scale2: Tensor, shift2: Tensor, kept: Tensor | None) -> tuple[Tensor, ...]:
    """The maximum ``(G, n, C)``, mean and variance ``(G, 1, C)`` of z_3, mean and variance of z_2.

    Fills ``kept`` with z_2.
    """
    second, third, best = _Moments(rows.u.dtype), _Moments(rows.u.dtype), torch.empty_like(rows.u)
    for vertices, block in rows.blocks():
        z2 = torch.mm(rows.first(vertices), rows.w2.mT, out=None if kept is None else kept[block])
        second.add(rows.per_sample(z2))
    scale, shift = _affine(scale2, shift2, second.mean, second.variance())
    for vertices, block in rows.blocks():
        z2 = rows.first(vertices) @ rows.w2.mT if kept is None else kept[block]
        z3 = rows.second(z2, scale, shift) @ rows.w3.mT
        third.add(rows.per_sample(z3))
        best[:, vertices] = rows.per_vertex(z3).amax(2)
    return best, third.mean, third.variance(), second.mean, second.variance()


def _backward(
    rows: _Rows,
    scale2: Tensor,
    shift2: Tensor,
    state: Tensor,
    kept: Tensor | None,
    grad_best: Tensor,
    grad_mean: Tensor,
    grad_variance: Tensor,
) -> tuple[Tensor, ...]:
    """Gradients with respect to u, v, w2, scale2, shift2, w3; ``state`` is what the forward pass found."""
    mean3, _, mean2, variance2 = state.split(1, 1)
    scale, shift = _affine(scale2, shift2, mean2, variance2)
    # dL/dz_3 is slope3 z_3 + constant3, and grad_best more at the maximum.
    slope3 = 2 * grad_variance / rows.size
    constant3 = grad_mean / rows.size - slope3 * mean3
    slope3, constant3, grad_best = (t.to(rows.w2)[:, :, None] for t in (slope3, constant3, grad_best))

    def upper(vertices: slice, z2: Tensor, out: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """h_2, dL/dz_3 and dL/d(a z_2 + b) of a block."""
        h2 = rows.second(z2, scale, shift)
        z3 = rows.per_vertex(h2 @ rows.w3.mT)
        below = (z3 - z3.amax(2, keepdim=True)).sign_()  # 0 at the maximum, else -1
        share = grad_best[:, vertices] / (below.sum(2, keepdim=True) + rows.k)  # equal maxima share the gradient
        grad3 = torch.addcmul(constant3 + share, z3, slope3).addcmul_(below, share).flatten(0, 2)
        return h2, grad3, rows.through(torch.mm(grad3, rows.w3, out=out), h2)

    stored = None if kept is None else torch.empty_like(kept)
    grad_w3 = rows.u.new_zeros(rows.channels, rows.channels)
    total, against = torch.zeros_like(mean2), torch.zeros_like(mean2)
    for vertices, block in rows.blocks():
        z2 = rows.first(vertices) @ rows.w2.mT if kept is None else kept[block]
        h2, grad3, grad2 = upper(vertices, z2, None if stored is None else stored[block])
        grad_w3 += grad3.mT @ h2
        total += rows.per_sample(grad2).sum(1, keepdim=True, dtype=total.dtype)
        against += rows.per_sample(grad2 * z2).sum(1, keepdim=True, dtype=total.dtype)

    inverse = (variance2 + EPS).rsqrt()
    grad_scale = inverse * (against - mean2 * total)
    # dL/dz_2 is scale grad2 + slope2 z_2 + constant2.
    slope2 = -scale * inverse * grad_scale / rows.size
    constant2 = -scale * total / rows.size - slope2 * mean2
    scale, slope2, constant2 = (t.to(rows.w2) for t in (scale, slope2, constant2))
    grad_w2, grad_u, grad_v = torch.zeros_like(grad_w3), torch.zeros_like(rows.u), torch.empty_like(rows.v)
    for vertices, block in rows.blocks():
        h1 = rows.first(vertices)
        z2 = h1 @ rows.w2.mT if kept is None else kept[block]
        grad2 = upper(vertices, z2)[2] if stored is None else stored[block]
        grad2 = torch.addcmul(constant2, rows.per_sample(z2), slope2).addcmul_(rows.per_sample(grad2), scale)
        grad2 = grad2.flatten(0, 1)
        grad_w2 += grad2.mT @ h1
        grad1 = rows.through(grad2 @ rows.w2, h1).to(grad_u)
        grad_u.flatten(0, 1).index_add_(0, rows.neighbors(vertices), grad1)
        grad_v[:, vertices] = rows.per_vertex(grad1).sum(2)
    return grad_u, grad_v.neg_(), grad_w2, grad_scale.sum((0, 1)), total.sum((0, 1)), grad_w3


def _affine(scale: Tensor, shift: Tensor, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Instance norm as one product and one sum."""
    scale = scale * (variance + EPS).rsqrt()
    return scale, shift - scale * mean
