"""Sinkhorn layers side by side: CPU time and memory of the warp of the paper and of its gradient.

    python benchmarks/sinkhorn.py                                  # 6890 x 6890, every entry that is installed
    python benchmarks/sinkhorn.py --rows 27554 --entries literal stream
    python benchmarks/sinkhorn.py --batch 8 --entries stream
    python benchmarks/sinkhorn.py --batch 32 --rows 128 --columns 128 --features 32 --entries literal keep stream

Every entry runs in a process of its own, the processes take turns over several rounds, and the smallest CPU time
(all threads, one by default) counts. Memory is what the peak of the process adds to its size before the first call.
Errors are relative, against the same algorithm in float64. Peers: ``literal`` is the paper's Algorithm 1 in torch under
autograd, ``compiled`` is torch.compile of it, ``log`` its usual log-domain form; POT and GeomLoss if installed (their
gradients are those of the last step, hence the error).
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable

EPS, N_ITERS = 0.03, 5
ENTRIES = ("literal", "compiled", "log", "pot", "geomloss", "keep", "stream", "keep-log", "stream-log")


def literal(x, y, values):
    """Algorithm 1 as printed, and the warp with the row-normalised plan."""
    import torch

    x, y = x / x.norm(dim=2, keepdim=True), y / y.norm(dim=2, keepdim=True)
    kernel = torch.exp(-(1 - x @ y.mT) / EPS)
    mu, nu = x.new_full((*x.shape[:2], 1), 1 / x.shape[1]), y.new_full((*y.shape[:2], 1), 1 / y.shape[1])
    a = mu
    for _ in range(N_ITERS):
        b = nu / (kernel.mT @ a)
        a = mu / (kernel @ b)
    plan = a * kernel * b.mT
    return (plan / plan.sum(2, keepdim=True)) @ values


def log_domain(x, y, values):
    import torch

    x, y = x / x.norm(dim=2, keepdim=True), y / y.norm(dim=2, keepdim=True)
    logits = x @ y.mT / EPS
    alpha = x.new_full((*x.shape[:2], 1), 1 / x.shape[1]).log()
    for _ in range(N_ITERS):
        beta = -torch.logsumexp(logits + alpha, 1, keepdim=True)
        alpha = -torch.logsumexp(logits + beta, 2, keepdim=True)
    return torch.softmax(logits + beta, 2) @ values


def pot(x, y, values):
    import ot
    import torch

    x, y = x / x.norm(dim=2, keepdim=True), y / y.norm(dim=2, keepdim=True)
    plans = []
    for p, q in zip(x, y, strict=True):
        mu, nu = p.new_full((len(p),), 1 / len(p)), q.new_full((len(q),), 1 / len(q))
        plan = ot.sinkhorn(mu, nu, 1 - p @ q.T, EPS, numItermax=N_ITERS, stopThr=0, warn=False)
        plans.append(plan / plan.sum(1, keepdim=True))
    return torch.stack(plans) @ values


def geomloss(x, y, values):
    """Potentials of SamplesLoss at the same eps (its cost is |x - y|²/2 = 1 - cos), and the plan they give."""
    import torch
    from geomloss import SamplesLoss

    x, y = x / x.norm(dim=2, keepdim=True), y / y.norm(dim=2, keepdim=True)
    solver = SamplesLoss(
        "sinkhorn", p=2, blur=EPS**0.5, diameter=2.0, scaling=0.6, debias=False, potentials=True, backend="tensorized"
    )
    f, g = solver(x[0], y[0])
    plan = torch.exp((f.view(-1, 1) + g.view(1, -1) - (1 - x[0] @ y[0].T)) / EPS)
    return ((plan / plan.sum(1, keepdim=True)) @ values[0])[None]


def entry(name: str) -> Callable:
    import torch

    from meshkit.ot import sinkhorn_warp

    if name in ("keep", "stream", "keep-log", "stream-log"):
        store, _, domain = name.partition("-")
        options = {"store": store, "domain": domain or "kernel", "eps": EPS, "n_iters": N_ITERS}
        return lambda x, y, v: sinkhorn_warp(x, y, v, **options)
    if name == "compiled":
        return torch.compile(literal, dynamic=False)
    return {"literal": literal, "log": log_domain, "pot": pot, "geomloss": geomloss}[name]


def inputs(args, dtype):
    """Unit features that vary smoothly over a sphere: tens of partners per row, so 5 iterations are not converged."""
    import torch

    torch.manual_seed(0)

    def normalise(t):
        return torch.nn.functional.normalize(t, dim=-1)

    target = normalise(torch.randn(args.batch, args.columns, 3))
    source = normalise(torch.randn(args.batch, args.rows, 3) * torch.tensor([1.0, 1.0, 1.6]))
    waves, phases = 3 * torch.randn(3, args.features), 2 * torch.pi * torch.rand(args.features)

    def features(points):
        return normalise((points @ waves + phases).cos() + 0.1 * torch.randn(*points.shape[:2], args.features))

    x, y, upstream = features(source), features(target), torch.randn(args.batch, args.rows, 3)
    return [t.to(dtype) for t in (x, y, target, upstream)]


def status(key: str) -> float:
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key))


def reset_peak() -> None:
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def measure(args, name: str, backward: bool) -> dict:
    import torch

    torch.set_num_threads(args.threads)
    x, y, values, upstream = inputs(args, torch.float32)
    leaves = [t.requires_grad_(backward) for t in (x, y)]
    warp = entry(name)

    def run():
        out = warp(x, y, values)
        return [out.detach(), *(torch.autograd.grad(out, leaves, upstream) if backward else ())]

    # Imports, compilation and the start of autograd's threads belong to no entry.
    warm = [t if name == "compiled" else t[:, :50] for t in (x, y, values, upstream)]
    out = warp(*warm[:3])
    if backward:
        torch.autograd.grad(out, warm[:2], warm[3])
    del out, warm
    before = status("VmRSS")
    reset_peak()
    results, seconds = run(), []
    for _ in range(args.repeats):
        del results
        start = time.process_time()
        results = run()
        seconds.append(time.process_time() - start)
    record = {"seconds": min(seconds), "MB": status("VmHWM") - before}
    if args.rows * args.columns * args.batch <= 10**8:
        x, y, values, upstream = inputs(args, torch.float64)
        from meshkit.ot import sinkhorn_warp

        leaves = [t.requires_grad_(backward) for t in (x, y)]
        out = sinkhorn_warp(x, y, values, eps=EPS, n_iters=N_ITERS, store="stream")
        exact = [out.detach(), *(torch.autograd.grad(out, leaves, upstream) if backward else ())]
        record["errors"] = [float((r - e).norm() / e.norm()) for r, e in zip(results, exact, strict=True)]
    return record


def child(args, name: str, backward: bool) -> dict | None:
    command = [sys.executable, __file__, "--child", name, *(["--backward"] if backward else [])]
    for option in ("rows", "columns", "features", "batch", "threads", "repeats"):
        command += [f"--{option}", str(getattr(args, option))]
    environment = os.environ | {key: str(args.threads) for key in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    if result.returncode:
        print(f"{name}: {result.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    return json.loads(result.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=6890)
    parser.add_argument("--columns", type=int, default=6890)
    parser.add_argument("--features", type=int, default=128)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3, help="timed calls per process")
    parser.add_argument("--rounds", type=int, default=2, help="processes per entry")
    parser.add_argument("--entries", nargs="+", default=list(ENTRIES), choices=ENTRIES)
    parser.add_argument("--plot", help="write a figure of the results to this file")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--backward", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(args, args.child, args.backward)))
        return
    best: dict = {}
    for _ in range(args.rounds):
        for name in args.entries:
            for backward in (False, True):
                record = child(args, name, backward)
                if record is not None:
                    known = best.setdefault((name, backward), record)
                    known["seconds"] = min(known["seconds"], record["seconds"])
                    known["MB"] = min(known["MB"], record["MB"])
    print(f"{args.batch} x {args.rows} x {args.columns}, {args.features} features, {args.threads} thread(s), CPU time")
    print(
        "| entry | forward s | MB | fwd+bwd s | MB | speed against literal | against compiled | error, gradient error |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in args.entries:
        forward, both = best.get((name, False)), best.get((name, True))
        if forward is None or both is None:
            continue
        ratios = []
        for peer in ("literal", "compiled"):
            pair = [best.get((peer, backward)) for backward in (False, True)]
            times = [f"{p['seconds'] / r['seconds']:.2f}" for p, r in zip(pair, (forward, both), strict=True) if p]
            ratios.append(" / ".join(times) or "-")
        errors = f"{both['errors'][0]:.0e}, {max(both['errors'][1:]):.0e}" if "errors" in both else "-"
        print(
            f"| {name} | {forward['seconds']:.3f} | {forward['MB']:.0f} | {both['seconds']:.3f} | {both['MB']:.0f} "
            f"| {ratios[0]} | {ratios[1]} | {errors} |"
        )
    if args.plot:
        draw([(name, best[name, False], best[name, True]) for name in args.entries if (name, True) in best], args.plot)


def draw(results: list, path: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 0.36 * len(results) + 1), sharey=True, constrained_layout=True)
    for axis, key, title in zip(axes, ("MB", "seconds"), ("added memory, MB", "CPU seconds"), strict=True):
        for offset, (label, column) in enumerate((("forward", 1), ("forward and backward", 2))):
            positions = [i + 0.38 * (offset - 0.5) for i in range(len(results))]
            bars = axis.barh(positions, [r[column][key] for r in results], 0.36, label=label, color=f"C{offset}")
            axis.bar_label(bars, fmt="%.0f" if key == "MB" else "%.2f", padding=2, fontsize=7)
        axis.set(title=title, yticks=range(len(results)), yticklabels=[r[0] for r in results])
        axis.margins(x=0.12)
    axes[0].invert_yaxis()
    axes[1].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
