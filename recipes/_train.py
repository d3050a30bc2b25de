"""The training loop that the recipes share: any generator, any named losses; checkpoints, log, curve, report.

A recipe gives two functions: ``build(cfg)`` makes the generator and the module that is trained around it;
``step(system, batch, cfg, progress)`` gives the weighted losses of one batch, ``progress`` being the share of the run
that is over.
"""

from __future__ import annotations

import copy
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from typing import Any, cast

import torch
from _report import evaluate, report
from _run import Interruption, Run, UserError, keep_freed_memory, pick_precision
from _settings import Settings
from _setup import check, data, resumed
from lightning_fabric import Fabric
from torch import Tensor, nn
from tqdm import tqdm

from meshkit.data import PairBatch, PairSampler, pair_loader

Build = Callable[[Any], tuple[nn.Module, nn.Module]]
Step = Callable[[nn.Module, PairBatch, Any, float], dict[str, Tensor]]


def learning_rate(cfg: Settings, s: int, steps: int) -> float:
    """Linear warm-up, flat, then linear to zero."""
    rise = min(1.0, (s + 1) / cfg.warmup) if cfg.warmup else 1.0
    fall = min(1.0, (1 - s / steps) / (1 - cfg.decay_from)) if cfg.decay_from < 1 else 1.0
    return cfg.lr * rise * fall


