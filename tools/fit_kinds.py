"""Fit the discriminant that tells people from animals in meshkit/transfer/_kinds.py, and measure how often it errs.

    OMP_NUM_THREADS=1 python tools/fit_kinds.py           # from training bodies; prints the numbers to put there
    OMP_NUM_THREADS=1 python tools/fit_kinds.py --check   # every shipped body, by the numbers that stand there

Fisher's linear discriminant with a little shrinkage, on the shape numbers of meshes as ``meshkit.transfer`` simplifies
them: people of 1000, 2000, 3445 and 6890 vertices; animals as they come and with each face cut into four.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
import torch
from measure_usual import mesh_sources

from meshkit.data import load_shipped
from meshkit.transfer._kinds import _CLEAR, kind_score, shape_numbers
from meshkit.transfer._prepare import open_mesh

SHRINKAGE = 1e-3  # variance added to every number; they vary by 0.01 to 0.1 within a kind
POSES = {"humans": 1, "animals": 6}  # drawn for each body and resolution, to check
SIDE = {"humans": -1.0, "animals": 1.0}


def fit() -> None:
    draw = np.random.default_rng(0)
    groups = []
    for kind in SIDE:
        split, sources = load_shipped(kind)[1], mesh_sources(kind, 1)
        rows = []
        for number, identity in enumerate(split.train_identities.tolist() * 4):
            mesh = sources[number % len(sources)](identity, int(draw.choice(split.train_poses.numpy())))
            small = open_mesh(mesh, kind).simplified(1000)
            rows.append(shape_numbers(small.verts, small.faces))
        groups.append(torch.stack(rows))
        print(f"{kind}: {len(rows)} meshes of {len(split.train_identities)} bodies")
    people, animals = groups
    spread = (torch.cov(people.T) + torch.cov(animals.T)) / 2 + SHRINKAGE * torch.eye(people.shape[1]).double()
    gap = animals.mean(0) - people.mean(0)
    weights = torch.linalg.solve(spread, gap)
    weights = 2 * weights / (weights @ gap)  # the means come to lie at -1 and 1
    offset = -float(weights @ (animals.mean(0) + people.mean(0))) / 2
    print(f"_WEIGHTS = ({', '.join(f'{weight:.3f}' for weight in weights)})\n_OFFSET = {offset:.3f}")
    for name, rows in zip(SIDE, groups, strict=True):
        scores = rows @ weights + offset
        print(f"{name}: scores {scores.min():.2f} to {scores.max():.2f}")


def check(kinds: list[str]) -> None:
    draw = np.random.default_rng(1)
    for kind in kinds:
        side = SIDE[kind]
        body, split = load_shipped(kind)
        unseen = set(split.test_identities.tolist())
        count, least = Counter[str](), {"training": 9.0, "unseen": 9.0}
        for source in mesh_sources(kind, 1):
            for identity in range(len(body.identities)):
                for pose in draw.choice(len(body.poses), POSES[kind], replace=False).tolist():
                    small = open_mesh(source(identity, pose), kind).simplified(1000)
                    score = side * kind_score(shape_numbers(small.verts, small.faces))
                    group = "unseen" if identity in unseen else "training"
                    count[group] += 1
                    count[f"{group} wrong"] += score <= 0
                    count[f"{group} unclear"] += abs(score) < _CLEAR
                    least[group] = min(least[group], score)
        for group, margin in least.items():
            wrong, unclear = count[f"{group} wrong"], count[f"{group} unclear"]
            print(f"{kind}, {group}: {count[group]} meshes, {wrong} wrong, {unclear} unclear, least score {margin:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", nargs="*", choices=tuple(SIDE), help="measure over every shipped body (of a kind)")
    args = parser.parse_args()
    if args.check is None:
        fit()
    else:
        check(args.check or list(SIDE))


if __name__ == "__main__":
    main()
