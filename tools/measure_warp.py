"""What the warp before the residual blocks is worth: PMD of the warped mesh and of the result, one way after another.

    python tools/measure_warp.py corenet3d-humans runs/xdualnet --pairs 80

Takes names of shipped weights and folders of runs, as they are: the blocks have learnt with one of the ways alone, that
of the model's rigid_radius and poisson_weight. The pairs are the first of the fixed test pairs. With --true-matches
each vertex goes to its own place on the pose mesh, scaled to the identity's size: what a perfect matching is worth.
"""

from __future__ import annotations

import argparse

import torch
from measure_gap import network
from torch import Tensor

from meshkit.batching import center
from meshkit.data import load_shipped
from meshkit.metrics import pmd
from meshkit.models import PoseTransferGenerator

WAYS = {  # rigid_radius, poisson_weight
    "the matching's means": (None, None),
    "rigid moving least squares, radius 0.25": (0.25, None),
    "Poisson deformation, radius 0.15, weight 0.1": (0.15, 0.1),
    "Poisson deformation, radius 0.15, weight 0.2": (0.15, 0.2),
    "Poisson deformation, radius 0.15, weight 0.4": (0.15, 0.4),
}


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+", help="names of shipped weights, or folders of runs")
    parser.add_argument("--data", choices=["humans", "animals"], default="humans")
    parser.add_argument("--pairs", type=int, default=80)
    parser.add_argument("--true-matches", action="store_true", help="instead of the network's matching")
    args = parser.parse_args()
    torch.set_num_threads(1)
    body, split = load_shipped(args.data)
    told = ", matches given" if args.true_matches else ""
    for name in args.weights:
        net = network(name).eval()
        generator, warped = net.generator, list[Tensor]()
        if not isinstance(generator, PoseTransferGenerator):
            raise SystemExit(f"error: {name} has no matching to warp with")
        if args.true_matches:
            generator._warp = lambda *pair: (None, pair[2])  # type: ignore[assignment]  # bodies share a vertex order
        generator.transfer.register_forward_pre_hook(lambda _, inputs, warped=warped: warped.append(inputs[0]))
        trained = generator.rigid_radius, generator.poisson_weight
        print(f"{name}: PMD (1e-3) of the warped mesh and of the result, mean and median of {args.pairs} pairs{told}")
        for way, settings in WAYS.items():
            generator.rigid_radius, generator.poisson_weight = settings
            errors = []
            for a, p, b, q in split.test_pairs[: args.pairs].tolist():
                identity, pose, truth = body(torch.tensor([a, b, a]), torch.tensor([p, q, q]))
                posed = net(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
                both = torch.stack([warped.pop()[0], posed])
                errors.append(1e3 * pmd(both, center(truth[None]).expand_as(both)))
            mean, (middle, _) = torch.stack(errors).mean(0), torch.stack(errors).median(0)
            figures = ", ".join(f"{float(m):.2f} ({float(half):.2f})" for m, half in zip(mean, middle, strict=True))
            print(f"    {way:<50}{figures}{'    as trained' if settings == trained else ''}", flush=True)


if __name__ == "__main__":
    main()
