r"""Dual potentials as constants: for values whose derivative in the potentials vanishes, such as the dual's own.

Without a gradient to keep exact, the iterations may be other ones with the same limit, in the log domain. Between two
sets both half steps are over-relaxed, :math:`\beta \leftarrow (1 - \omega) \beta + \omega T\alpha`, with the omega that
the rate seen asks for; of a set to itself one potential is averaged with its image, :math:`\alpha \leftarrow (\alpha +
T\alpha) / 2`, which halves the error whatever eps is, since the linearised T has its spectrum in [-1, 0].
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from meshkit.ot.iterations import Settings, Solution
from meshkit.ot.kernel import GibbsKernel
from meshkit.ot.tiles import Reference

__all__: list[str] = []  # internal: meshkit.ot lists what is public

_WINDOW, _LONGER = 10, 4.0  # iterations between two estimates of the rate, and of 1 / (2 - omega) if that is more
_SLOWEST = 0.9999  # rate of the plain iterations that omega is made for at most: 1.98
_MARGIN, _GROWTH, _FALL = (
    0.1,
    8.0,
    0.98,
)  # how near q may come to omega - 1; growth of 1 / (1 - rate); fall of omega - 1


@torch.no_grad()
def iterate_between(kernel: GibbsKernel, mu: Tensor, nu: Tensor, settings: Settings) -> Solution:
    """Potentials of balanced transport between two sets."""
    tiles, log_mu, log_nu = kernel.tiles, mu.log2(), nu.log2()
    scales = settings.scales or (1.0,) * settings.n_iters
    alpha, beta, relaxation, omega = log_mu, log_nu, Relaxation(), 1.0
    sums = tiles.log_sum_columns(alpha, scales[0])
    for t, scale in enumerate(scales):
        exact, settled, last = log_nu - sums, t > 0 and scale == scales[t - 1] == 1.0, t + 1 == len(scales)
        before, omega = omega, 1.0
        if settled and settings.tol is not None:
            error = _violation(beta, exact, nu)
            met = not settings.tol <= error < math.inf
            # After a relaxed step the rows are not exact, so a plain one has to confirm that the columns are.
            last |= met and before == 1.0
            omega = 1.0 if met else relaxation(error)
        beta = exact if last else torch.lerp(beta, exact, omega)
        if last:
            break
        if scales[t + 1] == scale:
            # The relaxed row step is a plain one with another weight and power, so it shares the sweep.
            weight = log_mu + (1 / omega - 1) * alpha
            row_sums, sums = tiles.log_sweep(beta, weight, omega, scale)
            alpha = omega * (weight - row_sums)
        else:
            alpha = log_mu - tiles.log_sum_rows(beta, scale)
            alpha = log_mu + (alpha - log_mu) * (scales[t + 1] / scale)
            sums = tiles.log_sum_columns(alpha, scales[t + 1])
    return _solution(kernel, mu, beta, t + 1)


@torch.no_grad()
def iterate_within(kernel: GibbsKernel, mu: Tensor, settings: Settings) -> Solution:
    """Potentials of a set's transport to itself, under a symmetric kernel."""
    tiles, log_mu = kernel.tiles, mu.log2()
    scales = settings.scales or (1.0,) * settings.n_iters
    alpha = log_mu
    for t, scale in enumerate(scales):
        image, last = log_mu - tiles.log_sum_columns(alpha, scale), t + 1 == len(scales)
        if settings.tol is not None and scale == 1.0:
            last |= not settings.tol <= _violation(alpha, image, mu) < math.inf
        if last:
            break
        alpha = log_mu + ((alpha + image) / 2 - log_mu) * (scales[t + 1] / scale)
    return _solution(kernel, mu, image, t + 1)


class Relaxation:
    """Omega from the violations of successive iterations.

    Iterations of rate q under omega would have the rate ``(q + omega - 1)² / (q omega²)`` without, and that is best
    served by ``2 / (1 + sqrt(1 - rate))``. That holds for q above ``omega - 1``, which is the rate of all larger omega:
    where it is seen, omega comes down. It grows by steps, since far from the fixed point rates say little, and goes
    back to 1 where the violation has grown tenfold.
    """

    def __init__(self) -> None:
        self.omega, self._seen, self._least = 1.0, list[float](), math.inf

    def __call__(self, error: float) -> float:
        """Omega of the coming iteration."""
        self._seen.append(error)
        passed = len(self._seen) - 1
        if passed < max(_WINDOW, _LONGER / (2 - self.omega)):
            return self.omega
        rate = (error / self._seen[0]) ** (1 / passed) if self._seen[0] > 0 else 1.0
        if not error <= 10 * self._least:
            self.omega = 1.0
        elif 1 > rate > self.omega - 1 + _MARGIN * (2 - self.omega):
            plain = (rate + self.omega - 1) ** 2 / (rate * self.omega**2)
            self.omega = _best(max(1 - plain, (1 - _plain(self.omega)) / _GROWTH, 1 - _SLOWEST))
        else:
            self.omega = 1 + _FALL * (self.omega - 1)
        self._seen, self._least = [error], min(self._least, error)
        return self.omega


def _best(gap: float) -> float:
    """Omega for iterations whose rate is 1 - ``gap``."""
    return 2 / (1 + math.sqrt(gap))


def _plain(omega: float) -> float:
    """The rate that ``omega`` is best for."""
    return 1 - (2 / omega - 1) ** 2


def _violation(potential: Tensor, exact: Tensor, weights: Tensor) -> float:
    """How far the sums of a plan are from their weights, as a share of the total."""
    return float(((potential - exact).exp2() - 1).abs() @ weights / weights.sum())


def _solution(kernel: GibbsKernel, mu: Tensor, beta: Tensor, n_iters: int) -> Solution:
    """With exact rows."""
    alpha = mu.log2() - kernel.tiles.log_sum_rows(beta)
    return Solution(torch.ones_like(beta), Reference(alpha, beta), n_iters)
