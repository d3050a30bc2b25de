"""Which weights a transfer is done with."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from meshkit.models import PretrainedTransfer, load_generator, load_pretrained, pretrained_names
from meshkit.models.pretrained import instead_of
from meshkit.transfer._open import OpenedMesh

__all__ = ["Choice", "Weights", "choose_weights", "load_weights"]

Weights = str | os.PathLike[str] | PretrainedTransfer
"""``"auto"``, a name of shipped weights, the folder of a training run, or a network."""


class Choice(NamedTuple):
    """The network, which it is and why."""

    net: PretrainedTransfer
    why: str


def choose_weights(
    weights: Weights, identity: Callable[[], OpenedMesh], *, device: torch.device | str | None = None
) -> Choice:
    """The network to transfer with.

    ``"auto"`` takes people's or animals' weights by the shape of the identity mesh, people's if it is not clear, and of
    those the ones with the lowest error on unseen pairs.

    Args:
        weights: see :data:`Weights`.
        identity: opens the identity mesh, if it has to be looked at.
        device: where to compute; that of the network, or the CPU, if ``None``.

    Raises:
        ValueError: no such weights, or none to choose from.
        MeshFileError: the identity mesh has to be looked at and cannot be read.
    """
    if device is not None:
        _check_device(device)
    if isinstance(weights, PretrainedTransfer):
        net = (weights if device is None else weights.to(device)).eval()
        return Choice(net, net.card.get("name", "the given network"))
    if weights != "auto":
        return Choice(load_weights(weights, device or "cpu"), os.fspath(weights))
    like = identity().likeness
    kind = "humans" if like.neither else like.kind
    fitting = [net for net in map(load_pretrained, pretrained_names()) if net.card["data"] == kind]
    if not fitting:
        raise ValueError(f"no weights for {kind} come with this installation: name some, or the folder of a run")
    best = min(fitting, key=lambda net: net.card["figures"]["pmd"])
    reason = f"as the identity's shape is that of {kind}"
    if not like.clear:
        reason = f"those for {kind}, as the identity's shape is {'of neither kind' if like.neither else 'unclear'}"
    return Choice(best.to(device or "cpu"), f"{best.card['name']}, {reason}")


def _check_device(device: torch.device | str) -> None:
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:  # torch's words for a name it does not know, or has no driver for
        raise ValueError(f"device {device} cannot be used: {(str(error).splitlines() or [''])[0]}") from error


def load_weights(weights: str | os.PathLike[str], device: torch.device | str = "cpu") -> PretrainedTransfer:
    """Shipped weights by their name, or those in the folder of a run.

    Raises:
        ValueError: there are none.
    """
    if weights in pretrained_names():
        return load_pretrained(str(weights), device=device)
    folder = Path(weights)
    if not folder.is_dir():
        raise ValueError(
            "weights must be 'auto', the folder of a run, or shipped weights by their name; "
            f"got {os.fspath(weights)!r}{instead_of(os.fspath(weights))}"
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
