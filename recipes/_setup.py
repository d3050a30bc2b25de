"""What comes before training: checks of the configuration, the recorded one of a resumed run, and the data."""

from __future__ import annotations

import json
import os
from typing import Any

from _run import Run, UserError

from meshkit.data import MeshPool, PosePairs, load_shipped
from meshkit.models import GeneratorConfig


def check(cfg: Any) -> None:
    """Refuse values that make no sense before anything is written."""
    counts = ("steps", "batch", "pairs", "points", "pool", "arap_iters", "eval_pairs", "eval_every", "save_every")
    for name in counts:
        value = getattr(cfg, name, None)
        if value is not None and value < 1:
            raise UserError(f"--{name.replace('_', '-')} must be at least 1, got {value}")
    if cfg.steps is None and (cfg.minutes is None or cfg.minutes <= 0):
        raise UserError(f"give --steps, or positive --minutes, got {cfg.minutes}")
    if cfg.batch > cfg.pairs:
        raise UserError(f"--batch {cfg.batch} is more than the --pairs {cfg.pairs} of an epoch")
    if cfg.eval_pairs > 400:
        raise UserError(f"there are 400 test pairs, --eval-pairs asks for {cfg.eval_pairs}")
    for name in ("decay_from", "arap_from"):
        if not 0 <= getattr(cfg, name, 0.0) <= 1:
            raise UserError(f"--{name.replace('_', '-')} is a share of the run, got {getattr(cfg, name)}")
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise UserError("this recipe trains in one process: start it with python, not torchrun")


def resumed(cfg: Any, recorded: dict[str, Any]) -> Any:
    """The recorded configuration: a run that goes on must be the run that was begun."""
    try:
        model = GeneratorConfig.from_json(json.dumps(recorded.pop("model")))
        values = {key: value for key, value in recorded.items() if key in type(cfg).__dataclass_fields__}
        values |= {"betas": tuple(values["betas"]), "out": cfg.out, "name": cfg.name, "resume": True, "apply": None}
        values |= {"result": cfg.result, "threads": cfg.threads, "accelerator": cfg.accelerator}
        return type(cfg)(**values, model=model)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"config.json of {cfg.out / cfg.name} is no run's ({error}): choose another --name") from None


def data(cfg: Any, run: Run, workers: int) -> tuple[PosePairs, PosePairs]:
    """Training pairs, and test pairs of unseen identities in unseen poses."""
    body, split = load_shipped(cfg.data, cfg.vertices)
    listed = split.test_pairs[: cfg.eval_pairs]
    pools: dict[str, MeshPool | None] = {"train": None, "test": None}
    if cfg.model.descriptors == "wks":
        shared: dict[str, Any] = {"num_signatures": cfg.model.num_signatures, "workers": workers, "progress": True}
        who, how = listed.view(-1, 2).unbind(1)
        make = {
            "train": lambda: MeshPool.build(
                body, split.train_identities, split.train_poses, cfg.pool, seed=cfg.seed, **shared
            ),
            "test": lambda: MeshPool.of(body, who, how, **shared),
        }
        for side in pools:
            key = f"{side}, {cfg.data}, {len(body.template)} vertices, {cfg.model.num_signatures} signatures, "
            key += f"pool {cfg.pool}, seed {cfg.seed}" if side == "train" else f"{len(listed)} pairs"
            stored = run.load_tensors(f"pool_{side}.safetensors", key)
            if stored is None:
                print(f"meshes to {side} on:", flush=True)
                stored = make[side]().state_dict()
                run.save_tensors(f"pool_{side}.safetensors", stored, key)
            pools[side] = MeshPool(**stored)
    train = PosePairs(
        body,
        split.train_identities,
        split.train_poses,
        length=cfg.pairs,
        seed=cfg.seed,
        resample=cfg.resample,
        pool=pools["train"],
        ground_truth=cfg.ground_truth,
    )
    return train, PosePairs(body, split.test_identities, split.test_poses, pool=pools["test"], listed=listed)
