"""Reductions over edges, faces and neighbours: every row of a source belongs to one segment.

**The choice of backend.** The default is native torch: ``index_add`` for sums, ``scatter_reduce`` for maxima.
``benchmarks/scatter.py`` prints the table behind it. On one core, for the 41,328 half edges of a 6890-vertex mesh and 1
to 128 channels, ``index_add`` takes as long as torch-scatter 2.1.2, forward and backward. ``scatter_reduce`` finds
maxima as fast or faster (16 times at 16 channels) and is slower with its gradient below about 4 channels (twice at 3).
The product with a CSR matrix is the fastest forward for few channels, but its backward costs several times what it
saves, and it needs the sort that ``segment_reduce`` needs too. Native operators need no compiler, follow new releases
of torch, and pass through torch.compile. torch-scatter exists as source only; ``make scatter`` builds it and
:class:`set_backend` selects it, for whoever measures an advantage on their own device. Both compute the same numbers,
but of equal maxima (minima) torch-scatter gives the gradient to one, torch a share to each.
"""

from types import TracebackType
from typing import Literal

import torch
from torch import Tensor

__all__ = ["segment_max", "segment_mean", "segment_min", "segment_softmax", "segment_sum", "set_backend"]

Backend = Literal["torch", "torch_scatter"]
_backend: Backend = "torch"


class set_backend:
    """Choose what computes the reductions, for good or within a ``with`` block.

    Args:
        name: ``"torch"`` (the default) or ``"torch_scatter"``.

    Raises:
        ValueError: unknown backend, or torch-scatter is not installed.

    Example:
        >>> with set_backend("torch"):
        ...     segment_sum(torch.ones(3), torch.tensor([0, 0, 1]), 2)
        tensor([2., 1.])
    """

    def __init__(self, name: Backend) -> None:
        global _backend
        if name not in ("torch", "torch_scatter"):
            raise ValueError(f'backend must be "torch" or "torch_scatter", got {name!r}')
        if name == "torch_scatter":
            try:
                import torch_scatter  # noqa: F401
            except ImportError as error:
                raise ValueError(
                    f"torch-scatter cannot be imported ({error}): build it with `make scatter`, or with `pip install "
                    "--no-build-isolation torch-scatter==2.1.2` once torch is installed"
                ) from error
        self.previous, _backend = _backend, name

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        global _backend
        _backend = self.previous


def segment_sum(src: Tensor, index: Tensor, num_segments: int) -> Tensor:
    r"""Sum of the rows of each segment.

    .. math:: y_s = \sum_{e:\, i_e = s} x_e

    Args:
        src: ``(E, ...)`` floating point. Half precision is summed in float32.
        index: ``(E,)`` int64 in ``[0, num_segments)``, in any order.
        num_segments: number of segments S.

    Returns:
        ``(S, ...)`` in the dtype of ``src``; 0 for an empty segment.

    Raises:
        ValueError: ``src`` is not floating point, ``index`` is not an int64 vector of the same length, or (on the CPU)
            it holds a value out of range.

    Example:
        >>> segment_sum(torch.tensor([[1.0], [2.0], [4.0]]), torch.tensor([2, 0, 2]), 3).tolist()
        [[2.0], [0.0], [5.0]]
    """
    _check(src, index, num_segments)
    return _sum(_widened(src), index, num_segments).to(src.dtype)


def segment_mean(src: Tensor, index: Tensor, num_segments: int) -> Tensor:
    r"""Mean of the rows of each segment.

    .. math:: y_s = \frac{1}{|\{e:\, i_e = s\}|} \sum_{e:\, i_e = s} x_e

    Args:
        src: ``(E, ...)`` floating point. Half precision is summed in float32.
        index: ``(E,)`` int64 in ``[0, num_segments)``, in any order.
        num_segments: number of segments S.

    Returns:
        ``(S, ...)`` in the dtype of ``src``; 0 for an empty segment.

    Raises:
        ValueError: as :func:`segment_sum`.

    Example:
        >>> segment_mean(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([2, 0, 2]), 3).tolist()
        [2.0, 0.0, 2.5]
    """
    _check(src, index, num_segments)
    wide = _widened(src)
    count = _sum(wide.new_ones(len(index)), index, num_segments).clamp_min(1)
    return (_sum(wide, index, num_segments) / _like_rows(count, wide)).to(src.dtype)


