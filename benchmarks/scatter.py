"""Ways to reduce half edges to vertices, native and torch-scatter, side by side.

CPU milliseconds at one thread, minima over repeats, in one process: forward / forward and backward. The sorted forms
(segment_reduce, CSR product) are timed with the order at hand; to find it is a line of its own. torch-scatter is left
out where it is not installed (make scatter).

    OMP_NUM_THREADS=1 python benchmarks/scatter.py
"""

import argparse
import importlib.util
import time
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from meshkit.data import load_humans
from meshkit.scatter import segment_max, segment_mean, segment_softmax, segment_sum, set_backend
from meshkit.topology import unique_edges

WIDTHS = (1, 3, 16, 128)


def milliseconds(function: Callable[[], object], repeats: int) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def raw_candidates(index: Tensor, num: int) -> dict[str, Callable[[Tensor], Tensor]]:
    """What torch itself offers."""
    order = index.argsort(stable=True)
    lengths = torch.bincount(index, minlength=num)
    start = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    matrix = torch.sparse_csr_tensor(start, order, torch.ones(len(index)), (num, len(index)))

    def expanded(src: Tensor) -> Tensor:
        return index[:, None].expand_as(src)

    def zeros(src: Tensor) -> Tensor:
        return src.new_zeros(num, src.shape[1])

    return {
        "sum: index_add": lambda src: zeros(src).index_add(0, index, src),
        "sum: scatter_add": lambda src: zeros(src).scatter_add(0, expanded(src), src),
        "sum: segment_reduce": lambda src: torch.segment_reduce(src[order], "sum", lengths=lengths),
        "sum: CSR product": lambda src: matrix @ src,
        "max: scatter_reduce": lambda src: zeros(src).scatter_reduce(0, expanded(src), src, "amax", include_self=False),
        "max: index_reduce": lambda src: zeros(src).index_reduce(0, index, src, "amax", include_self=False),
        "max: segment_reduce": lambda src: torch.segment_reduce(src[order], "max", lengths=lengths, initial=0.0),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=6890, choices=(1000, 2000, 3445, 6890), help="resolution")
    parser.add_argument("--repeats", type=int, default=20, help="timed calls of each")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message=".*(beta|[Ss]parse invariant).*")

    index = unique_edges(load_humans(args.vertices).faces).flatten()  # an edge reaches both of its ends
    num = args.vertices
    backends = ["torch"] + ["torch_scatter"] * (importlib.util.find_spec("torch_scatter") is not None)
    print(
        f"{len(index)} half edges to {num} vertices; the sort takes {milliseconds(index.argsort, args.repeats):.2f} ms"
    )
    print(f"{'channels':<32}" + "".join(f"{width:>16}" for width in WIDTHS))

    def row(name: str, function: Callable[[Tensor], Tensor]) -> None:
        cells = []
        for width in WIDTHS:
            src = torch.randn(len(index), width, generator=torch.Generator().manual_seed(0))
            leaf, weight = src.clone().requires_grad_(), torch.randn_like(function(src))
            forward = milliseconds(lambda src=src: function(src), args.repeats)
            both = milliseconds(lambda leaf=leaf, weight=weight: function(leaf).backward(weight), args.repeats)
            cells.append(f"{forward:>7.2f} /{both:>7.2f}")
        print(f"{name:<32}" + "".join(cells))

    for name, candidate in raw_candidates(index, num).items():
        row(name, candidate)
    for function in (segment_sum, segment_mean, segment_max, segment_softmax):
        for backend in backends:
            with set_backend(backend):
                row(f"{function.__name__}, {backend}", lambda src, function=function: function(src, index, num))


if __name__ == "__main__":
    main()
