"""Scale, shift, activation and linear map in one step: what every conditional norm evaluates to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, linear

from meshkit._checks import check_features
from meshkit.norm._tiles import fill, tile_buffer, tiles, traced

__all__ = ["Modulation", "modulate"]


class Modulation(NamedTuple):
    r"""Scale and shift of a conditional norm, as affine maps of per-vertex features.

    .. math:: y = s\,(x - \mu) + t, \qquad s = f M_s + m_s, \qquad t = f M_t + m_t

    Args:
        mean: :math:`\mu` ``(B, 1, C)``, in the precision the statistics were taken in.
        scale_bias: :math:`m_s` ``(B, 1, C)`` or broadcast to it: one per sample and channel, the same at all vertices.
            What differs from vertex to vertex goes through ``features``.
        shift_bias: :math:`m_t` ``(B, 1, C)``, likewise.
        features: f ``(B, N, D)``, or None where scale and shift are the same at all vertices.
        scale_weight: :math:`M_s` ``(B, D, C)``, or None beside ``features=None``.
        shift_weight: :math:`M_t` ``(B, D, C)``, or None beside ``features=None``.
    """

    mean: Tensor
    scale_bias: Tensor
    shift_bias: Tensor
    features: Tensor | None = None
    scale_weight: Tensor | None = None
    shift_weight: Tensor | None = None


def modulate(
    x: Tensor,
    modulation: Modulation,
    *,
    slope: float | None = None,
    weight: Tensor | None = None,
    bias: Tensor | None = None,
) -> Tensor:
    r"""Scale, shift, activate and map features.

    .. math:: z = W\,\phi(s\,(x - \mu) + t) + b

    with :math:`\phi` a LeakyReLU. Runs in tiles of vertices: neither scale nor shift nor the activated features are
    ever held for all vertices, and the backward pass computes them again from ``x``.

    Args:
        x: ``(B, N, C)``.
        modulation: gives s and t.
        slope: of the LeakyReLU, not negative; None for no activation.
        weight: W ``(O, C)``; None for no linear map.
        bias: b ``(O,)``, or None; only beside ``weight``.

    Returns:
        ``(B, N, O)``; without ``weight`` ``(B, N, C)``. Under autocast the products run in its dtype, which the result
        of a linear map then has; otherwise the result has the dtype of ``x``.

    Raises:
        ValueError: a bias without a weight, a negative slope, ``x`` of another shape, or a modulation that does not
            fit ``x``.
        TypeError: ``x`` or a part of the modulation is no tensor.

    Example:
        >>> x = torch.tensor([[[1.0], [3.0]]])
        >>> two, five = torch.full((1, 1, 1), 2.0), torch.full((1, 1, 1), 5.0)
        >>> modulate(x, Modulation(two, scale_bias=five, shift_bias=two / 2), slope=0.5)
        tensor([[[-2.],
                 [ 6.]]])
    """
    if bias is not None and weight is None:
        raise ValueError("bias needs a weight: fold it into the shift instead")
    if slope is not None and slope < 0:
        raise ValueError(f"slope must not be negative, got {slope}")
    check_features(x)
    check_modulation(x, modulation)
    device = x.device.type
    autocast = torch.is_autocast_enabled(device)
    dtype = torch.get_autocast_dtype(device) if autocast and x.dtype != torch.float64 else x.dtype
    *vectors, features, scale_weight, shift_weight = modulation
    mean, scale_bias, shift_bias = (t.expand(len(x), 1, x.shape[2]) for t in vectors)
    factors = (features, scale_weight, shift_weight, weight, bias)
    cast = (None if tensor is None else tensor.to(dtype) for tensor in factors)
    inputs: tuple[Any, ...] = (x, mean, scale_bias, shift_bias, *cast, slope)
    with torch.autocast(device, enabled=False):
        return _formula(*inputs) if traced() else _Modulate.apply(*inputs)


def check_modulation(x: Tensor, modulation: Modulation) -> None:
    """Name what does not fit ``x (B, N, C)``; shapes alone are looked at, so nothing waits for a device."""
    if not isinstance(modulation, Modulation):
        raise ValueError(f"a norm's modulation must return a Modulation, got {type(modulation).__name__}")
    batch, rows, channels = x.shape
    for name in ("mean", "scale_bias", "shift_bias"):
        value = getattr(modulation, name)
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} of the modulation must be a tensor, got {type(value).__name__}")
        shape = value.shape
        wanted = (batch, 1, channels)
        if shape == wanted:  # nearly always, and every norm of every step comes by here
            continue
        if len(shape) > 3 or any(n not in (1, m) for n, m in zip(shape[::-1], wanted[::-1], strict=False)):
            hint = "; what differs from vertex to vertex goes through features" if shape[-2:-1] == (rows,) else ""
            raise ValueError(
                f"{name} of the modulation of x {tuple(x.shape)} must be {wanted} or broadcast to it, got "
                f"{tuple(shape)}{hint}"
            )
    factors = {name: getattr(modulation, name) for name in ("features", "scale_weight", "shift_weight")}
    missing = [name for name, value in factors.items() if value is None]
    if len(missing) == 3:
        return
    if missing:
        raise ValueError(f"features, scale_weight and shift_weight come together: {' and '.join(missing)} left out")
    width = factors["features"].shape[-1:]
    for name, value in factors.items():
        wanted = (batch, rows, *width) if name == "features" else (batch, *width, channels)
        if value.shape != wanted:
            of = "" if name == "features" else ", of each sample the transposed weight of a linear map"
            raise ValueError(
                f"{name} of the modulation of x {tuple(x.shape)} must be {wanted}{of}, got {tuple(value.shape)}"
            )


def compose(outer: nn.Linear, inner: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of ``outer(inner(.))``."""
    return outer.weight @ inner.weight, outer.weight @ inner.bias + outer.bias


