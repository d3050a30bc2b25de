"""The ARAP deformer of a training step: a batch of shuffled bodies, each with its own faces and random handles.

    python benchmarks/arap_batch.py                           # the batch at once where its tensors are
    python benchmarks/arap_batch.py --solver splu             # mesh by mesh on the CPU
    python benchmarks/arap_batch.py --device cuda --batch 32

Prints the wall time of the deformer, forward and backward, and the share of its set-up, local-global iterations
unrolled; and on a GPU the peak memory, and the L-BFGS minimum with its implicit gradient.
"""

import argparse
import time

import torch

from meshkit.data import load_humans
from meshkit.deform import ARAPDeformer


def batch_of(size, count, device):
    """Rest shapes, targets and faces of different bodies, each with its vertices in its own order."""
    rig, generator = load_humans(size), torch.Generator().manual_seed(0)
    who = torch.arange(count) % 160
    rest, target = rig.shape(who)[0], rig(who, torch.arange(count))
    order = torch.stack([torch.randperm(size, generator=generator) for _ in range(count)])
    place = order.argsort(1)
    rows = torch.arange(count)[:, None]
    return (value.to(device) for value in (rest[rows, order], target[rows, order], place[rows[..., None], rig.faces]))


def timed(run, device, rounds):
    """Smallest wall milliseconds."""
    best = float("inf")
    for _ in range(rounds + 1):  # the first call warms up
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize()
        best = min(best, 1e3 * (time.perf_counter() - start))
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--solver", default="dense")
    parser.add_argument("--vertices", type=int, default=1000, choices=[1000, 2000, 3445, 6890])
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    device = torch.device(args.device)
    rest, target, faces = batch_of(args.vertices, args.batch, device)
    target.requires_grad_()

    def run(module, backward=True):
        deformed = module(rest, target, faces)
        if backward:
            torch.autograd.grad(deformed.square().sum(), target)

    unrolled = ARAPDeformer(max_iter=args.iterations, grad="unroll", solver=args.solver)
    shorter = ARAPDeformer(max_iter=1, grad="none", solver=args.solver, method="local_global", tol=0.0)
    implicit = ARAPDeformer(max_iter=50, solver=args.solver)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"{args.batch} x {args.vertices} vertices, solver {args.solver}, {where}")
    print(f"  set-up and one iteration {timed(lambda: run(shorter, False), device, args.rounds):.1f} ms")
    print(f"  {args.iterations} iterations {timed(lambda: run(unrolled, False), device, args.rounds):.1f} ms")
    print(f"  and their gradient {timed(lambda: run(unrolled), device, args.rounds):.1f} ms")
    print(f"  L-BFGS, 50 evaluations, implicit gradient {timed(lambda: run(implicit), device, args.rounds):.1f} ms")
    if device.type == "cuda":
        print(f"  peak memory {torch.cuda.max_memory_allocated(device) / 2**20:.0f} MB")


if __name__ == "__main__":
    main()
