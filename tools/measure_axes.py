"""Measure how often `meshkit.transfer` finds the axes of shipped bodies, and how often it doubts right and wrong ones.

    OMP_NUM_THREADS=1 python tools/measure_axes.py corenet3d-animals xdualnet-animals corenet3d-humans

Animals: every one in two poses, as it is shipped and with each face cut into four; 40 people, at several vertex counts.
Each mesh counts in all 24 orientations along the axes: turning it permutes the scores of the candidates. The limits
``DOUBT`` and ``AGREEMENT`` in meshkit/transfer/_orient.py were chosen by these meshes.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from measure_usual import Mesh, mesh_sources

from meshkit.data import load_shipped
from meshkit.models import load_pretrained, pretrained_names
from meshkit.transfer._frames import among, rotations
from meshkit.transfer._open import open_mesh
from meshkit.transfer._orient import AGREEMENT, DOUBT, RestBody, agreements, choose
from meshkit.transfer._prepare import prepare

PEOPLE = 40


def meshes(kind: str, num_verts: int, people: int) -> list[Mesh]:
    draw, (body, split), sources = np.random.default_rng(5), load_shipped(kind), mesh_sources(kind, num_verts)
    if kind == "animals":
        return [
            source(who, int(draw.integers(len(body.poses))))
            for source in sources
            for who in range(len(body.identities))
        ]
    found = []
    for number in range(people):
        unseen = number % 2 == 1
        who = int(draw.choice(split.test_identities.numpy()) if unseen else draw.integers(len(body.identities)))
        found.append(sources[number % len(sources)](who, int(draw.integers(len(body.poses)))))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=pretrained_names())
    parser.add_argument("--people", type=int, default=PEOPLE)
    args = parser.parse_args()
    turns = rotations()
    usual = torch.cat([rotations("+z", "-y"), rotations("+y", "+z")])
    favoured = among(turns, usual)
    for name in args.names:
        net = load_pretrained(name)
        kind, num_verts = net.card["data"], net.card["vertices"]
        rest = RestBody(net, kind)
        count = dict.fromkeys(("right", "right, in doubt", "wrong", "wrong, in doubt"), 0)
        given = dict.fromkeys(("right, in doubt", "wrong, in doubt"), 0)
        everything = meshes(kind, num_verts, args.people)
        for mesh in everything:
            ready = prepare(
                open_mesh(mesh, kind), net=net, kind=kind, num_verts=num_verts, up="+z", facing="-y", rest=rest
            )
            rows = agreements(
                rest, ready.simple.verts, ready.simple.faces, descriptors=ready.descriptors, candidates=turns
            )  # the first is right
            given["right, in doubt"] += bool(rows[0, 0] < AGREEMENT[kind])
            given["wrong, in doubt"] += int((rows[1:, 0] < AGREEMENT[kind]).sum())
            for turn in turns:  # a candidate turns the turned mesh as the product of both turns this one
                order = [int((turns == candidate @ turn).all(-1).all(-1).int().argmax()) for candidate in turns]
                best, clear = choose(rows[order], favoured, doubt=DOUBT[kind])
                found = "right" if order[best] == 0 else "wrong"
                count[found] += 1
                count[f"{found}, in doubt"] += not clear
        print(f"{name}: {len(everything)} meshes, each in {len(turns)} orientations: {count}")
        print(f"    axes given: right {len(everything)}, wrong {(len(turns) - 1) * len(everything)}: {given}")


if __name__ == "__main__":
    main()
