"""What comes before training: checks of the configuration, and the recorded one of a resumed run."""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace
from operator import attrgetter
from typing import Any

from _machine import rank, world_size
from _run import UserError
from torch import nn

from meshkit.models import GeneratorConfig, load_generator, load_pretrained, pretrained_names


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
    for name in counts:
        value = getattr(cfg, name, None)
        if value is not None and value < 1:
            raise UserError(f"--{name.replace('_', '-')} must be at least 1, got {value}")
    if cfg.steps is None and (cfg.minutes is None or cfg.minutes <= 0):
        raise UserError(f"give --steps, or positive --minutes, got {cfg.minutes}")
    together, processes = cfg.batch * cfg.accumulate * world_size(cfg.devices), world_size(cfg.devices)
    if together > cfg.pairs:
        times = f" x --accumulate {cfg.accumulate} x {processes} processes" if together > cfg.batch else ""
        raise UserError(f"--batch {cfg.batch}{times} is more than the --pairs {cfg.pairs} of an epoch")
    if cfg.eval_pairs > 400:
        raise UserError(f"there are 400 test pairs, --eval-pairs asks for {cfg.eval_pairs}")
    for name in ("decay_from", "arap_from"):
        if not 0 <= getattr(cfg, name, 0.0) <= 1:
            raise UserError(f"--{name.replace('_', '-')} is a share of the run, got {getattr(cfg, name)}")


def given(cfg: Any) -> list[str]:
    """The flags whose values are not those of the preset, ``model.`` before those of the generator."""
    presets = getattr(sys.modules[type(cfg).__module__], "PRESETS", {})
    if cfg.preset not in presets:
        return []
    usual = presets[cfg.preset]
    names = [*(f.name for f in fields(cfg) if f.name != "model"), *(f"model.{f.name}" for f in fields(cfg.model))]
    # A recipe may set the architecture itself. A preset differs from itself in nothing: the command line is asked.
    differ = [name for name in names if name != "model.architecture" and value_of(cfg, name) != value_of(usual, name)]
    return [*(["preset"] if any(word.startswith("--preset") for word in sys.argv[1:]) else []), *differ]


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
        begun = type(cfg)(**values, model=model)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"config.json of {cfg.out / cfg.name} is no run's ({error}): choose another --name") from None
    ignored = [flag for flag in given(cfg) if value_of(begun, flag) != value_of(cfg, flag)]
    if ignored and rank() == 0:
        words = ", ".join(f"--{flag.replace('_', '-')} (recorded: {value_of(begun, flag)})" for flag in ignored)
        print(f"warning: --resume goes on with the recorded settings; these do not count: {words}", file=sys.stderr)
    processes = world_size(cfg.devices)
    if pairs_per_step is None or pairs_per_step == begun.batch * begun.accumulate * processes:
        return begun
    batch = min(begun.batch, max(1, pairs_per_step // processes))
    if pairs_per_step % (batch * processes):
        raise UserError(
            f"the run was begun with {pairs_per_step} pairs per step, which {processes} processes cannot share evenly"
        )
    return replace(begun, batch=batch, accumulate=pairs_per_step // (batch * processes))


def initialize(generator: nn.Module, init: str) -> None:
    """Give ``generator`` the weights called ``init``, with their statistics of descriptors."""
    try:
        known = load_pretrained(init).generator if init in pretrained_names() else load_generator(init)[0]
        generator.load_state_dict(known.state_dict())
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        advice = f"give one of {', '.join(pretrained_names())}, or the folder of a run with the same --model settings"
        raise UserError(f"--init {init}: {reason}; {advice}") from None
