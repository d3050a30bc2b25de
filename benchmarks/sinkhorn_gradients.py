"""How far the gradient modes of ``sinkhorn`` are from each other, over the number of iterations.

    python benchmarks/sinkhorn_gradients.py --plot docs/images/sinkhorn_gradients.png

The loss is the squared distance between the warp and a target, on smooth features of two samplings of a sphere, at the
paper's eps. Left: error of a mode against the exact gradient of the iterations that were run. Right: against the
gradient of converged transport.
"""

import argparse

import torch
from torch import Tensor
from torch.nn.functional import normalize

from meshkit.ot import sinkhorn

MODES = ("unroll", "implicit", "last_step")


def problem(size: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    torch.manual_seed(0)
    target = normalize(torch.randn(1, size, 3, dtype=torch.float64), dim=2)
    stretch = torch.tensor([1.0, 1.0, 1.6], dtype=torch.float64)
    source = normalize(torch.randn(1, size, 3, dtype=torch.float64) * stretch, dim=2)
    waves, phases = 3 * torch.randn(3, 64, dtype=torch.float64), 2 * torch.pi * torch.rand(64, dtype=torch.float64)
    x, y = (normalize((points @ waves + phases).cos(), dim=2) for points in (source, target))
    return x + 0.05 * torch.randn_like(x), y, target, source


def gradient(size: int, eps: float, mode: str, n_iters: int) -> tuple[Tensor, float]:
    x, y, values, wanted = problem(size)
    x.requires_grad_()
    plan = sinkhorn(x, y, eps=eps, n_iters=n_iters, grad=mode)
    loss = (plan.barycentric(values) - wanted).square().sum()
    (result,) = torch.autograd.grad(loss, x)
    return result, float(plan.residual.detach())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=400, help="points on each side")
    parser.add_argument("--eps", type=float, default=0.03)
    parser.add_argument("--iterations", type=int, nargs="+", default=[1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000])
    parser.add_argument("--plot", help="write the figure to this file")
    args = parser.parse_args()

    converged, _ = gradient(args.size, args.eps, "unroll", 2 * max(args.iterations))

    def error(value: Tensor, truth: Tensor) -> float:
        return float((value - truth).norm() / truth.norm())

    rows = []
    print("| iterations | column sums off by | " + " | ".join(f"{m}: as run, converged" for m in MODES) + " |")
    print("|---|---|" + "---|" * len(MODES))
    for n_iters in args.iterations:
        exact, residual = gradient(args.size, args.eps, "unroll", n_iters)
        values = {m: exact if m == "unroll" else gradient(args.size, args.eps, m, n_iters)[0] for m in MODES}
        errors = {m: (error(v, exact), error(v, converged)) for m, v in values.items()}
        rows.append((n_iters, residual, errors))
        cells = " | ".join(f"{a:.1e}, {b:.1e}" for a, b in errors.values())
        print(f"| {n_iters} | {residual:.1e} | {cells} |", flush=True)
    if args.plot:
        draw(rows, args.plot)


def draw(rows: list, path: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharex=True, sharey=True, constrained_layout=True)
    iterations = [row[0] for row in rows]
    titles = ("against the gradient of the iterations as run", "against the gradient of converged transport")
    for side, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        for mode, style in zip(MODES, ("C0o-", "C1s--", "C2^:"), strict=True):
            errors = [max(row[2][mode][side], 1e-12) for row in rows]
            if side == 1 or mode != "unroll":
                axis.loglog(iterations, errors, style, label=f'grad="{mode}"', markersize=4)
        axis.axvline(5, color="0.8", zorder=0)
        axis.set(title=title, xlabel="iterations", ylim=(1e-10, 10))
        axis.grid(alpha=0.3)
        axis.legend(frameon=False)
    axes[0].set_ylabel("relative error")
    axes[0].text(5.3, 3e-10, "the paper", color="0.5")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