def _formula(
    x: Tensor,
    mean: Tensor,
    scale: Tensor,
    shift: Tensor,
    features: Tensor | None,
    scale_weight: Tensor | None,
    shift_weight: Tensor | None,
    weight: Tensor | None,
    bias: Tensor | None,
    slope: float | None,
) -> Tensor:
    """The definition."""
    if features is not None and scale_weight is not None and shift_weight is not None:
        scale = (features @ scale_weight).to(scale.dtype) + scale
        shift = (features @ shift_weight).to(shift.dtype) + shift
    y = (x - mean) * scale + shift
    if slope is not None:
        y = leaky_relu(y, slope)
    return y.to(x.dtype) if weight is None else linear(y.to(weight.dtype), weight, bias)


class _Modulate(torch.autograd.Function):
    """:func:`_formula` in tiles; the backward pass repeats the forward pass of its tile."""

    @staticmethod
    def forward(*inputs: Any) -> Tensor:
        *normed, weight, bias, slope = inputs
        x, mean = normed[:2]
        channels, dtype = (x.shape[2], x.dtype) if weight is None else (weight.shape[0], weight.dtype)
        out = torch.empty(*x.shape[:2], channels, dtype=dtype, device=x.device)
        work, scale, shift = (tile_buffer(x, mean.dtype) for _ in range(3))
        for b, rows in tiles(x):
            y = _activated(b, rows, (work, work, scale, shift), slope, *normed)[0]
            if weight is None:
                out[b, rows] = y
            elif bias is None:
                torch.mm(_flat(y.to(dtype)), weight.mT, out=_flat(out[b, rows]))
            else:
                torch.addmm(bias, _flat(y.to(dtype)), weight.mT, out=_flat(out[b, rows]))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        *tensors, ctx.slope = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # of second order: differentiate the definition
            return _differentiable_gradients(ctx, grad)
        normed: list[Any]
        *normed, weight, _ = ctx.saved_tensors
        x, mean, _, _, features, scale_weight, shift_weight = normed
        grad_x, grad_scale, grad_shift = torch.empty_like(x), torch.zeros_like(mean), torch.zeros_like(mean)
        # Products that nobody asks for are left out: a condition made of descriptors needs no gradient.
        needed, dtype = ctx.needs_input_grad, mean.dtype
        grad_features = torch.empty_like(features) if needed[4] else None
        grad_scale_weight = torch.zeros_like(scale_weight, dtype=dtype) if needed[5] else None
        grad_shift_weight = torch.zeros_like(shift_weight, dtype=dtype) if needed[6] else None
        grad_weight = torch.zeros_like(weight, dtype=dtype) if needed[7] else None
        buffers = [tile_buffer(x, dtype) for _ in range(4)]
        for b, rows in tiles(x):
            y, centred, scale = _activated(b, rows, buffers, ctx.slope, *normed)
            g = grad[b, rows]
            if grad_weight is not None:
                _accumulate(grad_weight, _flat(g).mT, _flat(y.to(weight.dtype)))
            if weight is not None:
                g = (g @ weight).to(y.dtype)
            if ctx.slope is not None:  # True: y is the result of the activation, not its input
                g = torch.ops.aten.leaky_relu_backward(g, y, ctx.slope, True, grad_input=y)
            torch.mul(g, scale, out=grad_x[b, rows])
            g_scale = centred.mul_(g)
            grad_scale[b] += g_scale.sum(-2, keepdim=True)
            grad_shift[b] += g.sum(-2, keepdim=True)
            if features is not None:
                f, g_scale, g = features[b, rows], g_scale.to(features.dtype), g.to(features.dtype)
                if grad_scale_weight is not None:
                    _accumulate(grad_scale_weight[b], f.mT, g_scale)
                if grad_shift_weight is not None:
                    _accumulate(grad_shift_weight[b], f.mT, g)
                if grad_features is not None:
                    torch.matmul(g_scale, scale_weight[b].mT, out=grad_features[b, rows])
                    _accumulate(grad_features[b, rows], g, shift_weight[b].mT)
        # The mean enters as x - mean, so its gradient is that of x summed.
        grad_mean = -grad_x.sum(1, keepdim=True, dtype=mean.dtype)
        grad_bias = grad.sum((0, 1)) if needed[8] else None
        grads = (grad_x, grad_mean, grad_scale, grad_shift, grad_features, grad_scale_weight, grad_shift_weight)
        return *grads, grad_weight, grad_bias, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[Tensor, int]:
        return torch.vmap(_formula, in_dims)(*inputs), 0


