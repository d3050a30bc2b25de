"""Measure what is usual for shipped weights, on the way that ``transfer_pose`` goes, and write it into their cards.

    OMP_NUM_THREADS=1 python tools/measure_usual.py xdualnet-humans corenet3d-humans
    OMP_NUM_THREADS=1 python tools/measure_usual.py xdualnet-humans corenet3d-humans --check

Unseen bodies in unseen poses are given as any mesh is: at several vertex counts, mixed, cleaned and simplified by
``meshkit.transfer``, their axes given. Median and limit of each number go to meshkit/weights/NAME.json and NAME.md.
``--check`` draws other pairs and counts how many of them the limits in the cards flag. ``--roughness`` measures that
alone, which takes no network; the other numbers in the cards stay.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
import trimesh
from weights_page import write_card

from meshkit.data import RiggedModel, load_humans, load_shipped
from meshkit.models import PretrainedTransfer, load_pretrained, pretrained_names
from meshkit.transfer import Confidence, usual_range
from meshkit.transfer._open import open_mesh
from meshkit.transfer._prepare import prepare
from meshkit.transfer.confidence import bounds, roughness
from meshkit.transfer.transfer import run_network

WEIGHTS = Path(__file__).parents[1] / "meshkit" / "weights"
HUMANS = (1000, 2000, 3445, 6890)
PAIRS = 400
Mesh = tuple[torch.Tensor, torch.Tensor]


@torch.no_grad()
def measure(
    nets: Sequence[PretrainedTransfer], kind: str, num_verts: int, pairs: int, seed: int
) -> list[list[Confidence]]:
    """The numbers of ``pairs`` transfers by each of the networks, which must take the same descriptors."""
    measured: list[list[Confidence]] = [[] for _ in nets]
    for meshes in draw_pairs(kind, num_verts, pairs, seed):
        own, other = (
            prepare(open_mesh(mesh, role), net=nets[0], kind=kind, num_verts=num_verts, up="+z", facing="-y")
            for mesh, role in zip(meshes, ("identity", "pose"), strict=True)
        )
        for net, numbers in zip(nets, measured, strict=True):
            numbers.append(run_network(net, own, other)[1])
    return measured


def measure_roughness(kind: str, num_verts: int, pairs: int, seed: int) -> dict[str, list[float]]:
    """The roughness alone of the meshes that :func:`measure` takes."""
    found: dict[str, list[float]] = {"identity_roughness": [], "pose_roughness": []}
    for meshes in draw_pairs(kind, num_verts, pairs, seed):
        for mesh, values in zip(meshes, found.values(), strict=True):
            simple = open_mesh(mesh, kind).simplified(num_verts)
            values.append(roughness(simple.verts, simple.faces))
    return found


def draw_pairs(kind: str, num_verts: int, pairs: int, seed: int) -> Iterator[tuple[Mesh, Mesh]]:
    """Two test identities in two test poses each time; every combination of vertex counts equally often."""
    draw, split = np.random.default_rng(seed), load_shipped(kind)[1]
    sources = mesh_sources(kind, num_verts)
    for number in range(pairs):
        who = draw.choice(split.test_identities.numpy(), 2, replace=False)
        how = draw.choice(split.test_poses.numpy(), 2, replace=False)
        first, second = number % len(sources), number // len(sources) % len(sources)
        yield sources[first](int(who[0]), int(how[0])), sources[second](int(who[1]), int(how[1]))


def mesh_sources(kind: str, num_verts: int) -> list[Callable[[int, int], Mesh]]:
    """Functions of identity and pose, each giving meshes with other vertices and triangles."""
    if kind == "humans":
        return [partial(posed, load_humans(n)) for n in HUMANS if n >= num_verts]
    body = load_shipped(kind)[0]
    return [partial(posed, body), partial(quartered, body)]


def posed(body: RiggedModel, identity: int, pose: int) -> Mesh:
    return body(torch.tensor([identity]), torch.tensor([pose]))[0], body.faces


def quartered(body: RiggedModel, identity: int, pose: int) -> Mesh:
    """Every face cut into four, so that simplifying gives other triangles than the body's."""
    verts, faces = posed(body, identity, pose)
    points, triangles = trimesh.remesh.subdivide(verts.numpy(), faces.numpy())
    return torch.from_numpy(points).float(), torch.from_numpy(triangles).long()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=pretrained_names(), help="weights of one kind of bodies")
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--check", action="store_true", help="count what is flagged among other pairs; write nothing")
    parser.add_argument("--roughness", action="store_true", help="this number alone")
    args = parser.parse_args()
    nets = [load_pretrained(name) for name in args.names]
    same = {(net.card["data"], net.card["vertices"], net.config.descriptors, net.config.num_signatures) for net in nets}
    if len(same) != 1:
        raise SystemExit("error: weights measured together must be for the same bodies and take the same descriptors")
    kind, num_verts, *_ = same.pop()
    seed = 1 if args.check else 0
    if args.roughness:
        rough = measure_roughness(kind, num_verts, args.pairs, seed)
        usual = {name: bounds(name, values) for name, values in rough.items()}
        for net in nets:
            print(f"{net.card['name']}, {args.pairs} pairs")
            for key, values in rough.items():
                told(
                    key,
                    usual[key],
                    sum(v > net.card["usual"].get(key, usual[key])["limit"] for v in values),
                    args.pairs,
                )
            if not args.check:
                write_card(WEIGHTS, net.card | {"usual": net.card["usual"] | usual})
        return
    for net, numbers in zip(nets, measure(nets, kind, num_verts, args.pairs, seed), strict=True):
        usual = usual_range(numbers)
        flagged = [one.unusual(net.card["usual"]) for one in numbers]
        share = sum(map(bool, flagged)) / len(flagged)
        print(f"{net.card['name']}, {args.pairs} pairs; beyond the limits that the card had: {share:.1%} by any number")
        for key, found in usual.items():
            told(key, found, sum(key in names for names in flagged), args.pairs)
        if not args.check:
            write_card(WEIGHTS, net.card | {"usual": usual, "usual_pairs": args.pairs})


def told(name: str, found: dict[str, float], flagged: int, pairs: int) -> None:
    share = flagged / pairs
    print(f"  {name:<18} median {found['median']:.4f}  limit {found['limit']:.4f}  flagged {share:.1%}")


if __name__ == "__main__":
    main()
