"""How a run came about: the commands that repeat it, and those that it began with."""

from __future__ import annotations

import importlib
import json
import re
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from meshkit.models import GeneratorConfig, pretrained_names
from meshkit.models.pretrained import read_card

ROOT = Path(__file__).parents[1]
FACTS = ("command", "sampled", "seed", "steps", "pairs_seen", "train_minutes", "precision", "date", "machine")
"""What a card says of each run."""
SYSTEMS = {  # by recipe: a setting that no other recipe has, and what the recipe trains
    "xdualnet": ("lambda_corr", "X-DualNet (unsupervised)"),
    "cycle_baseline": ("lambda_cycle", "Cycle and self reconstruction (unsupervised)"),
    "npt": ("variant", "NPT (supervised)"),
    "corenet3d": ("norm", "3D-CoreNet (supervised)"),
}
IGNORED = {
    "preset",
    "out",
    "name",
    "resume",
    "apply",
    "result",
    "threads",
    "accelerator",
    "data",
    "seed",
    "workers",
    "save_every",
}


def runs(folder: Path, name: str) -> list[dict[str, Any]]:
    """The run in ``folder`` and those that it began with (``--init``), first one first, as ``FACTS``.

    Each command but that of a single run ends with the name ``NAME-1``, ``NAME-2``, ... that the next one begins with.

    Raises:
        OSError: a run that it began with is gone.
        ValueError: a run is not of one of the recipes.
    """
    found = list(_runs(folder))
    for number, run in enumerate(found, 1):
        if len(found) > 1:
            begun = f" --init runs/{name}-{number - 1}" if number > 1 else ""
            run["command"] += f"{begun} --name {name}-{number}"
    return found


def _runs(folder: Path) -> list[dict[str, Any]]:
    config, summary, machine = (
        json.loads((folder / f"{part}.json").read_text()) for part in ("config", "summary", "machine")
    )
    init = config.pop("init", None)
    own = {
        "command": command(config),
        "sampled": {what: config.get(f"sampled_{what}", 0) for what in ("identities", "poses")}
        | ({"bone_spread": config["bone_spread"]} if config.get("bone_spread") else {}),
        "seed": config["seed"],
        "steps": summary["steps"],
        "pairs_seen": summary["pairs_seen"],
        "train_minutes": summary["train_minutes"],
        "precision": config["precision"],
        "date": time.strftime("%Y-%m-%d", time.gmtime((folder / "summary.json").stat().st_mtime)),
        "machine": machine,
    }
    if init in pretrained_names():
        card = read_card(init)
        check_same_bodies(config, card, f"the weights {init}")
        return [*(_of_card(run) for run in (*card.get("before", ()), card)), own]
    if init is None:
        return [own]
    check_same_bodies(config, json.loads((Path(init) / "config.json").read_text()), init)
    return [*_runs(Path(init)), own]


def _of_card(run: dict[str, Any]) -> dict[str, Any]:
    """A card's facts of a run, without the names that the card gave to several."""
    command = re.sub(r"( --init \S+)? --name \S+$", "", run["command"])
    return {fact: run[fact] for fact in FACTS if fact in run} | {"command": command}


def check_same_bodies(config: dict[str, Any], before: dict[str, Any], name: str) -> None:
    """A card has one kind of bodies."""
    if config["data"] != before["data"]:
        raise ValueError(f"it was trained on {config['data']}, but began with {name}, of {before['data']}")


def recipe_of(config: dict[str, Any]) -> str:
    """The recipe that a run's settings are of.

    Raises:
        ValueError: none, or several.
    """
    found = [name for name, (own, _) in SYSTEMS.items() if own in config]
    if len(found) != 1:
        raise ValueError(f"its settings are not those of one of {', '.join(SYSTEMS)}")
    return found[0]


def command(config: dict[str, Any]) -> str:
    """The command that repeats the run: its recipe, preset, and what differs from the preset."""
    sys.path.insert(0, str(ROOT / "recipes"))
    recipe: Any = importlib.import_module(recipe_of(config))
    words = [f"python recipes/{recipe.__name__}.py --preset {config['preset']} --data {config['data']}"]
    words.append(f"--seed {config['seed']}")
    preset = json.loads(json.dumps(asdict(recipe.PRESETS[config["preset"]]), default=str))
    # A run begun before a setting existed has its default, not what the preset has made of it since.
    config = config | {"model": asdict(GeneratorConfig()) | config["model"]}
    words += differences(preset, {k: v for k, v in config.items() if k not in IGNORED}, "")
    return " ".join(words)


def differences(preset: dict[str, Any], config: dict[str, Any], prefix: str) -> list[str]:
    words = []
    for key, value in config.items():
        if value == preset.get(key) or (key == "minutes" and config.get("steps") is not None):
            continue
        flag = f"{prefix}{key.replace('_', '-')}"
        if isinstance(value, dict):
            words += differences(preset[key], value, f"{flag}.")
        elif isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--{prefix}no-{key.replace('_', '-')}")
        elif isinstance(value, list):
            words.append(f"--{flag} {' '.join(map(str, value))}")
        else:
            words.append(f"--{flag} {value}")
    return words
