"""Options of the Sinkhorn functions, read and checked once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from meshkit.ot.costs import number
from meshkit.ot.iterations import Settings
from meshkit.ot.marginals import Sides

__all__: list[str] = []  # internal: meshkit.ot lists what is public

Cost = Literal["cosine", "sqeuclidean", "dot"]
Grad = Literal["unroll", "implicit", "last_step", "none"]
Domain = Literal["auto", "kernel", "log"]
Store = Literal["auto", "stream", "keep"]
Eps = float | Tensor | Sequence[float]
Reach = float | tuple[float | None, float | None] | None

KEEP_BYTES = 1 << 30
"""``store="auto"`` keeps kernels up to this size, all samples together."""


class Options(NamedTuple):
    """Options of :func:`sinkhorn`, read and checked.

    With ``dual`` the potentials are constants, ``"between"`` two sets or ``"within"`` one: see :mod:`meshkit.ot.dual`.
    """

    eps: float | Tensor
    settings: Settings
    domain: Domain
    store: Store
    dual: Literal["between", "within"] | None = None

    @property
    def unbalanced(self) -> bool:
        """Constant shifts of the cost matter only then."""
        return self.settings.power_x != 1.0 or self.settings.power_y != 1.0

    def keep(self, size: int) -> bool:
        """Whether to store the kernels, of so many bytes in all."""
        return self.store == "keep" or (self.store == "auto" and size <= KEEP_BYTES)

    def through(self, schedule: Sequence[float]) -> Options:
        """The same, with eps falling through a schedule that ends at it and has ``n_iters`` values at most."""
        steps = self.settings.n_iters - len(schedule)
        scales = (*(schedule[-1] / eps for eps in schedule), *[1.0] * steps)
        return self._replace(settings=self.settings._replace(scales=scales))

    def domain_for(self, spread: float, sides: Sides) -> str:
        """``"kernel"`` if logits that differ by ``spread`` leave all scalings within the range of the dtype."""
        if self.settings.scales:
            return "log"
        if self.domain != "auto":
            return self.domain
        return "kernel" if spread <= math.log(torch.finfo(sides.mu.dtype).max) - sides.weight_range else "log"


def read_options(
    eps: Eps, n_iters: int, tol: float | None, reach: Reach, grad: str, domain: Domain, store: Store
) -> Options:
    """Check the options."""
    eps, n_iters, tol, reach = (plain(value) for value in (eps, n_iters, tol, reach))
    for name, given, choices in (("grad", grad, Grad), ("domain", domain, Domain), ("store", store, Store)):
        check_choice(name, given, choices)
    if not isinstance(n_iters, int) or n_iters < 1:
        raise ValueError(f"n_iters must be an integer of at least 1, got {n_iters!r}")
    if tol is not None and not tol >= 0:
        raise ValueError(f"tol must be None or at least 0, got {tol!r}")
    schedule: Sequence[float] = ()
    if isinstance(eps, str) or not isinstance(eps, int | float | Tensor | Sequence):
        raise ValueError(f"eps must be a number, a scalar tensor or a sequence of numbers, got {type(eps).__name__}")
    if isinstance(eps, Sequence):
        if len(eps) == 0:
            raise ValueError("a sequence of eps needs at least one value")
        n_iters = max(n_iters, len(eps))
        if any(isinstance(e, Tensor) for e in eps):
            raise ValueError("a sequence of eps must hold numbers: it receives no gradient")
        if domain == "kernel":
            raise ValueError('a sequence of eps needs domain="log" or "auto"')
        final = eps[-1]
        if not all(e > 0 and final / e > 0 for e in eps):
            raise ValueError(f"every eps must be positive, got {list(eps)}")
        schedule, eps = eps, final
    if isinstance(eps, Tensor) and eps.numel() != 1:
        raise ValueError(f"eps as a tensor must hold one value, got shape {tuple(eps.shape)}")
    value = number(eps)
    if not 0 < value < math.inf:
        raise ValueError(f"eps must be positive and finite, got {value:g}")
    powers = []
    sides = tuple(plain(side) for side in reach) if isinstance(reach, Sequence) else (reach, reach)
    if len(sides) != 2 or not all(side is None or isinstance(side, int | float) for side in sides):
        raise ValueError(f"reach must be None, a number, or a pair of these for rows and columns, got {reach!r}")
    for side in sides:
        if side is not None and not side > 0:
            raise ValueError(f"reach must be positive, or None for an exact marginal, got {reach!r}")
        powers.append(1.0 if side is None or side == math.inf else side / (side + value))
    if schedule and powers != [1.0, 1.0]:
        raise ValueError("reach cannot be combined with a sequence of eps")
    if isinstance(eps, Tensor) and eps.requires_grad and powers != [1.0, 1.0]:
        raise ValueError("reach cannot be combined with a learned eps: its power would need a gradient too")
    if isinstance(eps, Tensor):
        eps = (eps.detach() if grad == "none" else eps).reshape(())
    options = Options(eps, Settings(n_iters, tol, powers[0], powers[1], grad), domain, store)
    return options.through(schedule) if schedule else options


def plain(value: Any) -> Any:
    """A NumPy scalar or array as the numbers it holds; all else as it is."""
    return value.tolist() if hasattr(value, "tolist") and not isinstance(value, Tensor) else value


def check_choice(name: str, value: object, choices: object) -> None:
    """``choices`` is a ``Literal``."""
    if value not in get_args(choices):
        raise ValueError(f"{name} must be one of {get_args(choices)}, got {value!r}")
