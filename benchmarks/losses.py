"""Chamfer and edge losses against the forms that are usually written, and the matrix form of the correspondence loss.

CPU milliseconds of forward and backward, minima over repeats, the forms in turn in one process. Memory is what one call
adds to the peak of a fresh process (Linux).

    OMP_NUM_THREADS=1 python benchmarks/losses.py
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from meshkit.data import load_humans
from meshkit.losses import backward_correspondence_loss, chamfer_loss, edge_length_loss, edge_ratio_loss

Run = Callable[[], Tensor]


def chamfer_by_cdist(pred: Tensor, target: Tensor) -> Tensor:
    distance = torch.cdist(pred, target).square()
    return (distance.amin(2).mean(1) + distance.amin(1).mean(1)).mean()


def edge_ratio_per_mesh(verts: Tensor, reference: Tensor, faces: Tensor) -> Tensor:
    """The released form: a loop over the batch, three sides of every face, lengths of the reference in NumPy."""
    total = verts.new_zeros(())
    for mesh, rest, triangles in zip(verts, reference, faces, strict=True):
        corners, at_rest = triangles.numpy(), rest.numpy()
        for first, second in ((0, 1), (1, 2), (0, 2)):
            i, j = corners[:, first], corners[:, second]
            target = torch.from_numpy(((at_rest[i] - at_rest[j]) ** 2).sum(1) ** 0.5)
            length = (mesh[triangles[:, first]] - mesh[triangles[:, second]]).square().sum(1).sqrt()
            total = total + (length / target - 1).abs().mean()
    return total / len(verts)


def edge_length_per_mesh(verts: Tensor, faces: Tensor) -> Tensor:
    """A loop over the batch that lists the edges each time."""
    total = verts.new_zeros(())
    for mesh, triangles in zip(verts, faces, strict=True):
        sides = torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).sort(1).values
        tail, head = torch.unique(sides, dim=0).T
        total = total + (mesh[tail] - mesh[head]).square().sum(1).mean()
    return total / len(verts)


def gram_as_printed(plan: Tensor) -> Tensor:
    plan = plan / plan.sum(2, keepdim=True)
    return (plan.mT @ plan - torch.eye(plan.shape[2])).square().mean()


def cases(num: int, batch: int, gram: int) -> dict[str, dict[str, tuple[Run, Tensor]]]:
    """Of each loss, its forms: a call, and the leaf that its gradient reaches."""
    body = load_humans(num)
    meshes = body(torch.arange(batch), torch.arange(batch) * 7).detach()
    pred = (meshes + 0.01 * torch.randn(meshes.shape, generator=torch.Generator().manual_seed(0))).requires_grad_()
    one = pred[:1].detach().requires_grad_()
    other = meshes[:1].flip(1)
    each = body.faces.expand(batch, -1, -1).contiguous()
    wide = torch.rand(1, gram, 2 * gram, generator=torch.Generator().manual_seed(1)).requires_grad_()
    pose = torch.zeros(1, 2 * gram, 3)
    return {
        f"chamfer, {num} points": {
            "cdist": (partial(chamfer_by_cdist, one, other), one),
            "meshkit": (partial(chamfer_loss, one, other), one),
        },
        f"edge ratio, batch {batch}": {
            "released loop": (partial(edge_ratio_per_mesh, pred, meshes, each), pred),
            "meshkit, shared faces": (partial(edge_ratio_loss, pred, meshes, body.faces), pred),
            "meshkit, faces per mesh": (partial(edge_ratio_loss, pred, meshes, each), pred),
        },
        f"edge length, batch {batch}": {
            "loop": (partial(edge_length_per_mesh, pred, each), pred),
            "meshkit, shared faces": (partial(edge_length_loss, pred, body.faces), pred),
            "meshkit, faces per mesh": (partial(edge_length_loss, pred, each), pred),
        },
        f"correspondence, matrix form, {gram} x {2 * gram}": {
            "as printed": (partial(gram_as_printed, wide), wide),
            "meshkit": (partial(backward_correspondence_loss, wide, pose, form="matrix"), wide),
        },
    }


def status(key: str) -> float:
    """MiB of a line of /proc/self/status."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key + ":"))


def peak(small: tuple[Run, Tensor], full: tuple[Run, Tensor]) -> float:
    """MiB that one call adds, once a small one has loaded what is imported late."""
    torch.autograd.grad(small[0](), small[1])
    Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    before = status("VmRSS")
    torch.autograd.grad(full[0](), full[1])
    return status("VmHWM") - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=6890, choices=(1000, 2000, 3445, 6890), help="of each mesh")
    parser.add_argument("--batch", type=int, default=4, help="meshes of the edge losses")
    parser.add_argument("--gram", type=int, default=2000, help="rows of the plan of the matrix form")
    parser.add_argument(
        "--repeats", type=int, default=5, help="timed calls of each form; of the edge losses, five times as many"
    )
    parser.add_argument("--peak", nargs=2, type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.peak:
        case, form = args.peak
        small, full = (
            list(list(cases(*size).values())[case].values())[form]
            for size in ((1000, args.batch, 50), (args.vertices, args.batch, args.gram))
        )
        print(peak(small, full))
        return
    print(f"{'':<42} {'form':<24} {'CPU ms':>8} {'faster':>7} {'MiB':>6} {'less':>6} {'gradient differs':>17}")
    for case, (name, forms) in enumerate(cases(args.vertices, args.batch, args.gram).items()):
        seconds = dict.fromkeys(forms, float("inf"))
        gradients = {}
        for _ in range(args.repeats * (5 if name.startswith("edge") else 1)):
            for form, (call, leaf) in forms.items():
                start = time.process_time()
                (gradients[form],) = torch.autograd.grad(call(), leaf)
                seconds[form] = min(seconds[form], time.process_time() - start)
        first, *_ = forms
        memory = {}
        for index, form in enumerate(forms):
            child = [sys.executable, __file__, *sys.argv[1:], "--peak", str(case), str(index)]
            memory[form] = float(subprocess.run(child, capture_output=True, text=True, check=True).stdout)
            error = (gradients[form] - gradients[first]).norm() / gradients[first].norm()
            print(
                f"{name:<42} {form:<24} {1e3 * seconds[form]:>8.1f} {seconds[first] / seconds[form]:>6.1f}x "
                f"{memory[form]:>6.1f} {memory[first] / max(memory[form], 0.1):>5.0f}x {error:>17.0e}"
            )


if __name__ == "__main__":
    main()
