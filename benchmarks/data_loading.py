"""Is the data ever what training waits for?

Draws batches of pairs, evaluated on the rig or taken from a pool with descriptors, and runs one training step of the
tiny preset (without the deformer) on them, all in one process. CPU milliseconds, medians.

    python benchmarks/data_loading.py --threads 1
"""

import argparse
import time
from collections.abc import Callable

import torch

from meshkit.consistency import DualReconstruction
from meshkit.data import MeshPool, PairSampler, PosePairs, human_split, load_humans, pair_loader
from meshkit.models import xdualnet


def median_ms(function: Callable[[], object], repeats: int) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(1e3 * (time.process_time() - start))
    return sorted(times)[len(times) // 2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=4, help="pairs per step")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument("--vertices", type=int, nargs="+", default=[1000, 6890], help="resolutions")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    split = human_split()
    who, how = split.train_identities, split.train_poses
    print(f"{'vertices':>8} {'from rig':>9} {'from pool':>9} {'step':>8} {'rig / step':>11} {'pool / step':>11}")
    for vertices in args.vertices:
        body = load_humans(vertices)
        pool = MeshPool.build(body, who, how, 8)
        sampler = PairSampler(6400, args.batch, stop=10_000)
        rig, pooled = (iter(pair_loader(PosePairs(body, who, how, pool=p), sampler)) for p in (None, pool))
        batch, system = next(pooled), DualReconstruction(xdualnet("tiny"), points=384)

        def step(batch=batch, system=system) -> None:
            result = system(
                batch.identity,
                batch.pose,
                identity_descriptors=batch.identity_descriptors,
                pose_descriptors=batch.pose_descriptors,
            )
            sum(x.square().mean() for x in (result.reconstruction_a, result.reconstruction_b)).backward()

        a, b, c = (median_ms(f, args.repeats) for f in (lambda it=rig: next(it), lambda it=pooled: next(it), step))
        print(f"{vertices:>8} {a:>9.1f} {b:>9.1f} {c:>8.0f} {a / c:>11.1%} {b / c:>11.1%}")


if __name__ == "__main__":
    main()
