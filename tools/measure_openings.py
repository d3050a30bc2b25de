"""Measure what missing parts and holes of the pose mesh do to a transfer, and how long their boundary loops are.

    OMP_NUM_THREADS=1 python tools/measure_openings.py
    OMP_NUM_THREADS=1 python tools/measure_openings.py --loops humans

Unseen people of 6890 vertices in unseen poses, axes given, with the weights named. The limits in
meshkit/transfer/_openings.py were chosen by what ``--loops`` measures, which takes no network: people without parts,
animals cut at every joint, and either with holes around vertices drawn at random.
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
from meshkit.transfer._kinds import surface_area
from meshkit.transfer._openings import Openings, boundary_loops, find_openings

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
HOLES = 12  # of each radius in each body of --loops


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="corenet3d-humans", choices=pretrained_names())
    parser.add_argument("--pairs", type=int, default=8)
    parser.add_argument("--loops", choices=("humans", "animals"), help="loops alone, of cuts and of holes anywhere")
    parser.add_argument("--vertices", type=int, default=6890, help="of the people of --loops")
    args = parser.parse_args()
    if args.loops:
        measure_loops(args.loops, args.vertices, args.pairs)
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
        told = sum(bool(found.doubt) for found, _ in measured)
        print(f"{name:<24} {loops}  told {told} of {len(errors)}  PMD {errors.mean():.2f} ({errors.median():.2f})")


def measure_loops(kind: str, vertices: int, count: int) -> None:
    body, split = load_shipped(kind, vertices if kind == "humans" else None)
    cuts = PARTS if kind == "humans" else {f"cut at joint {joint}": (joint,) for joint in range(1, len(body.parents))}
    missing = {name: below(body, joints) for name, joints in cuts.items()}
    missing = {name: gone for name, gone in missing.items() if gone.any()}  # not the tip of a chain, nor the whole
    rows: dict[str, list[tuple[float, float, bool]]] = {}
    draw = torch.Generator().manual_seed(0)
    for _, _, who, pose in split.test_pairs[:count].tolist():
        verts = body(torch.tensor([who]), torch.tensor([pose]))[0]
        damage = list(missing.items())
        for place in verts[torch.randint(len(verts), (HOLES,), generator=draw)]:
            away = (verts - place).norm(dim=1)
            damage += [(f"a hole of {100 * radius:.0f} cm radius", away < radius) for radius in RADII]
        for name, gone in damage:
            clean = clean_mesh(verts, body.faces[~gone[body.faces].any(1)])
            loops = boundary_loops(clean.verts, clean.faces)
            if len(loops.width) == 0:
                continue
            widest = int(loops.width.argmax())
            width = float(loops.width[widest] / surface_area(clean.verts, clean.faces).sqrt())
            told = bool(find_openings(clean.verts, clean.faces).doubt)
            rows.setdefault(name, []).append((width, float(loops.facing[widest]), told))
    for name, measured in rows.items():
        width, facing, told = torch.tensor(measured).double().unbind(1)
        low, middle, high = (float(torch.quantile(facing, share)) for share in (0.0, 0.5, 1.0))
        print(
            f"{name:<24} width {width.min():.3f} to {width.max():.3f}  "
            f"facing {low:.2f} to {high:.2f} ({middle:.2f})  told {told.mean():.0%} of {len(told)}",
            flush=True,
        )


def below(body: RiggedModel, joints: Iterable[int]) -> Tensor:
    """(V,) vertices that move with the joints or what hangs on them."""
    found, parents = set(joints), body.parents.tolist()
    for child, parent in enumerate(parents):
        found |= {child} if parent in found else set()
    return body.weights[:, sorted(found)].sum(1) > 0.5


if __name__ == "__main__":
    main()