def _activated(
    b: int | slice,
    rows: slice,
    buffers: Sequence[Tensor],
    slope: float | None,
    x: Tensor,
    mean: Tensor,
    scale_bias: Tensor,
    shift_bias: Tensor,
    features: Tensor | None,
    scale_weight: Tensor | None,
    shift_weight: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """One tile of the activated features, the centred ones and the scale; the first two may share a buffer."""
    x = x[b, rows]
    y, centred, scale, shift = (fill(buffer, x) for buffer in buffers)
    if features is None or scale_weight is None or shift_weight is None:
        scale, shift = scale_bias[b], shift_bias[b]
    else:
        _affine(features[b, rows], scale_weight[b], scale_bias[b], out=scale)
        _affine(features[b, rows], shift_weight[b], shift_bias[b], out=shift)
    torch.sub(x, mean[b], out=centred)
    torch.addcmul(shift, centred, scale, out=y)
    if slope is not None:
        torch.nn.functional.leaky_relu_(y, slope)
    return y, centred, scale


def _affine(features: Tensor, weight: Tensor, bias: Tensor, *, out: Tensor) -> None:
    """``features @ weight + bias``; only the product may be in half precision."""
    if features.dtype == out.dtype:
        (torch.addmm if out.dim() == 2 else torch.baddbmm)(bias, features, weight, out=out)
    else:
        torch.add(features @ weight, bias, out=out)


def _accumulate(total: Tensor, a: Tensor, b: Tensor) -> None:
    """Add ``a @ b``; only the product may be in half precision."""
    if total.dtype == a.dtype:
        (total.addmm_ if total.dim() == 2 else total.baddbmm_)(a, b)
    else:
        total.add_(a @ b)


def _flat(tile: Tensor) -> Tensor:
    """The rows of a tile that may span samples."""
    return tile.flatten(0, -2)


def _differentiable_gradients(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    """Gradients that are functions of the inputs and of ``grad`` again."""
    tensors: tuple[Any, ...] = ctx.saved_tensors
    given = [i for i, tensor in enumerate(tensors) if tensor is not None]

    def formula(*values: Tensor) -> Tensor:
        inputs: list[Any] = [*tensors, ctx.slope]
        for i, value in zip(given, values, strict=True):
            inputs[i] = value
        return _formula(*inputs)

    gradients: list[Tensor | None] = [None] * (len(tensors) + 1)
    for i, value in zip(given, torch.func.vjp(formula, *(tensors[i] for i in given))[1](grad), strict=True):
        gradients[i] = value
    return tuple(gradients)
