"""Is the data ever what training waits for?

Times drawing a batch of pairs against one training step on it (the tiny preset, without the deformer), in one process.

    python benchmarks/data_loading.py --threads 1
"""

import argparse
import time

import torch

from meshkit.consistency import DualReconstruction
from meshkit.data import PairSampler, PosePairs, human_split, load_humans, pair_loader
from meshkit.models import GeneratorConfig


def median_seconds(function, repeats: int) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return sorted(times)[len(times) // 2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=4, help="pairs per step")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls; the median counts")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument("--vertices", type=int, nargs="+", default=[1000, 6890], help="resolutions")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    split = human_split()
    print(f"{'vertices':>8} {'draw, CPU ms':>13} {'step, CPU ms':>13} {'share':>7}")
    for vertices in args.vertices:
        pairs = PosePairs(load_humans(vertices), split.train_identities, split.train_poses)
        sampler = PairSampler(len(pairs), args.batch, stop=10_000)
        batches = iter(pair_loader(pairs, sampler))
        batch = next(batches)
        generator = GeneratorConfig(extractor_widths=(16, 32, 32), k=8, widths=(256, 128, 64)).build()
        system = DualReconstruction(generator, points=384)

        def step(system=system, batch=batch) -> None:
            result = system(batch.identity, batch.pose)
            sum(x.square().mean() for x in (result.reconstruction_a, result.reconstruction_b)).backward()

        draw, train = median_seconds(lambda it=batches: next(it), args.repeats), median_seconds(step, args.repeats)
        print(f"{vertices:>8} {1e3 * draw:>13.1f} {1e3 * train:>13.1f} {draw / train:>7.1%}")


if __name__ == "__main__":
    main()
