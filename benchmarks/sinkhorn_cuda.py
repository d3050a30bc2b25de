"""How fast is the Sinkhorn layer on a GPU, and how near to what the processor could do?

Square problems, cosine cost, eps 0.03, 5 iterations, the warp of 3 columns; medians of CUDA events after a warm-up,
and the peak of allocated memory above the inputs. First each Triton kernel by itself, at each precision of products;
then the layer, forward and forward + backward:

- literal: the paper's Algorithm 1 in torch operations, under autograd;
- torch, kept / streamed: blocks of torch operations, with the kernel stored or computed again at every sweep;
- Triton: the kernels, at the precision that PyTorch allows (--tf32 allows TF32, for all entries).

The roofline is the number of floating-point operations of all products over the peak given.

    python benchmarks/sinkhorn_cuda.py --peak 67
    python benchmarks/sinkhorn_cuda.py --peak 495 --tf32
"""

import argparse
import os
import statistics
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import torch
from torch import Tensor
from torch.nn.functional import normalize

from meshkit.ot import sinkhorn_warp

EPS, N_ITERS, CHANNELS = 0.03, 5, 3


def measure(step: Callable[[], object], repeats: int = 20) -> str:
    """Median milliseconds and peak megabytes."""
    try:
        for _ in range(3):
            step()
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before, times = torch.cuda.memory_allocated(), []
        for _ in range(repeats):
            start, stop = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            start.record()
            step()
            stop.record()
            stop.synchronize()
            times.append(start.elapsed_time(stop))
        peak = (torch.cuda.max_memory_allocated() - before) / 1e6
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        return f"{'out of memory':>22}"
    return f"{statistics.median(times):9.2f} ms {peak:7.0f} MB"


def literal_warp(fx: Tensor, fy: Tensor, values: Tensor) -> Tensor:
    """Algorithm 1 and the row-normalised warp, for one pair."""
    kernel = torch.exp((normalize(fx, dim=1) @ normalize(fy, dim=1).mT - 1) / EPS)
    mu, nu = fx.new_full((len(fx),), 1 / len(fx)), fy.new_full((len(fy),), 1 / len(fy))
    a = mu
    for _ in range(N_ITERS):
        b = nu / (kernel.mT @ a)
        a = mu / (kernel @ b)
    plan = a[:, None] * kernel * b
    return plan @ values / plan.sum(1, keepdim=True)


def kernels(size: int, width: int, peak: float) -> None:
    """Each kernel by itself."""
    from meshkit.ot._triton_tiles import TritonTiles
    from meshkit.ot.tiles import Factors, Reference

    x, y = (normalize(torch.randn(size, width, device="cuda"), dim=1) for _ in range(2))
    zeros, ones = x.new_zeros(size), x.new_ones(size, 1)
    reference, rank = Reference(zeros, zeros), 2 * N_ITERS - 1 + CHANNELS + 1
    factors = [Factors(x.new_ones(size, rank), x.new_ones(size, rank), reference)]
    for precision in ("ieee", "tf32x3", "tf32"):
        tiles = TritonTiles(x / EPS, y, precision=precision)
        steps: list[tuple[str, Callable[[], object], int]] = [
            ("sums", partial(tiles.log_sum_rows, zeros), width),
            ("product, 1 column", partial(tiles.apply, ones, reference), width + 1),
            ("product, 4 columns", partial(tiles.apply, ones.expand(-1, 4), reference), width + 4),
            ("gradient of features", partial(tiles.pullback, factors), 2 * (2 * width + rank)),
        ]
        for name, step, multiplications in steps:
            bound = 2e3 * size * size * multiplications / (peak * 1e12)
            print(f"{size:6} {name + ', ' + precision:<30} {measure(step)}   roofline {bound:7.2f} ms")


def layer(size: int, width: int, peak: float) -> None:
    """The warp, forward and backward."""
    fx, fy = (torch.randn(1, size, width, device="cuda", requires_grad=True) for _ in range(2))
    values = torch.randn(1, size, CHANNELS, device="cuda", requires_grad=True)
    upstream = torch.randn(1, size, CHANNELS, device="cuda")
    warp = partial(sinkhorn_warp, fx, fy, values, eps=EPS, n_iters=N_ITERS)
    entries: dict[str, tuple[str, Callable[[], Tensor]]] = {
        "literal": ("0", lambda: literal_warp(fx[0], fy[0], values[0])[None]),
        "torch, kept": ("0", partial(warp, store="keep")),
        "torch, streamed": ("0", partial(warp, store="stream")),
        "Triton": ("1", partial(warp, store="stream")),
    }

    def both(step: Callable[[], Tensor]) -> tuple[Tensor, ...]:
        return torch.autograd.grad(step(), [fx, fy, values], upstream)

    for name, (switch, step) in entries.items():
        os.environ["MESHKIT_TRITON"] = switch
        forward = measure(torch.no_grad()(step))
        print(f"{size:6} {name:<30} {forward}   with backward {measure(partial(both, step))}")
    rank = 2 * N_ITERS - 1 + CHANNELS + 1
    sweeps = (2 * N_ITERS + 1) * width + CHANNELS + 1  # half steps and the warp
    backward = (2 * N_ITERS - 1) * (width + 1) + CHANNELS + 2 * (2 * width + rank)
    bounds = [2e3 * size * size * m / (peak * 1e12) for m in (sweeps, sweeps + backward)]
    print(f"{size:6} {'roofline of Triton':<30} {bounds[0]:9.2f} ms {'':10}   with backward {bounds[1]:9.2f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[6890, 27554])
    parser.add_argument("--width", type=int, default=128, help="features per vertex")
    parser.add_argument("--peak", type=float, default=67.0, help="TFLOP/s of the processor at the precision in use")
    parser.add_argument("--tf32", action="store_true", help="let products of float32 matrices use TF32")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("This benchmark needs a CUDA device, and there is none.")
        return
    if arguments.tf32:
        torch.set_float32_matmul_precision("high")
    torch.manual_seed(0)
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, D = {arguments.width}")
    for size in arguments.sizes:
        if find_spec("triton") is not None:
            kernels(size, arguments.width, arguments.peak)
        layer(size, arguments.width, arguments.peak)


if __name__ == "__main__":
    main()
