"""Measure what missing parts and holes of the pose mesh do to a transfer, and how long their boundary loops are.

    OMP_NUM_THREADS=1 python tools/measure_openings.py
    OMP_NUM_THREADS=1 python tools/measure_openings.py --animals

Unseen people of 6890 vertices in unseen poses, axes given, with the weights named. The limit in
meshkit/transfer/_openings.py was chosen by these loops and those of the animals, which ``--animals`` cuts at every
joint; that alone takes no network.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

import torch
from torch import Tensor

from meshkit.batching import center
from meshkit.data import RiggedModel, load_humans, load_shipped
from meshkit.io import clean_mesh
from meshkit.metrics import pmd
from meshkit.models import pretrained_names
from meshkit.transfer import PoseTransfer
from meshkit.transfer._openings import Openings, find_openings

PARTS = {  # joints of the people's rig
    "whole": (),
    "without one hand": (24,),
    "without both hands": (24, 50),
    "without one arm": (22,),
    "without the head": (71,),
    "without one foot": (5,),
    "without both feet": (5, 11),
}
RADII = (0.02, 0.04, 0.08)  # of holes around the rearmost vertex, in metres


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="corenet3d-humans", choices=pretrained_names())
    parser.add_argument("--pairs", type=int, default=8)
    parser.add_argument("--animals", action="store_true", help="the loops of animals cut at their joints")
    args = parser.parse_args()
    if args.animals:
        cut_animals()
        return
    body, split = load_humans(6890), load_shipped("humans")[1]
    rows: dict[str, list[tuple[Openings, float]]] = {}
    for who, how, other, pose in split.test_pairs[: args.pairs].tolist():
        identity = body(torch.tensor([who]), torch.tensor([how]))[0], body.faces
        transfer = PoseTransfer(identity, weights=args.weights, identity_up="+z", identity_facing="-y")
        truth, verts = body(torch.tensor([who, other]), torch.tensor([pose, pose]))
        rear = (verts - verts[verts[:, 1].argmax()]).norm(dim=1)
        gone = {name: below(body, joints) for name, joints in PARTS.items()}
        gone |= {f"a hole of {100 * radius:.0f} cm radius": rear < radius for radius in RADII}
        for name, missing in gone.items():
            mesh = verts, body.faces[~missing[body.faces].any(1)]
            result = transfer(mesh, pose_up="+z", pose_facing="-y")
            error = 1e3 * float(pmd(result.verts[None], center(truth[None]))[0])
            rows.setdefault(name, []).append((result.report.pose.openings, error))
    for name, measured in rows.items():
        longest = [found.longest for found, _ in measured]
        errors = torch.tensor([error for _, error in measured])
        loops = f"loops {min(longest):.3f} to {max(longest):.3f}"
        print(f"{name:<24} {loops}  PMD {errors.mean():.2f} ({errors.median():.2f})")


def cut_animals() -> None:
    body, split = load_shipped("animals")
    for joint in range(1, len(body.parents)):
        missing, longest = below(body, (joint,)), []
        if not missing.any():  # the tip of a chain, which moves nothing
            continue
        for who in split.test_identities[:6].tolist():
            verts = body(torch.tensor([who]), torch.tensor([0]))[0]
            clean = clean_mesh(verts, body.faces[~missing[body.faces].any(1)])
            longest.append(find_openings(clean.verts, clean.faces).longest)
        print(f"joint {joint:>2}, {int(missing.sum()):>3} vertices: loops {min(longest):.3f} to {max(longest):.3f}")


def below(body: RiggedModel, joints: Iterable[int]) -> Tensor:
    """(V,) vertices that move with the joints or what hangs on them."""
    found, parents = set(joints), body.parents.tolist()
    for child, parent in enumerate(parents):
        found |= {child} if parent in found else set()
    return body.weights[:, sorted(found)].sum(1) > 0.5


if __name__ == "__main__":
    main()
