"""Metrics that add up over batches, and over the processes of a distributed run."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from meshkit.metrics.chamfer import chamfer_distance
from meshkit.metrics.correspondence import correspondence_error
from meshkit.metrics.earth_movers import earth_movers_distance
from meshkit.metrics.edge_ratio import edge_ratio
from meshkit.metrics.pmd import pmd
from meshkit.metrics.self_intersection import self_intersection_rate
from meshkit.metrics.volume import volume_change

__all__ = [
    "PMD",
    "ChamferDistance",
    "CorrespondenceError",
    "EarthMoversDistance",
    "EdgeRatio",
    "MeanMetric",
    "SelfIntersectionRate",
    "VolumeChange",
]


class MeanMetric:
    r"""Mean of a metric over all samples of a data set, however they are split into batches and processes.

    .. math:: \frac{\sum_{r} \sum_{b} m_{rb}}{\sum_r B_r}

    over the processes r and their samples b: sum and number are added up, not the means, so that an incomplete last
    batch, or ranks with different numbers of samples, do not bias the result. The protocol is that of torchmetrics,
    ``update``, ``compute``, ``reset`` and a call that updates and returns the mean of the batch, without that package.
    Samples that a distributed sampler repeats to fill up count as often as they are seen.

    Args:
        function: a metric that returns ``(B,)``, or ``(B, K)`` such as a curve.
        process_group: of ``torch.distributed``, the default one if None. Used only if it is initialised.
        options: keyword arguments for every call of ``function``, e.g. ``squared=False``.

    Raises:
        TypeError: ``function`` has no such option.

    Example:
        >>> metric = MeanMetric(lambda pred, target: (pred - target).abs().mean(1))
        >>> metric.update(torch.ones(3, 5), torch.zeros(3, 5))
        >>> metric.update(torch.full((1, 5), 5.0), torch.zeros(1, 5))
        >>> metric.compute()  # (3 x 1 + 5) / 4
        tensor(2., dtype=torch.float64)
    """

    def __init__(
        self, function: Callable[..., Tensor], *, process_group: dist.ProcessGroup | None = None, **options: Any
    ) -> None:
        if not callable(function):
            raise TypeError(f"function must be a metric, such as meshkit.metrics.pmd, got {function!r}")
        _check_options(function, options)
        self.function = function
        self.options = options
        self.process_group = process_group
        self.reset()

    def __repr__(self) -> str:
        """Metric, options and number of samples so far."""
        name = type(self).__name__
        given = [] if name != "MeanMetric" else [getattr(self.function, "__name__", repr(self.function))]
        given += [f"{key}={_short(value)}" for key, value in self.options.items()]
        return f"{name}({', '.join(given)}): {self._count} samples"

    def reset(self) -> None:
        """Forget all samples."""
        self._total: Tensor | None = None
        self._count = 0

    def update(self, *args: Any, **kwargs: Any) -> None:
        """Add the samples of a batch; arguments are those of the function."""
        self._add(*args, **kwargs)

    def __call__(self, *args: Any, **kwargs: Any) -> Tensor:
        """Add the samples of a batch and return their mean, on this process alone."""
        return self._add(*args, **kwargs).mean(0)

    def compute(self) -> Tensor:
        """Mean over all samples so far, of all processes; every one of them must call it.

        Returns:
            float64 (float32 on devices without it), a scalar or ``(K,)``; NaN if there were no samples. The state stays
            as it is, so that more may be added.
        """
        total, count = self._total, torch.tensor(self._count, dtype=torch.float64, device="cpu")
        if dist.is_available() and dist.is_initialized():
            total, count = self._reduced(total, count)
        return count.new_full((), torch.nan) if total is None else total / count.to(total)

    @torch.no_grad()
    def _add(self, *args: Any, **kwargs: Any) -> Tensor:
        values = self.function(*args, **{**self.options, **kwargs})
        # Thousands of float32 samples would lose digits; Apple's devices have nothing better.
        total = values.sum(0, dtype=torch.float32 if values.device.type == "mps" else torch.float64)
        self._total = total if self._total is None else self._total + total
        self._count += len(values)
        return values

    def _reduced(self, total: Tensor | None, count: Tensor) -> tuple[Tensor | None, Tensor]:
        """Sums over the processes. A process without samples does not know the shape, so all exchange it first."""
        device = "cuda" if dist.get_backend(self.process_group) == "nccl" else "cpu"
        columns = torch.tensor(-1 if total is None else len(total) if total.ndim else 0, device=device)
        dist.all_reduce(columns, dist.ReduceOp.MAX, group=self.process_group)
        size = int(columns)
        state = torch.zeros(max(size, 1) + 1, dtype=torch.float64, device=device)
        state[-1] = count
        if total is not None:
            state[:-1] = total.flatten()
        dist.all_reduce(state, group=self.process_group)
        if size < 0:
            return None, state[-1]
        reduced = state[:-1] if size else state[0]
        return reduced if total is None else reduced.to(total), state[-1]


def _check_options(function: Callable[..., Tensor], options: dict[str, Any]) -> None:
    """Refuse options that the function does not have here, where they are given, and not at the first batch."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of a function that tells nothing of itself
        return
    try:
        signature.bind_partial(**options)
    except TypeError as error:
        name = getattr(function, "__name__", "the metric")
        raise TypeError(f"{error}: options of {name} are {', '.join(signature.parameters)}") from None


