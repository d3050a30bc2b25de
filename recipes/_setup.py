"""What comes before training: checks of the configuration, and the recorded one of a resumed run."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from _command_line import typed
from _machine import rank, world_size
from _run import UserError
from torch import nn

from meshkit.models import GeneratorConfig, load_generator, load_pretrained, pretrained_names
from meshkit.models.pretrained import instead_of


def check(cfg: Any) -> None:
    """Refuse values that make no sense before anything is written."""
    counts = (
        "steps",
        "batch",
        "accumulate",
        "devices",
        "pairs",
        "points",
        "pool",
        "arap_iters",
        "eval_pairs",
        "eval_every",
        "save_every",
    )
    if cfg.steps == 0 and cfg.init is None:
        own = f" (this run's own: --init {cfg.out / cfg.name}, under another --name)" if cfg.resume else ""
        raise UserError(f"--steps 0 evaluates weights without training: say with --init which{own}")
    for name in counts:
        value = getattr(cfg, name, None)
        least = 0 if name == "steps" else 1
        if value is not None and value < least:
            raise UserError(f"--{name.replace('_', '-')} must be at least {least}, got {value}")
    for name in ("sampled_identities", "sampled_poses", "workers", "threads", "warmup"):
        if getattr(cfg, name, 0) < 0:
            raise UserError(f"--{name.replace('_', '-')} must not be negative, got {getattr(cfg, name)}")
    if not 0 <= getattr(cfg, "bone_spread", 0.0) < 1:
        raise UserError(f"--bone-spread must lie between 0 and 1, got {cfg.bone_spread}")
    if getattr(cfg, "bone_spread", 0.0) and not cfg.sampled_identities:
        raise UserError("--bone-spread stretches sampled identities: give --sampled-identities too")
    if not cfg.name.strip():
        raise UserError("--name must not be empty: it is the run's folder below --out")
    if not 0 <= cfg.seed < 2**63:
        raise UserError(f"--seed must lie between 0 and 2^63 - 1, got {cfg.seed}")
    if cfg.steps is None and (cfg.minutes is None or not 0 < cfg.minutes < math.inf):
        raise UserError(f"give --steps, or positive --minutes, got {cfg.minutes}")
    together, processes = cfg.batch * cfg.accumulate * world_size(cfg.devices), world_size(cfg.devices)
    if together > cfg.pairs:
        times = f" x --accumulate {cfg.accumulate} x {processes} processes" if together > cfg.batch else ""
        raise UserError(f"--batch {cfg.batch}{times} is more than the --pairs {cfg.pairs} of an epoch")
    if cfg.eval_pairs > 400:
        raise UserError(f"there are 400 test pairs, --eval-pairs asks for {cfg.eval_pairs}")
    for name in ("lr", "adam_eps"):
        if not 0 <= getattr(cfg, name) < math.inf:
            raise UserError(f"--{name.replace('_', '-')} must be a number of at least 0, got {getattr(cfg, name)}")
    if not all(0 <= beta < 1 for beta in cfg.betas):
        raise UserError(f"--betas must lie in [0, 1), got {' '.join(map(str, cfg.betas))}")
    for name in (n for n in vars(cfg) if n.startswith("lambda_")):
        if not 0 <= getattr(cfg, name) < math.inf:
            raise UserError(f"--{name.replace('_', '-')} must be a weight of at least 0, got {getattr(cfg, name)}")
    for name in ("decay_from", "arap_from"):
        if not 0 <= getattr(cfg, name, 0.0) <= 1:
            raise UserError(f"--{name.replace('_', '-')} is a share of the run, got {getattr(cfg, name)}")


def given(cfg: Any) -> list[str]:
    """The settings that were typed, ``model.`` before those of the generator."""
    return typed(type(cfg), sys.argv[1:])


def value_of(cfg: Any, flag: str) -> Any:
    return attrgetter(flag)(cfg)


def resumed(cfg: Any, recorded: dict[str, Any], pairs_per_step: int | None = None) -> Any:
    """The recorded configuration: a run that goes on must be the run that was begun.

    With another number of processes than before, gradients are accumulated over more or fewer batches, so that an
    update still sees ``pairs_per_step``, and the same ones.
    """
    try:
        model = GeneratorConfig.from_json(json.dumps(recorded.pop("model")))
        values = {key: value for key, value in recorded.items() if key in type(cfg).__dataclass_fields__}
        values |= {"betas": tuple(values["betas"]), "out": cfg.out, "name": cfg.name, "resume": True, "apply": None}
        values |= {"result": cfg.result, "threads": cfg.threads, "accelerator": cfg.accelerator, "devices": cfg.devices}
        values |= {"graph": cfg.graph, "compile": cfg.compile, "workers": cfg.workers}
        # A mesh file may have gone bad since; who asks to leave it out is heard.
        values["skip_bad"] = values.get("skip_bad", False) or cfg.skip_bad
        begun = type(cfg)(**values, model=model)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"config.json of {cfg.out / cfg.name} is no run's ({error}): choose another --name") from None
    ignored = [flag for flag in given(cfg) if value_of(begun, flag) != value_of(cfg, flag)]
    if ignored and rank() == 0:
        words = ", ".join(f"--{flag.replace('_', '-')} (recorded: {value_of(begun, flag)})" for flag in ignored)
        print(f"warning: --resume goes on with the recorded settings; these do not count: {words}", file=sys.stderr)
        if "steps" in ignored or "minutes" in ignored:
            print(f"to train on, begin another run with --init {cfg.out / cfg.name}", file=sys.stderr)
    processes = world_size(cfg.devices)
    if pairs_per_step is None or pairs_per_step == begun.batch * begun.accumulate * processes:
        return begun
    batch = min(begun.batch, max(1, pairs_per_step // processes))
    if pairs_per_step % (batch * processes):
        raise UserError(
            f"the run was begun with {pairs_per_step} pairs per step, which {processes} processes cannot share evenly"
        )
    return replace(begun, batch=batch, accumulate=pairs_per_step // (batch * processes))


SHAPING = {"architecture", "extractor", "extractor_widths", "extractor_blocks", "widths", "norm", "spectral"}
SHAPING |= {"condition", "descriptors", "num_signatures", "released"}
"""Settings that decide which parameters there are, and their shapes."""


def initialize(generator: nn.Module, cfg: Any) -> None:
    """Give ``generator`` the weights called ``cfg.init``, with their statistics of descriptors."""
    try:
        if cfg.init in pretrained_names():
            loaded = load_pretrained(cfg.init)
            known, model = loaded.generator, loaded.config
        else:
            known, model = load_generator(cfg.init)
    except ValueError as error:
        if not Path(cfg.init).exists():
            instead = f"{instead_of(Path(cfg.init).name)}; or give the folder of a run"
            raise UserError(f"--init {cfg.init}: neither shipped weights nor a folder are named so{instead}") from None
        raise UserError(f"--init {cfg.init}: {str(error).splitlines()[0]}") from None
    others = differences(model, cfg.model)
    try:
        generator.load_state_dict(known.state_dict())
    except RuntimeError:
        shaping = [name for name in others if name in SHAPING]
        said = ", ".join(others[name] for name in shaping) or "another version's parameters"
        raise UserError(f"--init {cfg.init} has another network: {said}; {advise(cfg, model, shaping)}") from None
    others.pop("symmetry", None)  # of evaluation alone
    if others and rank() == 0:
        said = ", ".join(others.values())
        print(f"warning: --init {cfg.init} was trained with other --model settings: {said}", file=sys.stderr)


def differences(theirs: GeneratorConfig, ours: GeneratorConfig) -> dict[str, str]:
    """Settings that count in both and differ, in words."""
    a, b = effective(theirs), effective(ours)
    if a["architecture"] != b["architecture"]:
        a, b = ({"architecture": values["architecture"]} for values in (a, b))
    return {
        name: f"{name.replace('_', '-')} {in_words(a[name])} (here {in_words(b[name])})"
        for name in a
        if name in b and a[name] != b[name]
    }


def effective(model: GeneratorConfig) -> dict[str, Any]:
    """The settings that count beside each other, with what ``auto`` stands for."""
    values = asdict(model)
    if model.architecture != "matching":
        return {name: values[name] for name in ("architecture", "extractor_widths")}
    if model.condition == "auto":
        values["condition"] = "features" if model.descriptors == "none" else "descriptors"
    if model.descriptors == "none":
        del values["num_signatures"], values["match_size"]
    del values["extractor_blocks" if model.extractor == "setconv" else "k"]
    return values


def in_words(value: Any) -> str:
    """As the command line writes it."""
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def advise(cfg: Any, model: GeneratorConfig, shaping: list[str]) -> str:
    """What to type for a network that takes the weights of ``model``."""
    presets = getattr(sys.modules[type(cfg).__module__], "PRESETS", {})
    fitting = [name for name, preset in presets.items() if not SHAPING & set(differences(model, preset.model))]
    asked = [flag for flag in given(cfg) if flag.removeprefix("model.") in shaping]
    without = "leave out " + ", ".join(f"--{flag.replace('_', '-')}" for flag in asked) if asked else ""
    if fitting and cfg.preset not in fitting:
        return f"add --preset {fitting[0]}" + (f" and {without}" if without else "")
    if fitting and asked:
        return without
    if not shaping or "architecture" in shaping:
        return "give weights of the same network"
    values = effective(model)
    return "add " + " ".join(flag_of(name, values[name]) for name in shaping)


def flag_of(name: str, value: Any) -> str:
    name = name.replace("_", "-")
    return f"--model.{'' if value else 'no-'}{name}" if isinstance(value, bool) else f"--model.{name} {in_words(value)}"
