"""The set-convolution extractor against its literal transcription, side by side.

The literal form sorts the rows of the full distance matrix, concatenates and convolves; see tests/literal_setconv.py.
CPU seconds are minima over repeats, the candidates in turn in one process. Memory is what one call adds to the peak of
a fresh process (Linux). Errors are those of float32 against the literal form in float64, relative to the largest value.

    OMP_NUM_THREADS=1 python benchmarks/setconv.py
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from literal_setconv import extractor_literally

from meshkit.data import load_humans
from meshkit.nn import SetConvExtractor

FORMS = ("literal", "kept", "recomputed")


def make(form: str, k: int) -> Callable[[Tensor], Tensor]:
    torch.manual_seed(0)
    extractor = SetConvExtractor(k=k, recompute=form == "recomputed")
    return (lambda points: extractor_literally(extractor, points)) if form == "literal" else extractor


def body(vertices: int) -> Tensor:
    """The shipped human, slightly roughened so that no two distances are equal."""
    points = load_humans(vertices).template[None].float()
    return points + 1e-3 * torch.randn(points.shape, generator=torch.Generator().manual_seed(1))


def forward(function: Callable[[Tensor], Tensor], points: Tensor) -> None:
    with torch.no_grad():
        function(points)


def forward_backward(function: Callable[[Tensor], Tensor], points: Tensor) -> None:
    function(points.clone().requires_grad_()).square().mean().backward()


RUNS = {"forward": forward, "forward+backward": forward_backward}


def status(key: str) -> float:
    """MiB of a line of /proc/self/status."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key + ":"))


def peak(form: str, run: str, vertices: int, k: int) -> None:
    """Print the memory that one call adds, for the parent process."""
    function, points = make(form, k), body(vertices)
    RUNS[run](function, points[:, : 4 * k])  # loads what is imported late
    Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    before = status("VmRSS")
    RUNS[run](function, points)
    print(status("VmHWM") - before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=6890, choices=(1000, 2000, 3445, 6890), help="resolution")
    parser.add_argument("--k", type=int, default=32, help="neighbours")
    parser.add_argument("--repeats", type=int, default=3, help="timed calls of each")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument("--peak", nargs=2, metavar=("FORM", "RUN"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.peak:
        return peak(*args.peak, args.vertices, args.k)

    points, functions = body(args.vertices), {form: make(form, args.k) for form in FORMS}
    with torch.no_grad():
        exact = extractor_literally(SetConvExtractor.double(make("kept", args.k)), points.double())
        errors = {form: (f(points) - exact).abs().amax() / exact.abs().amax() for form, f in functions.items()}
    print(f"{'':>18} {'':>10} {'CPU s':>7} {'faster':>7} {'MiB':>7} {'less':>7} {'error':>8}")
    for run, call in RUNS.items():
        seconds, memory = dict.fromkeys(FORMS, float("inf")), {}
        for _ in range(args.repeats):
            for form, function in functions.items():
                start = time.process_time()
                call(function, points)
                seconds[form] = min(seconds[form], time.process_time() - start)
        for form in FORMS:
            child = [sys.executable, __file__, *sys.argv[1:], "--peak", form, run]
            memory[form] = float(subprocess.run(child, capture_output=True, text=True, check=True).stdout)
            faster, less = seconds["literal"] / seconds[form], memory["literal"] / memory[form]
            print(
                f"{run:>18} {form:>10} {seconds[form]:>7.2f} {faster:>6.1f}x {memory[form]:>7.0f} {less:>6.1f}x "
                f"{errors[form]:>8.0e}"
            )


if __name__ == "__main__":
    main()