def _short(value: Any) -> str:
    return f"tensor{tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)


class PMD(MeanMetric):
    """Mean of :func:`pmd`.

    Args:
        options: those of :func:`pmd`, and ``process_group``.

    Example:
        >>> target = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]]])
        >>> PMD()(2 * target, target)
        tensor(0.3333)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(pmd, **options)


class ChamferDistance(MeanMetric):
    """Mean of :func:`chamfer_distance`.

    Args:
        options: those of :func:`chamfer_distance`, and ``process_group``.

    Example:
        >>> ChamferDistance(squared=False)(torch.zeros(1, 1, 3), torch.tensor([[[3.0, 4, 0]]]))
        tensor(10.)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(chamfer_distance, **options)


class EarthMoversDistance(MeanMetric):
    """Mean of :func:`earth_movers_distance`.

    Args:
        options: those of :func:`earth_movers_distance`, and ``process_group``.

    Example:
        >>> EarthMoversDistance()(torch.zeros(1, 1, 3), torch.tensor([[[3.0, 4, 0]]]))
        tensor(5.)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(earth_movers_distance, **options)


class CorrespondenceError(MeanMetric):
    """Mean of :func:`correspondence_error`.

    Args:
        options: those of :func:`correspondence_error`, and ``process_group``.

    Example:
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0]]])
        >>> CorrespondenceError()(torch.tensor([[0, 0]]), line, torch.tensor([[0, 1]]))
        tensor(0.5000)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(correspondence_error, **options)


class EdgeRatio(MeanMetric):
    """Mean of :func:`edge_ratio`.

    Args:
        options: those of :func:`edge_ratio`, and ``process_group``.

    Example:
        >>> mesh = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> EdgeRatio(faces=torch.tensor([[0, 1, 2]]))(2 * mesh, mesh)
        tensor(1.)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(edge_ratio, **options)


class SelfIntersectionRate(MeanMetric):
    """Mean of :func:`self_intersection_rate`.

    Args:
        options: those of :func:`self_intersection_rate`, and ``process_group``.

    Example:
        >>> SelfIntersectionRate()(torch.rand(1, 3, 3), torch.tensor([[0, 1, 2]]))
        tensor(0.)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(self_intersection_rate, **options)


class VolumeChange(MeanMetric):
    """Mean of :func:`volume_change`, with its sign.

    Args:
        options: those of :func:`volume_change`, and ``process_group``.

    Example:
        >>> corner = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> VolumeChange(faces=faces)(2 * corner, corner).round(decimals=4)
        tensor(7.)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(volume_change, **options)
