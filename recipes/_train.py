"""The training loop that the recipes share: any generator, any named losses; checkpoints, log, curve, report.

A recipe gives two functions: ``build(cfg)`` makes the generator and the module that is trained around it;
``step(system, batch, cfg, progress)`` gives the weighted losses of one batch, ``progress`` being the share of the run
that is over. Each is written for one process; here any number of them work on parts of a larger batch.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, cast

import torch
from _data import data, some_descriptors, unit_of
from _fabric import connect
from _machine import keep_freed_memory
from _report import evaluate, report
from _run import Interruption, Run, UserError
from _settings import Settings
from _setup import check, initialize, resumed
from _step import Diverged, Step, Trainer, count_steps, refused
from torch import nn
from tqdm import tqdm

from meshkit.data import PairSampler, pair_loader

Build = Callable[[Any], tuple[nn.Module, nn.Module]]


def begin(cfg: Settings, run: Run) -> tuple[Settings, dict[str, Any] | None]:
    """The configuration as asked, or as recorded with the state of the run that goes on."""
    state = run.load_state() if cfg.resume else None
    recorded = run.load_json("config.json") if cfg.resume else None
    if cfg.resume and state is None and run.writes:
        print(f"{run.folder} has no checkpoint: starting a new run")
    if recorded is not None:
        return resumed(cfg, recorded, None if state is None else state["pairs_per_step"]), state
    if state is not None:
        raise UserError(f"{run.path('config.json')} is missing: without it the run cannot go on as it was begun")
    return cfg, state


def train(cfg: Settings, build: Build, step: Step) -> None:
    """Train, evaluate, and leave pictures, meshes and figures in the run's folder."""
    keep_freed_memory()
    check(cfg)
    run = Run(cfg.out / cfg.name, resume=cfg.resume)
    try:
        follow(cfg, build, step, run)
    finally:
        run.remove_if_empty()


def follow(cfg: Settings, build: Build, step: Step, run: Run) -> None:
    """What :func:`train` does once the run has its folder."""
    cfg, state = begin(cfg, run)
    try:
        fabric, cfg = connect(cfg)
    except (ValueError, RuntimeError) as error:
        raise UserError(str(error)) from None
    torch.manual_seed(cfg.seed)
    try:
        generator, system = build(cfg)
    except ValueError as error:
        raise refused(error) from None
    try:
        if cfg.init is not None and state is None:  # before the descriptors, which take longer
            initialize(generator, cfg)
        with fabric.rank_zero_first():
            needed = replace(cfg, pool=2) if cfg.steps == 0 else cfg  # evaluation alone looks at no training mesh
            train_pairs, test_pairs = data(needed, run, torch.get_num_threads(), fabric.device)
    except (ValueError, RuntimeError) as error:
        raise UserError(str(error)) from None
    descriptors = some_descriptors(train_pairs)
    if descriptors is not None and cfg.init is None:
        cast(Any, generator).fit_descriptors(descriptors)
    fused = fabric.device.type in ("cuda", "cpu")
    optimizer = torch.optim.Adam(generator.parameters(), lr=cfg.lr, betas=cfg.betas, eps=cfg.adam_eps, fused=fused)
    if cfg.compile:
        system = cast(nn.Module, torch.compile(system))
    system, optimizer = fabric.setup(system, optimizer)
    pairs_per_step = cfg.batch * cfg.accumulate * fabric.world_size

    def loader(start: int, stop: int) -> Any:
        order: dict[str, Any] = {"seed": cfg.seed, "rank": fabric.global_rank, "world_size": fabric.world_size}
        sampler = PairSampler(cfg.pairs, cfg.batch * cfg.accumulate, start=start, stop=stop, **order)
        return pair_loader(train_pairs, sampler, workers=cfg.workers)

    trainer = Trainer(fabric, system, optimizer, cfg, step, 0)
    trainer.steps = steps = count_steps(trainer, loader(0, 5))
    cfg = replace(cfg, steps=steps)
    run.save_json("config.json", json.loads(json.dumps(asdict(cfg), default=str)))
    run.save_json("model.json", asdict(cfg.model))

    first, seconds, waiting = 0, 0.0, 0.0
    if state is not None:
        generator.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        first, seconds, waiting = state["step"], state["seconds"], state["waiting"]
    run.cut_log(first if state is not None else -1)

    clock = time.perf_counter()
    interruption, batches = Interruption(fabric), iter(loader(first, steps))
    bar = tqdm(
        range(first, steps),
        total=steps,
        initial=first,
        unit="step",
        dynamic_ncols=True,
        smoothing=0.05,
        disable=not run.writes or steps == 0,
    )
    for s in bar:
        asked = time.perf_counter()
        batch = next(batches).to(fabric.device)
        waiting += time.perf_counter() - asked
        try:
            losses = trainer.update(batch, s)
        except Diverged as error:
            advice = ". Training has diverged: begin again under another --name with a smaller --lr" if s else ""
            raise UserError(f"{error}; {run.last_checkpoint()}{advice}") from None
        seconds, clock = seconds + time.perf_counter() - clock, time.perf_counter()
        bar.set_postfix({name: f"{value:.3g}" for name, value in losses.items()}, refresh=False)
        record: dict[str, Any] = {"step": s + 1, "seconds": round(seconds, 2), **losses}
        if (s + 1) % cfg.eval_every == 0 and s + 1 < steps and run.writes:
            few = min(24, len(test_pairs))
            record["eval"] = evaluate(generator, test_pairs, fabric.device, few, unit_of(cfg.data))
            if "pmd" in record["eval"]:
                bar.write(f"step {s + 1}: PMD {record['eval']['pmd']:.2f}e-3 on {few} unseen pairs")
        run.log(record)
        stop = interruption.wanted
        if (s + 1) % cfg.save_every == 0 or s + 1 == steps or stop:
            extra = {"seconds": seconds, "waiting": waiting, "pairs_per_step": pairs_per_step}
            run.save_state(generator, optimizer, s + 1, extra)
        if stop and s + 1 < steps:
            bar.close()
            if run.writes:
                print(f"interrupted after step {s + 1}, which is saved: --resume goes on from there", file=sys.stderr)
            raise SystemExit(130)
        clock = time.perf_counter()
    interruption.over()
    if run.writes:
        facts = {
            "init": cfg.init,
            "steps": steps,
            "pairs_seen": steps * pairs_per_step,
            "processes": fabric.world_size,
            "train_minutes": round(seconds / 60, 2),
            "share_of_time_waiting_for_data": round(waiting / max(seconds, 1e-9), 4),
        }
        report(run, generator, test_pairs, fabric.device, facts, kind=cfg.data)
