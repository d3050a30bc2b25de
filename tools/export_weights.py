"""Turn a finished run into weights that ship with meshkit, with their model card.

    python tools/export_weights.py runs/xdualnet-small xdualnet-humans

Writes meshkit/weights/NAME.safetensors (the residual blocks as float16, the rest as float32), NAME.json and NAME.md,
after checking that the network with rounded parameters gives the run's vertices within a thousandth of a metre, and
measuring what is usual on unseen bodies for the transfer's report (tools/measure_usual.py). The card has the command
of the run, and of those that it began with (``--init``).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from measure_usual import PAIRS, measure
from run_history import SYSTEMS, recipe_of, runs
from safetensors.torch import save_file
from weights_page import MOVED, write_card

from meshkit.batching import center
from meshkit.data import Split, load_shipped
from meshkit.io import atomic_write
from meshkit.metrics import pmd
from meshkit.models import PretrainedTransfer, load_generator
from meshkit.transfer import usual_range

ROOT = Path(__file__).parents[1]
WEIGHTS = ROOT / "meshkit" / "weights"
TOLERANCE = 1e-3  # metres
MATCHING = ("extractor.", "theta.", "phi.")
LICENCES = {
    "humans": {
        "id": "Apache-2.0",
        "note": "Trained on the shipped human bodies (CC0 1.0, distilled from the MakeHuman data).",
    },
    "animals": {
        "id": "CC-BY-SA-3.0",
        "note": "Trained on the shipped animals, which are made from art of 0 A.D. by Wildfire Games "
        "(https://wildfiregames.com), CC BY-SA 3.0 (https://creativecommons.org/licenses/by-sa/3.0/). The weights "
        "carry the same licence: credit Wildfire Games, and share what is made from the weights alike.",
    },
}


def rounded(state: dict[str, torch.Tensor], parameters: set[str]) -> dict[str, torch.Tensor]:
    """Parameters as float16, all but those that the matching rests on: it decides sharply, and they are few.

    Buffers are few as well, and some are too small for float16.
    """
    short = {key for key in parameters if not key.startswith(MATCHING)}
    return {key: (value.half() if key in short else value).contiguous() for key, value in state.items()}


@torch.no_grad()
def check(run: PretrainedTransfer, exported: PretrainedTransfer, body: Any, pairs: torch.Tensor) -> float:
    """Largest distance between vertices of the two networks over some test pairs."""
    worst = 0.0
    for a, p, b, q in pairs.tolist():
        identity, pose = body(torch.tensor([a, b]), torch.tensor([p, q]))
        sides = {"identity_faces": body.faces, "pose_faces": body.faces}
        worst = max(worst, float((run(identity, pose, **sides) - exported(identity, pose, **sides)).norm(dim=1).max()))
    return worst


@torch.no_grad()
def errors(run: PretrainedTransfer, body: Any, pairs: torch.Tensor) -> list[float]:
    """PMD of each pair, in 1e-3 square metres, as the recipes measure it."""
    found = []
    for a, p, b, q in pairs.tolist():
        identity, pose, truth = body(torch.tensor([a, b, a]), torch.tensor([p, q, q]))
        posed = run(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
        found.append(round(1e3 * float(pmd(posed[None], center(truth[None]))[0]), 4))
    return found


def trained_on(done: list[dict[str, Any]], split: Split) -> str:
    """Identities and poses of runs, and how many were made of them."""
    drawn, mixed = (sum(run.get("sampled", {}).get(what, 0) for run in done) for what in ("identities", "poses"))
    how = "drawn from their Gaussian"
    if any("bone_spread" in run.get("sampled", {}) for run in done):
        how += " with limbs stretched at random"
    return (
        f"{len(split.train_identities)} identities{f', {drawn} more {how},' if drawn else ''} and "
        f"{len(split.train_poses)} poses{f', {mixed} more put together from their limbs,' if mixed else ''}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("name", help="name of the weights, such as xdualnet-humans")
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    parser.add_argument("--usual-pairs", type=int, default=PAIRS, help="pairs for the usual range")
    args = parser.parse_args()
    try:
        generator, model = load_generator(args.run)
        config, summary = (json.loads((args.run / f"{part}.json").read_text()) for part in ("config", "summary"))
        body, split = load_shipped(config["data"], config["vertices"])
        system = SYSTEMS[recipe_of(config)][1]
        *before, last = runs(args.run, args.name)
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {args.run} is not a finished run on shipped bodies: {error}") from None
    state = rounded(generator.state_dict(), {key for key, _ in generator.named_parameters()})
    exported = model.build()
    exported.load_state_dict({key: v.float() if v.is_floating_point() else v for key, v in state.items()})
    net = PretrainedTransfer(exported, model).eval()
    pairs = split.test_pairs[:4]
    run = PretrainedTransfer(generator, model).eval()
    distance = check(run, net, body, pairs)
    if not distance < TOLERANCE:
        raise SystemExit(f"error: 16-bit parameters move vertices by {distance:.2e}, more than {TOLERANCE:g} metres")
    card = {
        "name": args.name,
        "system": system,
        "preset": config["preset"],
        **({"before": before} if before else {}),
        **last,
        "data": config["data"],
        "vertices": len(body.template),
        "split": f"{trained_on([*before, last], split)} to train on; tested on "
        f"{len(split.test_identities)} identities and {len(split.test_poses)} poses not seen in training.",
        "figures": summary["test"],
        "test_pairs": summary["test_pairs"],
        "units": summary["units"],
        "parameters": summary["parameters"],
        "licence": LICENCES[config["data"]],
        "first_pairs_pmd": errors(run, body, split.test_pairs[:8]),
        "rounding": {MOVED[config["data"]]: round(distance, 6), "pairs": len(pairs)},
        "usual": usual_range(measure([net], config["data"], len(body.template), args.usual_pairs, seed=0)[0]),
        "usual_pairs": args.usual_pairs,
        "model": asdict(model),
    }
    with atomic_write(args.out / f"{args.name}.safetensors") as path:
        save_file(state, path)
        path.chmod(0o644)  # safetensors makes files that only their owner can read
    write_card(args.out, card)
    size = (args.out / f"{args.name}.safetensors").stat().st_size / 1e6
    print(f"{args.name}: {size:.1f} MB, rounding moves vertices by at most {1e3 * distance:.3f} mm")


if __name__ == "__main__":
    main()
