"""Pose transfer on meshes of other origin: orientation, error, refinement, false alarms.

    python benchmarks/transfer.py xdualnet-humans --pairs 40

Fixed test pairs 200 and on, the identity mesh of one resolution and the pose mesh of another where there are several,
each turned to one of the 24 orientations along the axes at random, and the pose mesh in centimetres. PMD in 1e-3 square
metres, edge ratio against the truth.
"""

import argparse
import random

import torch

from meshkit.batching import center
from meshkit.data import load_humans, load_shipped
from meshkit.metrics import edge_ratio, pmd
from meshkit.transfer import PoseTransfer
from meshkit.transfer._choose import load_weights
from meshkit.transfer._frames import rotations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="name, or folder of a run")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--refine", type=float, nargs="*", default=[0.03, 0.1, 0.3, 1.0])
    parser.add_argument("--upright", action="store_true", help="leave the meshes as they stand, axes given")
    args = parser.parse_args()
    net = load_weights(args.weights)
    body, split = load_shipped(net.card["data"])
    fine, coarse = (load_humans(n) for n in (6890, 3445)) if net.card["data"] == "humans" else (body, body)
    turns, draw = rotations(), random.Random(0)
    settings: list[bool | float] = [False, *args.refine]
    rows: dict[str, list[tuple[float, float]]] = {str(refine): [] for refine in settings}
    right = wrong_unsaid = alarms = 0
    seconds = []
    for a, p, b, q in split.test_pairs[200 : 200 + args.pairs].tolist():
        identity, truth = fine(torch.tensor([a, a]), torch.tensor([p, q]))
        pose = 100 * coarse(torch.tensor([b]), torch.tensor([q]))[0]
        own, other = (turns[0 if args.upright else draw.randrange(24)] for _ in range(2))
        axes = {"up": "+z", "facing": "-y"} if args.upright else {}
        for refine in settings:
            transfer = PoseTransfer(
                (identity @ own.T, fine.faces),
                weights=net,
                refine=refine,
                **{f"identity_{name}": axis for name, axis in axes.items()},
            )
            result = transfer((pose @ other.T, coarse.faces), **{f"pose_{name}": axis for name, axis in axes.items()})
            verts = result.verts @ other / 100
            score = 1e3 * float(pmd(verts[None], center(truth[None]))[0])
            rows[str(refine)].append((score, float(edge_ratio(verts[None], truth[None], fine.faces)[0])))
        report = result.report
        for side, turn in ((report.identity, own), (report.pose, other)):
            found = bool(torch.equal(side.rotation.cpu(), turn.T))
            right += found
            wrong_unsaid += not found and "in doubt" not in side.found
        alarms += bool(report.warnings)
        seconds.append(report.seconds)
    count = args.pairs
    print(f"{args.weights}, {count} pairs, torch {torch.__version__}, {torch.get_num_threads()} threads")
    print(f"oriented right {right} of {2 * count}, wrong and not in doubt {wrong_unsaid}")
    print(f"unusual {alarms} of {count}; {sum(seconds) / count:.1f} s for a pose mesh, identity and refinement once")
    print("refine        PMD   median   edge ratio")
    for name, values in rows.items():
        scores, edges = torch.tensor(values).unbind(1)
        print(f"{name:<8} {float(scores.mean()):8.2f} {float(scores.median()):8.2f} {float(edges.mean()):12.3f}")


if __name__ == "__main__":
    main()
