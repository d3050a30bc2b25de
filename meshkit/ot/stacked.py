r"""Samples of one size solved together, their kernels stored: many small problems at the price of one.

The iterations and their gradient are those of :mod:`meshkit.ot.iterations` in the kernel domain with uniform marginals,
on tensors with a leading batch dimension. Where starting an operation costs more than running it, on a GPU always and
on a CPU for small problems, a loop over samples would cost many times the work itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from meshkit._numerics import full_precision, launch_bound
from meshkit.ot.costs import logit_features, number
from meshkit.ot.kernel import GibbsKernel, Ledger, refuse_second_derivative
from meshkit.ot.options import Options
from meshkit.ot.sample import SamplePlan
from meshkit.ot.tiles import LOG2_E, Factors, FeatureTiles, Reference, Tiles

__all__: list[str] = []  # internal: meshkit.ot lists what is public

SMALL = 1 << 16
"""On a CPU, entries of a kernel up to which samples are solved together; larger ones gain by staying in the cache."""

STACK_BYTES = 1 << 27
"""Kernels up to this size, all samples together, are stored by ``store="auto"``."""


def stackable(fx: Tensor, fy: Tensor, cost: str, options: Options, dtype: torch.dtype, *given: Tensor | None) -> bool:
    """Whether :func:`solve_stacked` may take the problem; ``given`` are masks and weights, which must be missing.

    It would work in ``dtype``.

    Only the cosine cost has a range that is known without a look at the features.
    """
    settings, store = options.settings, options.store
    if cost != "cosine" or any(tensor is not None for tensor in given):
        return False
    if not launch_bound(fx) and fx.shape[1] * fy.shape[1] > SMALL:
        return False
    if (
        options.dual
        or options.unbalanced
        or settings.tol is not None
        or settings.scales
        or settings.grad not in ("unroll", "none")
    ):
        return False
    (batch, rows, _), columns = fx.shape, fy.shape[1]
    if options.domain == "log" or store == "stream":
        return False
    if store == "auto" and batch * rows * columns * dtype.itemsize > STACK_BYTES:
        return False
    room = math.log(torch.finfo(dtype).max) - math.log(rows * columns)
    return options.domain == "kernel" or 2 / number(options.eps) <= room


def solve_stacked(x: Tensor, y: Tensor, options: Options) -> SamplePlan:
    """The plans of all samples ``(B, N, D)``, ``(B, M, D)``."""
    if options.settings.grad == "none":
        x, y = x.detach(), y.detach()
    x, y, _, shift = logit_features(x, y, "cosine", options.eps, constant=False)
    kernel = GibbsKernel(cast(Tiles, StackedTiles(x, y)), x, y)
    mu, nu = (t.new_full(t.shape[:2], 1 / t.shape[1]) for t in (x.detach(), y.detach()))
    b = _StackedIterations.apply(kernel.token, mu, nu, kernel.ledger, options.settings.n_iters)
    return SamplePlan(
        kernel=kernel,
        mu=mu,
        nu=nu,
        b=b,
        reference=None,
        power_x=1.0,
        eps=options.eps,
        shift=shift,
        index_x=None,
        index_y=None,
        n_iters=options.settings.n_iters,
    )


def split(stack: SamplePlan) -> list[SamplePlan]:
    """The plans one by one, for readings that differ from sample to sample."""
    x, y = stack.kernel.inputs
    # The first reading may be one without gradient; later ones must find the graph all the same.
    with torch.inference_mode(False), torch.enable_grad():
        return _samples(stack, x, y)


def _samples(stack: SamplePlan, x: Tensor, y: Tensor) -> list[SamplePlan]:
    return [
        replace(stack, kernel=GibbsKernel(FeatureTiles(x_s, y_s, "kernel"), x_s, y_s), mu=mu, nu=nu, b=b, _sums=None)
        for x_s, y_s, mu, nu, b in zip(x, y, stack.mu, stack.nu, stack.b, strict=True)
    ]


class StackedTiles:
    """Kernels ``2 ** (x @ y.T)`` of a batch, ``(B, N, M)``, stored.

    Offers of :class:`~meshkit.ot.tiles.Tiles` what a :class:`~meshkit.ot.kernel.GibbsKernel` asks for.
    """

    def __init__(self, x: Tensor, y: Tensor) -> None:
        self.x, self.y = x.detach(), y.detach()
        self.kernel = torch.bmm(self.x, self.y.mT).exp2_()

    def apply(self, columns: Tensor, reference: Reference | None = None) -> Tensor:
        """``K @ columns`` for ``(B, M, C)``."""
        assert reference is None
        return self.kernel @ columns

    def apply_transpose(self, columns: Tensor, reference: Reference | None = None) -> Tensor:
        """``K.T @ columns`` for ``(B, N, C)``."""
        assert reference is None
        return self.kernel.mT @ columns

    def pullback(self, factors: Sequence[Factors]) -> tuple[Tensor, ...]:
        """Gradients of x and y."""
        left, right = torch.cat([f.left for f in factors], 2), torch.cat([f.right for f in factors], 2)
        gradient = (left / LOG2_E @ right.mT).mul_(self.kernel)
        return gradient @ self.y, gradient.mT @ self.x


class _StackedIterations(torch.autograd.Function):
    """Algorithm 1 for uniform marginals; returns b_T ``(B, M)``."""

    @staticmethod
    @full_precision
    def forward(ctx: Any, token: Tensor, mu: Tensor, nu: Tensor, ledger: Ledger, n_iters: int) -> Tensor:
        tiles = ledger.tiles
        rows, columns = [mu[..., None]], list[Tensor]()
        for t in range(n_iters):
            if t:
                rows.append(mu[..., None] / tiles.apply(columns[-1]))
            columns.append(nu[..., None] / tiles.apply_transpose(rows[-1]))
        ctx.save_for_backward(mu, nu, *rows, *columns)
        ctx.ledger = ledger
        return columns[-1][..., 0]

    @staticmethod
    @full_precision
    def backward(ctx: Any, grad_b: Tensor) -> tuple[Any, ...]:
        refuse_second_derivative()
        mu, nu, *scalings = ctx.saved_tensors
        mu, nu, tiles, steps = mu[..., None], nu[..., None], ctx.ledger.tiles, len(scalings) // 2
        rows, columns = scalings[:steps], scalings[steps:]
        lefts, rights = [], []
        grad_log_b = grad_b[..., None] * columns[-1]
        for t in range(steps - 1, -1, -1):
            # log b = log nu - log c, c = Kᵀ a
            grad_c = -grad_log_b * columns[t] / nu
            lefts.append(rows[t])
            rights.append(grad_c)
            if t == 0:
                break
            # log a = log mu - log r, r = K b_{t-1}
            grad_r = -rows[t].square() / mu * tiles.apply(grad_c)
            lefts.append(grad_r)
            rights.append(columns[t - 1])
            grad_log_b = columns[t - 1] * tiles.apply_transpose(grad_r)
        return ctx.ledger.hand_in(ctx, Factors(torch.cat(lefts, 2), torch.cat(rights, 2), None)), None, None, None, None
