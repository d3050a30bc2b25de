"""The pose-transfer stack against its literal transcription: time, memory, equality.

Both run in one process on the same parameters and inputs, by turns; time is the CPU time of the process, the smallest
of the repeats. Peak memory is measured in a process of its own each: the high-water mark of the resident set during
one call, beyond what the model and its inputs hold.

    python benchmarks/pose_transfer_stack.py --threads 1
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from meshkit.models import PoseTransferStack

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from literal import LiteralStack

WIDTHS, COND = (1024, 512, 256), 128
FORMS = ["literal", "composed"]


def build(form: str) -> nn.Module:
    torch.manual_seed(0)
    stack = PoseTransferStack(COND, WIDTHS)
    with torch.no_grad():
        stack.narrow[-1].weight /= 30  # so that the outputs are not all at the ends of tanh
    return stack if form == "composed" else LiteralStack(COND, WIDTHS).load(stack.state_dict())


def inputs(vertices: int, batch: int) -> tuple[Tensor, Tensor]:
    torch.manual_seed(1)
    return torch.randn(batch, vertices, 3, requires_grad=True), torch.randn(batch, vertices, COND, requires_grad=True)


def forward(model: nn.Module, *given: Tensor) -> None:
    with torch.no_grad():
        model(*given)


def step(model: nn.Module, *given: Tensor) -> None:
    model.zero_grad(set_to_none=False)  # the parameters' gradients are held by both forms alike
    model(*given).square().mean().backward()


def seconds(function: Callable[[], None]) -> float:
    start = time.process_time()
    function()
    return time.process_time() - start


def resident(field: str) -> float:
    """MiB of this process's memory: ``VmRSS`` now, or ``VmHWM`` at its highest."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(field))) / 1024


def print_peak(form: str, part: str, vertices: int, batch: int) -> None:
    """The child process: warm up on few vertices, then one call."""
    model, call = build(form), {"forward": forward, "step": step}[part]
    call(model, *inputs(64, 1))
    given = inputs(vertices, batch)
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    call(model, *given)
    print(resident("VmHWM") - before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=6890)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--bf16", action="store_true", help="also time bfloat16 autocast (slow where emulated)")
    parser.add_argument("--compile", action="store_true", help="also time the composed form under inductor")
    parser.add_argument("--peak", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.peak:
        print_peak(*args.peak, args.vertices, args.batch)
        return

    models, given = {form: build(form) for form in FORMS}, inputs(args.vertices, args.batch)
    parts: dict[str, Callable[[nn.Module], None]] = {
        "forward": lambda model: forward(model, *given),
        "forward + backward": lambda model: step(model, *given),
    }
    if args.compile:
        models["compiled"] = torch.compile(build("composed"), fullgraph=True)
        parts["forward"](models["compiled"])
        parts["forward + backward"](models["compiled"])
    with torch.no_grad():
        values = [model.eval()(*given) for model in models.values()]
        error = (values[0] - values[1]).abs().max() / values[0].abs().max()
    gradients = []
    for model in models.values():
        step(model, *given)
        gradients.append([p.grad.flatten() for p in model.parameters()])
        model.train()
    # Biases before a norm have a zero gradient, up to rounding: such are measured against the largest of all.
    floor = 1e-3 * max(a.norm().item() for a in gradients[0])
    worst = max((a - b).norm().item() / max(a.norm().item(), floor) for a, b in zip(*gradients[:2], strict=True))
    print(f"N = {args.vertices}, B = {args.batch}, widths {WIDTHS}, condition {COND}, fp32, {args.threads} thread(s)")
    print(f"largest difference: output {error:.1e}, gradients {worst:.1e} of the literal form's size")

    if args.bf16:
        for name, part in list(parts.items()):

            def under_autocast(model: nn.Module, part: Callable[[nn.Module], None] = part) -> None:
                with torch.autocast("cpu", torch.bfloat16):
                    part(model)

            parts[f"{name}, bf16"] = under_autocast
    print(f"{'':<26}" + "".join(f"{form:>12}" for form in models) + f"{'ratio':>8}")
    for name, part in parts.items():
        best = dict.fromkeys(models, float("inf"))
        for _ in range(args.repeats):
            for form, model in models.items():
                best[form] = min(best[form], seconds(lambda part=part, model=model: part(model)))
        ratio = best["literal"] / best["composed"]
        print(f"{name + ' (s)':<26}" + "".join(f"{best[form]:>12.2f}" for form in models) + f"{ratio:>8.1f}")
    for name, part in (("forward", "forward"), ("forward + backward", "step")):
        peaks = []
        for form in FORMS:
            sizes = [f"--vertices={args.vertices}", f"--batch={args.batch}", f"--threads={args.threads}"]
            command = [sys.executable, __file__, "--peak", form, part, *sizes]
            peaks.append(float(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        row = "".join(f"{peak:>12.0f}" for peak in peaks)
        print(f"{name + ' (MiB)':<26}{row}{'' if len(models) == 2 else ' ' * 12}{peaks[0] / peaks[1]:>8.1f}")


if __name__ == "__main__":
    main()
