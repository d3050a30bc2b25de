"""Where weights lose most: PMD over pairs of identities and poses, each seen in training or not.

    python tools/measure_gap.py corenet3d-humans runs/corenet3d --pairs 50

Takes names of shipped weights and folders of runs. Pairs are drawn anew (--seed), not the fixed test pairs; all weights
get the same ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from meshkit.batching import center
from meshkit.data import RiggedModel, load_shipped
from meshkit.metrics import pmd
from meshkit.models import PretrainedTransfer, load_generator, load_pretrained, pretrained_names


def network(name: str) -> PretrainedTransfer:
    return load_pretrained(name) if name in pretrained_names() else PretrainedTransfer(*load_generator(Path(name)))


@torch.no_grad()
def error(net: PretrainedTransfer, body: RiggedModel, identities: Tensor, poses: Tensor) -> float:
    """Mean PMD, in 1e-3, of pairs (n, 2) of identities and of poses."""
    found = []
    for (a, b), (p, q) in zip(identities, poses, strict=True):
        identity, pose, truth = body(torch.stack([a, b, a]), torch.stack([p, q, q]))
        posed = net(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
        found.append(1e3 * float(pmd(posed[None], center(truth[None]))))
    return sum(found) / len(found)


def drawn(rows: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """Pairs (count, 2) of different rows."""
    return torch.stack([rows[torch.randperm(len(rows), generator=draw)[:2]] for _ in range(count)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+", help="names of shipped weights, or folders of runs")
    parser.add_argument("--data", choices=["humans", "animals"], default="humans")
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    body, split = load_shipped(args.data)
    print(f"{'weights':<28}{'identities':<12}{'poses':<10}PMD (1e-3), mean of {args.pairs} pairs")
    for name in args.weights:
        net = network(name).eval()
        for who, identities in (("seen", split.train_identities), ("unseen", split.test_identities)):
            for how, poses in (("seen", split.train_poses), ("unseen", split.test_poses)):
                draw = torch.Generator().manual_seed(args.seed)
                pairs = drawn(identities, args.pairs, draw), drawn(poses, args.pairs, draw)
                print(f"{name:<28}{who:<12}{how:<10}{error(net, body, *pairs):.2f}", flush=True)


if __name__ == "__main__":
    main()