class Trainer:
    """What one update needs: the trained module, its optimiser, and the recipe's step."""

    def __init__(self, fabric: Fabric, system: Any, optimizer: Any, cfg: Settings, step: Step, steps: int) -> None:
        self.fabric, self.system, self.optimizer = fabric, system, optimizer
        self.cfg, self.step, self.steps = cfg, step, steps
        self.graphed: GraphedStep | None = None

    def update(self, batch: PairBatch, s: int) -> dict[str, float]:
        """One update; everything random in it follows from the seed and the step."""
        torch.manual_seed(self.cfg.seed * 1_000_003 + s * 7919 + self.fabric.global_rank)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.cfg, s, self.steps)
        try:
            losses, total, norm = self.gradients(batch, s)
        except ValueError as error:
            raise UserError(f"{error} {diverged(batch, s)}") from None
        # One transfer tells everything: on a GPU each waits for all that was launched.
        *values, loss, size = torch.stack([*losses.values(), total, norm]).tolist()
        # Weights that turn NaN would be saved; they are looked at before, not after, the update.
        if not math.isfinite(loss + size):
            raise UserError(f"the loss is {loss}, its gradient {size} {diverged(batch, s)}")
        self.optimizer.step()
        return dict(zip(losses, values, strict=True)) | {"loss": loss}

    def gradients(self, batch: PairBatch, s: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Losses, their sum and the norm of its gradient, which is left at the parameters."""
        cfg: Any = self.cfg
        solving = getattr(cfg, "arap", False) and s >= cfg.arap_from * self.steps  # a solver looks at its residuals
        if not cfg.graph or solving:
            self.optimizer.zero_grad()
            return self.backward(batch, s)
        if self.graphed is None:
            self.graphed = GraphedStep(self, batch, s)
        return self.graphed(batch)

    def backward(self, batch: PairBatch, s: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Forward and backward pass."""
        losses = self.step(self.system, batch, self.cfg, s / self.steps)
        total = torch.stack(list(losses.values())).sum()
        self.fabric.backward(total)
        gradients = [p.grad for p in self.system.parameters() if p.grad is not None]
        return losses, total, torch.nn.utils.get_total_norm(gradients)


class GraphedStep:
    """Forward and backward pass recorded once as a CUDA graph, and replayed for each batch.

    A step of a small network is some ten thousand short kernels, which take longer to launch than to run.
    """

    def __init__(self, trainer: Trainer, batch: PairBatch, s: int) -> None:
        self.batch = copy.deepcopy(batch)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        state = copy.deepcopy(trainer.system.state_dict())
        with torch.cuda.stream(stream):  # what is set up at first use must not be part of the graph
            for _ in range(3):
                trainer.optimizer.zero_grad()
                trainer.backward(self.batch, s)
        torch.cuda.current_stream().wait_stream(stream)
        trainer.system.load_state_dict(state)  # spectral normalisation moved on
        trainer.optimizer.zero_grad()
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.results = trainer.backward(self.batch, s)

    def __call__(self, batch: PairBatch) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Losses, their sum and the gradient's norm. Gradients are written, not added to what was there."""
        for field in fields(batch):
            value = getattr(batch, field.name)
            if value is not None:
                getattr(self.batch, field.name).copy_(value)
        self.graph.replay()
        return self.results


def diverged(batch: PairBatch, s: int) -> str:
    """Where, and what to do."""
    return (
        f"at step {s} (identities {batch.identity_index.tolist()}, poses {batch.pose_index.tolist()}): training has "
        "diverged. Begin again under another --name with a smaller --lr"
    )


def count_steps(trainer: Trainer, loader: Any) -> int:
    """Steps that fit into ``minutes``, from the speed of a few steps on copies that are thrown away.

    They are timed at the beginning and at the end of a run, between which a step may change at ``arap_from``.
    """
    cfg, system, optimizer = trainer.cfg, trainer.system, trainer.optimizer
    if cfg.steps is not None:
        return cfg.steps
    assert cfg.minutes is not None
    weights, moments = copy.deepcopy(system.state_dict()), copy.deepcopy(optimizer.state_dict())
    trainer.steps, seconds = 1000, []
    for first in (0, 995):
        times = []
        for s, batch in zip(range(first, first + 5), loader, strict=False):
            start = time.perf_counter()
            trainer.update(batch.to(trainer.fabric.device), s)
            times.append(time.perf_counter() - start)
        seconds.append(sorted(times[1:])[1])
    system.load_state_dict(weights)
    optimizer.load_state_dict(moments)
    share = 1 - getattr(cfg, "arap_from", 1.0) if getattr(cfg, "arap", False) else 0.0
    return max(1, round(cfg.minutes * 60 / ((1 - share) * seconds[0] + share * seconds[1])))


def train(cfg: Settings, build: Build, step: Step) -> None:
    """Train, evaluate, and leave pictures, meshes and figures in the run's folder."""
    keep_freed_memory()
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    check(cfg)
    run = Run(cfg.out / cfg.name, resume=cfg.resume)
    state = run.load_state() if cfg.resume else None
    if cfg.resume and state is None:
        print(f"{run.folder} has no checkpoint: starting a new run")
    recorded = run.load_json("config.json") if cfg.resume else None
    if recorded is not None:
        cfg = resumed(cfg, recorded)
    elif state is not None:
        raise UserError(f"{run.path('config.json')} is missing: without it the run cannot go on as it was begun")
    try:
        if cfg.precision == "auto":
            device = Fabric(accelerator=cfg.accelerator, devices=1).device
            cfg = replace(cfg, precision=pick_precision(device))
        fabric = Fabric(accelerator=cfg.accelerator, devices=1, precision=cast(Any, cfg.precision))
        if cfg.graph and fabric.device.type != "cuda":
            raise UserError(f"--graph records CUDA kernels, but this run is on {fabric.device}: leave it out")
        torch.manual_seed(cfg.seed)
        generator, system = build(cfg)
        train_pairs, test_pairs = (side.to(fabric.device) for side in data(cfg, run, torch.get_num_threads()))
    except (ValueError, RuntimeError) as error:
        raise UserError(str(error)) from None
    if train_pairs.pool is not None:
        cast(Any, generator).fit_descriptors(train_pairs.pool.descriptors)
    fused = fabric.device.type == "cuda"  # elsewhere the fused form rounds differently and gains little
    optimizer = torch.optim.Adam(generator.parameters(), lr=cfg.lr, betas=cfg.betas, eps=cfg.adam_eps, fused=fused)
    system, optimizer = fabric.setup(system, optimizer)

    def loader(start: int, stop: int) -> Any:
        sampler = PairSampler(cfg.pairs, cfg.batch, start=start, stop=stop, seed=cfg.seed)
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
        run.cut_log(first)
    else:
        run.cut_log(-1)

    clock = time.perf_counter()
    interruption, batches = Interruption(), iter(loader(first, steps))
    bar = tqdm(range(first, steps), total=steps, initial=first, unit="step", dynamic_ncols=True, smoothing=0.05)
    for s in bar:
        asked = time.perf_counter()
        batch = next(batches).to(fabric.device)
        waiting += time.perf_counter() - asked
        losses = trainer.update(batch, s)
        seconds, clock = seconds + time.perf_counter() - clock, time.perf_counter()
        bar.set_postfix({name: f"{value:.3g}" for name, value in losses.items()}, refresh=False)
        record: dict[str, Any] = {"step": s + 1, "seconds": round(seconds, 2), **losses}
        if (s + 1) % cfg.eval_every == 0 and s + 1 < steps:
            few = min(24, len(test_pairs))
            record["eval"] = evaluate(generator, test_pairs, fabric.device, few)
            bar.write(f"step {s + 1}: PMD {record['eval']['pmd']:.2f}e-3 on {few} unseen pairs")
        run.log(**record)
        if (s + 1) % cfg.save_every == 0 or s + 1 == steps or interruption.wanted:
            run.save_state(generator, optimizer, s + 1, {"seconds": seconds, "waiting": waiting})
        if interruption.wanted and s + 1 < steps:
            bar.close()
            print(f"interrupted after step {s + 1}, which is saved: --resume goes on from there", file=sys.stderr)
            raise SystemExit(130)
        clock = time.perf_counter()
    report(
        run,
        generator,
        test_pairs,
        fabric.device,
        {
            "steps": steps,
            "pairs_seen": steps * cfg.batch,
            "train_minutes": round(seconds / 60, 2),
            "share_of_time_waiting_for_data": round(waiting / max(seconds, 1e-9), 4),
        },
    )
