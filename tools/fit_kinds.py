"""Fit what tells people, animals and other shapes apart in meshkit/transfer/_kinds.py, and measure how often it errs.

    OMP_NUM_THREADS=1 python tools/fit_kinds.py           # from training bodies; prints the numbers to put there
    OMP_NUM_THREADS=1 python tools/fit_kinds.py --check   # every shipped body, by the numbers that stand there

The means of both kinds and their common covariance, with a little shrinkage, of the shape numbers of meshes as
``meshkit.transfer`` simplifies them: people of 1000, 2000, 3445 and 6890 vertices; animals as they come and with each
face cut into four. The nearer mean in Mahalanobis distance decides, which is Fisher's linear discriminant.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
import torch
from measure_usual import mesh_sources

from meshkit.data import load_shipped
from meshkit.transfer._kinds import guess_kind, shape_numbers
from meshkit.transfer._open import open_mesh

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
    spread = sum(torch.cov(rows.T) for rows in groups) / 2 + SHRINKAGE * torch.eye(groups[0].shape[1]).double()
    whitening = torch.linalg.inv(torch.linalg.cholesky(spread))
    print("_MEANS = (\n" + "".join(f"    {_row(rows.mean(0))},\n" for rows in groups) + ")")
    print("_WHITENING = (\n" + "".join(f"    {_row(row)},\n" for row in whitening) + ")")
    for name, rows in zip(SIDE, groups, strict=True):
        far = ((rows - rows.mean(0)) @ whitening.T).norm(dim=1)
        print(f"{name}: distances from their mean to {far.max():.2f}, median {far.median():.2f}")


def _row(numbers: torch.Tensor) -> str:
    return f"({', '.join(f'{number:.3f}' for number in numbers)})"


def check(kinds: list[str]) -> None:
    draw = np.random.default_rng(1)
    for kind in kinds:
        side = SIDE[kind]
        body, split = load_shipped(kind)
        unseen = set(split.test_identities.tolist())
        count = Counter[str]()
        least, most = {"training": 9.0, "unseen": 9.0}, {"training": 0.0, "unseen": 0.0}
        for source in mesh_sources(kind, 1):
            for identity in range(len(body.identities)):
                for pose in draw.choice(len(body.poses), POSES[kind], replace=False).tolist():
                    small = open_mesh(source(identity, pose), kind).simplified(1000)
                    like = guess_kind(small.verts, small.faces)
                    score = side * like.score
                    group = "unseen" if identity in unseen else "training"
                    count[group] += 1
                    count[f"{group} wrong"] += score <= 0
                    count[f"{group} unclear"] += not like.clear
                    count[f"{group} neither"] += like.neither
                    least[group], most[group] = min(least[group], score), max(most[group], like.distance)
        for group, margin in least.items():
            wrong, unclear, neither = (count[f"{group} {word}"] for word in ("wrong", "unclear", "neither"))
            print(f"{kind}, {group}: {count[group]} meshes, {wrong} wrong, {unclear} unclear ({neither} as neither),")
            print(f"    least score {margin:.2f}, largest distance {most[group]:.2f}")


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
