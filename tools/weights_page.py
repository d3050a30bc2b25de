"""The page of shipped weights, meshkit/weights/NAME.md, from the facts in their card, NAME.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from meshkit.io import atomic_write

UNITS = {
    "humans": ("metres", "m"),
    "animals": (
        "the unit of the shipped animals, which is arbitrary (a rest bounding box has a diagonal of 1.5 to 2.1)",
        "units",
    ),
}
MOVED = {"humans": "largest_distance_m", "animals": "largest_distance_units"}  # only humans are in metres
LIMITS = {
    "humans": (
        "Bodies and poses unlike the training set; several people in one mesh; clothes and hair that are not one "
        "surface with\nthe body;"
    ),
    "animals": (
        "Animals and poses unlike the training set, whose families the test set has not; tails as long or thick as "
        "legs, which\nare taken for legs;"
    ),
}
GIVEN = {  # the meshes that the usual numbers are measured on
    "humans": "given at 1000, 2000, 3445 and 6890 vertices",
    "animals": "given as they are shipped, and with each face cut into four",
}


def write_card(folder: Path, card: dict[str, Any]) -> None:
    """Write the card of weights and its page."""
    name = card["name"]
    for suffix, text in ((".json", json.dumps(card, indent=2) + "\n"), (".md", markdown(name, card))):
        with atomic_write(folder / f"{name}{suffix}") as path:
            path.write_text(text, encoding="utf-8")


def network(card: dict[str, Any]) -> str:
    """What the name of the system does not say of its network, as a line of the card."""
    if card["system"].startswith("3D-CoreNet") and card["model"]["extractor"] == "setconv":
        return (
            "- **Network**: with X-DualNet's extractor of set convolutions, as the recipe's; the published one, that\n"
            "  of `meshkit.models.corenet3d()`, is pointwise.\n"
        )
    return ""


def training(card: dict[str, Any]) -> str:
    """The commands of the runs, one after another, as lines of the card."""
    lines = []
    for run in (*card.get("before", ()), card):
        machine = run["machine"]
        lines.append(
            f"""- **Training{", then" if lines else ""}**: `{run["command"]}`
  ({run["steps"]} steps, {run["pairs_seen"]} pairs, {run["train_minutes"]} minutes on \
{machine["gpu"] or machine["processor"]}, {run["precision"]}, torch
  {machine["torch"]}), finished on {run["date"]}.
"""
        )
    return "".join(lines)


def markdown(name: str, card: dict[str, Any]) -> str:
    figures = card["figures"]
    rows = "\n".join(f"| {key} | {value} |" for key, value in figures.items())
    unit, short = UNITS[card["data"]]
    moved = card["rounding"][MOVED[card["data"]]]
    distance = f"{1e3 * moved:.3f} mm" if short == "m" else f"{moved:.1e} {short}"
    return f"""# {name}

{card["system"]}, preset `{card["preset"]}`, trained on the {card["data"]} that ship with meshkit.

```python
import torch
from meshkit.models import load_pretrained

net = load_pretrained("{name}")
posed = net(identity, pose, identity_faces=identity_faces, pose_faces=pose_faces)  # (V, 3)
```

- **Input**: two meshes, z up, facing -y, around {card["vertices"]} vertices each, in {unit};
  `meshkit.transfer` brings others there.
{network(card)}{training(card)}- **Split**: {card["split"]}
- **Size**: {card["parameters"]:,} parameters, those of the residual blocks stored with 16 bits. Rounding them moves no
  vertex of {card["rounding"]["pairs"]} test pairs by more than {distance}.
- **Licence**: {card["licence"]["id"]}. {card["licence"]["note"]}

## Figures

Means over the first {card["test_pairs"]} fixed test pairs, by the network as it was trained, not rounded.
Units: {card["units"]}. `copy_identity` and `copy_warped` are what the unchanged
identity and the warped mesh would score.

| figure | value |
|---|---:|
{rows}

{usual_section(card)}
## Limits

{LIMITS[card["data"]]} limbs that touch. Left and right limbs that look alike are sometimes exchanged.
"""


def usual_section(card: dict[str, Any]) -> str:
    """The section of a card's page that says what is usual."""
    rows = "\n".join(f"| {key} | {v['median']} | {v['limit']} |" for key, v in card["usual"].items())
    return f"""## What is usual

Over {card["usual_pairs"]} pairs of unseen bodies in unseen poses, {GIVEN[card["data"]]},
mixed, and made ready by `meshkit.transfer` (`tools/measure_usual.py`). A transfer is called unusual when a number lies
beyond the limit (99 of 100 of these pairs lie within); `meshkit.transfer.Confidence` says what the numbers are.

| number | median | limit |
|---|---:|---:|
{rows}
"""
