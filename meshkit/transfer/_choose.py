"""Which weights a transfer is done with."""

import json
import os
from pathlib import Path
from typing import Any

import torch

from meshkit.io import clean_mesh, simplify
from meshkit.models import PretrainedTransfer, load_generator, load_pretrained, pretrained_names
from meshkit.transfer._kinds import guess_kind
from meshkit.transfer._prepare import Mesh, named, read

__all__ = ["Weights", "choose_weights"]

Weights = str | os.PathLike[str] | PretrainedTransfer
"""``"auto"``, a name of shipped weights, the folder of a training run, or a network."""


def choose_weights(
    weights: Weights, identity: Mesh, *, device: torch.device | str | None = None
) -> tuple[PretrainedTransfer, str]:
    """The network, and what there is to say of the choice.

    ``"auto"`` takes people's or animals' weights by the shape of the identity mesh, and of those the ones with the
    lowest error on unseen pairs.

    Raises:
        ValueError: no such weights, or none to choose from.
        MeshFileError: the identity mesh has to be looked at and cannot be read.
    """
    if device is not None:
        _check_device(device)
    if isinstance(weights, PretrainedTransfer):
        return (weights if device is None else weights.to(device)).eval(), weights.card.get("name", "the given network")
    if weights != "auto":
        return _load(weights, device or "cpu"), os.fspath(weights)
    name, verts, faces, _ = read(identity, "identity")
    clean = named(name, lambda: clean_mesh(verts, faces))
    small = named(name, lambda: simplify(clean.verts, clean.faces, 1000))
    kind, clear = named(name, lambda: guess_kind(small.verts, small.faces))
    fitting = [net for net in map(load_pretrained, pretrained_names()) if net.card["data"] == kind]
    if not fitting:
        raise ValueError(f"no weights for {kind} come with this installation: name some, or the folder of a run")
    best = min(fitting, key=lambda net: net.card["figures"]["pmd"])
    doubt = "" if clear else ", though not clearly: name the weights if this is wrong"
    return best.to(device or "cpu"), f"{best.card['name']}, as the identity's shape is that of {kind}{doubt}"


def _check_device(device: torch.device | str) -> None:
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:  # torch's words for a name it does not know, or has no driver for
        raise ValueError(f"device {device} cannot be used: {(str(error).splitlines() or [''])[0]}") from error


def _load(weights: str | os.PathLike[str], device: torch.device | str) -> PretrainedTransfer:
    if weights in pretrained_names():
        return load_pretrained(str(weights), device=device)
    folder = Path(weights)
    if not folder.is_dir():
        raise ValueError(
            f"weights must be 'auto', the folder of a run, or one of {', '.join(pretrained_names()) or '(none)'}; "
            f"got {os.fspath(weights)!r}"
        )
    generator, config = load_generator(folder)
    return PretrainedTransfer(generator, config, card=_facts(folder)).to(device).eval()


def _facts(folder: Path) -> dict[str, Any]:
    """What a run's configuration says of its data; nothing if it is not there."""
    path = folder / "config.json"
    if not path.is_file():
        return {}
    try:
        config = json.loads(path.read_text())
        if config["data"] not in ("humans", "animals"):
            return {}
        return {"name": folder.name, "data": config["data"]} | _vertices(config)
    except (KeyError, TypeError, ValueError):
        return {}


def _vertices(config: dict[str, Any]) -> dict[str, int]:
    return {} if config.get("vertices") is None else {"vertices": int(config["vertices"])}