def segment_max(src: Tensor, index: Tensor, num_segments: int) -> Tensor:
    r"""Largest value of each segment, channel by channel.

    .. math:: y_s = \max_{e:\, i_e = s} x_e

    Args:
        src: ``(E, ...)`` floating point.
        index: ``(E,)`` int64 in ``[0, num_segments)``, in any order.
        num_segments: number of segments S.

    Returns:
        ``(S, ...)`` in the dtype of ``src``; 0, without gradient, for an empty segment. Equal maxima share the
        gradient.

    Raises:
        ValueError: as :func:`segment_sum`.

    Example:
        >>> segment_max(torch.tensor([-1.0, 2.0, -4.0]), torch.tensor([2, 0, 2]), 3).tolist()
        [2.0, 0.0, -1.0]
    """
    _check(src, index, num_segments)
    return _extreme(src, index, num_segments, "amax")


def segment_min(src: Tensor, index: Tensor, num_segments: int) -> Tensor:
    r"""Smallest value of each segment, channel by channel.

    .. math:: y_s = \min_{e:\, i_e = s} x_e

    Args:
        src: ``(E, ...)`` floating point.
        index: ``(E,)`` int64 in ``[0, num_segments)``, in any order.
        num_segments: number of segments S.

    Returns:
        As :func:`segment_max`.

    Raises:
        ValueError: as :func:`segment_sum`.

    Example:
        >>> segment_min(torch.tensor([-1.0, 2.0, -4.0]), torch.tensor([2, 0, 2]), 3).tolist()
        [2.0, 0.0, -4.0]
    """
    _check(src, index, num_segments)
    return _extreme(src, index, num_segments, "amin")


def segment_softmax(src: Tensor, index: Tensor, num_segments: int) -> Tensor:
    r"""Softmax over the rows of each segment, channel by channel.

    .. math:: y_e = \frac{\exp x_e}{\sum_{e':\, i_{e'} = i_e} \exp x_{e'}}

    Args:
        src: ``(E, ...)`` floating point; exponentials and sums are those of float32 at least. A value of -inf has
            weight 0; a segment of nothing else is NaN, as in :func:`torch.softmax`.
        index: ``(E,)`` int64 in ``[0, num_segments)``, in any order.
        num_segments: number of segments S.

    Returns:
        ``(E, ...)`` in the dtype of ``src``: weights that sum to 1 in every segment.

    Raises:
        ValueError: as :func:`segment_sum`.

    Example:
        >>> segment_softmax(torch.tensor([5.0, 0.0, 5.0]), torch.tensor([1, 0, 1]), 2).tolist()
        [0.5, 1.0, 0.5]
    """
    _check(src, index, num_segments)
    wide = _widened(src)
    largest = _extreme(wide.detach(), index, num_segments, "amax")
    weight = (wide - largest.index_select(0, index)).exp()
    return (weight / _sum(weight, index, num_segments).index_select(0, index)).to(src.dtype)


def _check(src: Tensor, index: Tensor, num_segments: int) -> None:
    if not src.is_floating_point():
        raise ValueError(f"src must be floating point, got {src.dtype}; convert it, e.g. with .float()")
    if index.dtype != torch.int64 or index.dim() != 1 or src.dim() == 0 or len(src) != len(index):
        raise ValueError(
            f"index must be an int64 vector with one entry per row of src {tuple(src.shape)}, got "
            f"{index.dtype} {tuple(index.shape)}"
        )
    if num_segments < 0:
        raise ValueError(f"num_segments must not be negative, got {num_segments}")
    # Reading the values would make other devices wait, and break a compiled graph.
    if index.device.type == "cpu" and not torch.compiler.is_compiling() and len(index):
        low, high = (int(v) for v in torch.aminmax(index))
        if low < 0 or high >= num_segments:
            raise ValueError(
                f"index must lie in [0, {num_segments}), got a range of [{low}, {high}]; leave padding (-1) out first"
            )


def _widened(src: Tensor) -> Tensor:
    return src.to(torch.promote_types(src.dtype, torch.float32))


def _like_rows(vector: Tensor, rows: Tensor) -> Tensor:
    return vector.view(-1, *[1] * (rows.dim() - 1))


def _sum(src: Tensor, index: Tensor, num_segments: int) -> Tensor:
    if _backend == "torch_scatter":
        import torch_scatter

        total: Tensor = torch_scatter.scatter_sum(src, index, 0, dim_size=num_segments)
        return total
    return src.new_zeros(num_segments, *src.shape[1:]).index_add(0, index, src)


def _extreme(src: Tensor, index: Tensor, num_segments: int, reduce: Literal["amax", "amin"]) -> Tensor:
    if _backend == "torch_scatter":
        import torch_scatter

        function = torch_scatter.scatter_max if reduce == "amax" else torch_scatter.scatter_min
        value: Tensor = function(src, index, 0, dim_size=num_segments)[0]
        return value
    rows = _like_rows(index, src).expand_as(src)
    return src.new_zeros(num_segments, *src.shape[1:]).scatter_reduce(0, rows, src, reduce, include_self=False)
