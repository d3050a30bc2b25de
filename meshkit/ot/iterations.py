r"""Sinkhorn iterations of one sample and their exact derivatives, in the kernel and in the log domain.

.. math:: a_0 = \mu, \qquad b_t = (\nu / K^\top a_{t-1})^{p_y}, \qquad a_t = (\mu / K b_t)^{p_x}, \qquad t = 1 \dots T

with both powers 1 for balanced transport. Every half step's Jacobian with respect to the logits is the kernel times a
rank-one matrix, so the gradient of all T iterations needs the scalings alone.

The functions return :math:`b_T`; :math:`a_T` follows from it by one more product with the kernel, which its reader
makes anyway. In the log domain :math:`b_T` is returned relative to the final potentials, so that it is 1 and carries
the gradient of :math:`\log b_T`.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from meshkit._numerics import full_precision
from meshkit.ot.kernel import GibbsKernel, Ledger, refuse_second_derivative
from meshkit.ot.tiles import Factors, Reference, Tiles

__all__: list[str] = []  # internal: meshkit.ot lists what is public


class Settings(NamedTuple):
    """How to iterate, and through what to differentiate.

    Args:
        n_iters: most iterations.
        tol: stop when the column sums are this close to their marginal (sum of absolute differences), or ``None``.
        power_x: exponent of the row scalings, 1 if balanced.
        power_y: of the column scalings.
        grad: ``"unroll"``, ``"last_step"`` or ``"implicit"``.
        scales: in the log domain, final eps over the eps of each iteration; empty for a constant eps.
    """

    n_iters: int
    tol: float | None = None
    power_x: float = 1.0
    power_y: float = 1.0
    grad: str = "unroll"
    scales: tuple[float, ...] = ()


class Solution(NamedTuple):
    """Column scaling ``(M,)``, the reference it is relative to, and the number of iterations done."""

    b: Tensor
    reference: Reference | None
    n_iters: int


def iterate_kernel(kernel: GibbsKernel, mu: Tensor, nu: Tensor, settings: Settings) -> Solution:
    """Iterate on the kernel itself."""
    b, n_iters = _KernelIterations.apply(kernel.token, mu, nu, kernel.ledger, settings)
    return Solution(b, None, n_iters)


def iterate_log(
    kernel: GibbsKernel, mu: Tensor, nu: Tensor, settings: Settings, start: Tensor | None = None
) -> Solution:
    """Iterate on the potentials; ``start`` is the logarithm (base 2) of the first row scaling, of mu if ``None``."""
    b, alpha, beta, n_iters = _LogIterations.apply(kernel.token, mu, nu, kernel.ledger, settings, start)
    return Solution(b, Reference(alpha, beta), n_iters)


class _KernelIterations(torch.autograd.Function):
    @staticmethod
    @full_precision
    def forward(
        ctx: Any, token: Tensor, mu: Tensor, nu: Tensor, ledger: Ledger, settings: Settings
    ) -> tuple[Tensor, int]:
        tiles = ledger.tiles
        rows, columns = [mu], list[Tensor]()
        sums = tiles.apply_transpose(mu[:, None])[:, 0]
        while True:
            b = (nu / sums).pow(settings.power_y)
            done = len(columns) + 1 == settings.n_iters
            if columns and settings.tol is not None:
                done |= converged(b, columns[-1], nu, settings.tol)
            columns.append(b)
            if done:
                break
            # One sweep makes a whole iteration: a block of a, then its share of the next column sums.
            a, sums = torch.empty_like(mu), torch.zeros_like(nu)
            for block, entries in tiles.entries(None):
                a[block] = (mu[block] / torch.mv(entries, b)).pow(settings.power_x)
                sums.addmv_(entries.mT, a[block])
            rows.append(a)
        ctx.save_for_backward(mu, nu, *rows, *columns)
        ctx.ledger, ctx.settings = ledger, settings
        return b, len(columns)

    @staticmethod
    @full_precision
    def backward(ctx: Any, grad_b: Tensor, _: None) -> tuple[Any, ...]:
        refuse_second_derivative()
        mu, nu, *scalings = ctx.saved_tensors
        settings, tiles = ctx.settings, ctx.ledger.tiles
        steps = len(scalings) // 2
        rows, columns = scalings[:steps], scalings[steps:]
        if settings.grad == "implicit":
            factors, grad_mu, grad_nu = _implicit(tiles, mu, nu, columns[-1], None, grad_b * columns[-1], settings)
            token = ctx.ledger.hand_in(ctx, *factors)
            return token, grad_mu, grad_nu, None, None
        grad_mu, grad_nu = torch.zeros_like(mu), torch.zeros_like(nu)
        lefts, rights = [], []
        last = steps - (1 if settings.grad == "last_step" else steps)
        grad_log_b = grad_b * columns[-1]
        for t in range(steps - 1, last - 1, -1):
            a, b = rows[t], columns[t]
            # log b = p_y (log nu - log c), c = Kᵀ a
            grad_log_b *= settings.power_y
            grad_nu += grad_log_b / nu
            grad_c = -grad_log_b / kernel_sums(nu, b, settings.power_y)
            lefts.append(a)
            rights.append(grad_c)
            if t == last:
                if t == 0 and ctx.needs_input_grad[1]:  # a_0 is mu
                    grad_mu += tiles.apply(grad_c[:, None])[:, 0]
                break
            # log a = p_x (log mu - log r), r = K b_{t-1}
            b = columns[t - 1]
            sums = kernel_sums(mu, a, settings.power_x)
            grad_log_a, gathered = torch.empty_like(a), torch.zeros_like(b)
            for block, entries in tiles.entries(None):
                grad_log_a[block] = settings.power_x * a[block] * torch.mv(entries, grad_c)
                gathered.addmv_(entries.mT, -grad_log_a[block] / sums[block])
            grad_mu += grad_log_a / mu
            lefts.append(-grad_log_a / sums)
            rights.append(b)
            grad_log_b = b * gathered
        joined = Factors(torch.stack(lefts, 1), torch.stack(rights, 1), None)
        return ctx.ledger.hand_in(ctx, joined), grad_mu, grad_nu, None, None


def kernel_sums(weights: Tensor, scaling: Tensor, power: float) -> Tensor:
    """The kernel sums that gave ``scaling = (weights / sums) ** power``."""
    return weights / (scaling if power == 1.0 else scaling.pow(1 / power))


def converged(b: Tensor, previous: Tensor, nu: Tensor, tol: float) -> bool:
    """Whether the column sums nu * previous / b of the plan before this half step are within ``tol`` of nu.

    As a share of the total.
    """
    return bool((nu * (previous / b - 1)).abs().sum() < tol * nu.sum())


class _LogIterations(torch.autograd.Function):
    @staticmethod
    @full_precision
    def forward(
        ctx: Any, token: Tensor, mu: Tensor, nu: Tensor, ledger: Ledger, settings: Settings, start: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, int]:
        tiles, log_mu, log_nu = ledger.tiles, mu.log2(), nu.log2()
        scales = settings.scales or (1.0,) * settings.n_iters
        alphas, betas = [log_mu if start is None else start], []
        row_sums, column_sums = [], [tiles.log_sum_columns(alphas[0], scales[0])]
        for t in range(settings.n_iters):
            beta = settings.power_y * (log_nu - column_sums[-1])
            betas.append(beta)
            done = t + 1 == settings.n_iters
            if t and settings.tol is not None and scales[t] == scales[t - 1] == 1.0:
                change = (betas[-2] - beta).exp2()
                done |= converged(torch.ones_like(beta), change, nu, settings.tol)
            follow = not done and scales[t + 1] == scales[t]
            if follow:
                sums, following = tiles.log_sweep(beta, log_mu, settings.power_x, scales[t])
            else:
                sums, following = tiles.log_sum_rows(beta, scales[t]), None
            row_sums.append(sums)
            alpha = settings.power_x * (log_mu - sums)
            if done:
                break
            if following is None:
                # Potentials eps * log(a / mu) stay as they are when eps changes.
                alpha = log_mu + (alpha - log_mu) * (scales[t + 1] / scales[t])
                following = tiles.log_sum_columns(alpha, scales[t + 1])
            alphas.append(alpha)
            column_sums.append(following)
        ctx.save_for_backward(mu, nu, *alphas, *betas, *row_sums, *column_sums)
        ctx.ledger, ctx.settings, ctx.scales, ctx.given_start = ledger, settings, scales, start is not None
        # The final potentials hold at the final eps, also if the iterations stopped early.
        b = torch.ones_like(beta)
        ctx.mark_non_differentiable(alpha, beta)
        return b, alpha, beta, len(betas)

    @staticmethod
    @full_precision
    def backward(ctx: Any, grad_b: Tensor, *_: None) -> tuple[Any, ...]:
        refuse_second_derivative()
        mu, nu, *saved = ctx.saved_tensors
        settings, tiles, scales = ctx.settings, ctx.ledger.tiles, ctx.scales
        steps = len(saved) // 4
        alphas, betas, row_sums, sums_of_columns = (saved[i * steps : (i + 1) * steps] for i in range(4))
        log_mu, log_nu = mu.log2(), nu.log2()
        if settings.grad == "implicit":
            final = Reference(settings.power_x * (log_mu - row_sums[-1]), betas[-1])
            factors, grad_mu, grad_nu = _implicit(tiles, mu, nu, torch.ones_like(nu), final, grad_b, settings)
            token = ctx.ledger.hand_in(ctx, *factors)
            return token, grad_mu, grad_nu, None, None, None
        grad_mu, grad_nu = torch.zeros_like(mu), torch.zeros_like(nu)
        handed_in = []
        ones_x, ones_y = torch.ones_like(mu), torch.ones_like(nu)
        last = steps - (1 if settings.grad == "last_step" else steps)
        grad_log_b = grad_b
        for t in range(steps - 1, last - 1, -1):
            # log b = p_y (log nu - log c): entries 2^(L + alpha - log c) nu, whose columns sum to nu
            grad_log_b = settings.power_y * grad_log_b / nu
            grad_nu += grad_log_b
            columns = Reference(alphas[t], log_nu - sums_of_columns[t], scales[t])
            handed_in.append(Factors(ones_x[:, None], -scales[t] * grad_log_b[:, None], columns))
            wanted = ctx.needs_input_grad[1] and not ctx.given_start  # a_0 is mu
            if t == last and not (t == 0 and wanted):
                break
            grad_log_a = -tiles.apply(grad_log_b[:, None], columns)[:, 0]
            if t == 0:
                grad_mu += grad_log_a / mu
                break
            if scales[t] != scales[t - 1]:
                ratio = scales[t] / scales[t - 1]
                grad_mu += (1 - ratio) * grad_log_a / mu
                grad_log_a = ratio * grad_log_a
            # log a = p_x (log mu - log r): entries 2^(L + beta - log r) mu, whose rows sum to mu
            grad_log_a = settings.power_x * grad_log_a / mu
            grad_mu += grad_log_a
            rows = Reference(log_mu - row_sums[t - 1], betas[t - 1], scales[t - 1])
            handed_in.append(Factors(-scales[t - 1] * grad_log_a[:, None], ones_y[:, None], rows))
            grad_log_b = -tiles.apply_transpose(grad_log_a[:, None], rows)[:, 0]
        return ctx.ledger.hand_in(ctx, *handed_in), grad_mu, grad_nu, None, None, None


def _implicit(
    tiles: Tiles,
    mu: Tensor,
    nu: Tensor,
    b: Tensor,
    reference: Reference | None,
    gradient: Tensor,
    settings: Settings,
) -> tuple[list[Factors], Tensor, Tensor]:
    r"""Gradient of log b at the fixed point of the iterations, by conjugate gradients.

    With r = K b, c = Kᵀ a, the fixed point's adjoint solves
    :math:`(1 - p_x p_y\, b \circ K^\top \mathrm{diag}(a / r) K\, \mathrm{diag}(1/c))\, \lambda = g`, which
    :math:`\lambda = \sqrt{b c}\, z` makes symmetric. Balanced transport leaves b free up to a factor; that direction is
    left out.
    """
    r = tiles.apply(b[:, None], reference)[:, 0]
    a = (mu / r).pow(settings.power_x) if reference is None else torch.ones_like(mu)
    c = tiles.apply_transpose(a[:, None], reference)[:, 0]
    root, damping = (b * c).sqrt(), settings.power_x * settings.power_y
    free = root / root.norm() if damping == 1.0 else torch.zeros_like(root)

    def project(z: Tensor) -> Tensor:
        return z - free * (free @ z)

    def operator(z: Tensor) -> Tensor:
        forth = tiles.apply((root * z / c)[:, None], reference) * (a / r)[:, None]
        return project(z - damping * (b / root) * tiles.apply_transpose(forth, reference)[:, 0])

    rhs = gradient / root
    z = conjugate_gradient(operator, project(rhs), rhs.norm())
    solution = root * z
    grad_nu = settings.power_y * solution
    grad_c = -grad_nu / c
    grad_mu = settings.power_x * a * tiles.apply(grad_c[:, None], reference)[:, 0]
    factors = [Factors(a[:, None], grad_c[:, None], reference), Factors((-grad_mu / r)[:, None], b[:, None], reference)]
    return factors, grad_mu / mu, grad_nu / nu


def conjugate_gradient(operator: Any, rhs: Tensor, size: Tensor, max_iter: int = 500) -> Tensor:
    """Solve with a symmetric positive semi-definite operator to the precision of the dtype, relative to ``size``.

    That is the norm of the right-hand side before it was projected: what rounding left of the free direction is no
    more than noise, and its solution 0.
    """
    solution, residual, direction = torch.zeros_like(rhs), rhs.clone(), rhs.clone()
    squared = residual @ residual
    target = (1e-6 if rhs.dtype == torch.float32 else 1e-13) ** 2 * size.square()
    for _ in range(max_iter):
        if bool(squared <= target):
            return solution
        image = operator(direction)
        curvature = direction @ image
        if bool(curvature <= 0):  # of a positive operator that is rounding, and another step would be noise
            return solution
        step = squared / curvature
        solution += step * direction
        residual -= step * image
        previous, squared = squared, residual @ residual
        direction = residual + squared / previous * direction
    warnings.warn(
        f"the implicit gradient of sinkhorn stopped after {max_iter} steps at relative residual "
        f"{float(squared.sqrt() / size):.1e}; the iterations may not have converged either",
        stacklevel=2,
    )
    return solution
