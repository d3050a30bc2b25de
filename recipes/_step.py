"""One update of the weights, on one process or a part of it on each of several; and how many fit into a given time."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any, cast

import torch
from _run import UserError
from _settings import Settings
from lightning_fabric import Fabric
from torch import Tensor, nn

from meshkit.data import PairBatch

Step = Callable[[nn.Module, PairBatch, Any, float], dict[str, Tensor]]


class Diverged(UserError):
    """A loss or its gradient is not finite."""


def learning_rate(cfg: Settings, s: int, steps: int) -> float:
    """Linear warm-up, flat, then linear to zero."""
    rise = min(1.0, (s + 1) / cfg.warmup) if cfg.warmup else 1.0
    fall = min(1.0, (1 - s / steps) / (1 - cfg.decay_from)) if cfg.decay_from < 1 else 1.0
    return cfg.lr * rise * fall


def parts(batch: PairBatch, count: int) -> list[PairBatch]:
    """The batch in ``count`` equal parts."""
    pieces: dict[str, Any] = {}
    for f in fields(batch):
        value = getattr(batch, f.name)
        pieces[f.name] = [None] * count if value is None else value.chunk(count)
    return [PairBatch(**{name: values[j] for name, values in pieces.items()}) for j in range(count)]


def train_step(
    fabric: Fabric, system: Any, optimizer: Any, batch: PairBatch, cfg: Settings, step: Step, s: int, steps: int
) -> dict[str, float]:
    """One update; everything random in it follows from the seed, the step and the number of the process.

    Losses are means over the samples of all processes and accumulated batches.
    """
    torch.manual_seed(cfg.seed * 1_000_003 + s * 7919 + fabric.global_rank)
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(cfg, s, steps)
    where = f"at step {s} (identities {batch.identity_index.tolist()}, poses {batch.pose_index.tolist()})"
    optimizer.zero_grad()
    rows = []
    for j, part in enumerate(parts(batch, cfg.accumulate)):
        # Processes exchange gradients once, with the last part.
        with fabric.no_backward_sync(system, enabled=fabric.world_size > 1 and j + 1 < cfg.accumulate):
            try:
                losses = step(system, part, cfg, s / steps)
            except ValueError as error:
                raise Diverged(f"{error} {where}") from None
            row = torch.stack(list(losses.values())) / cfg.accumulate
            fabric.backward(row.sum())
            rows.append(row.detach())
    # Weights that turn NaN would be saved; they are looked at before, not after, the update.
    norm = torch.nn.utils.get_total_norm(p.grad for p in system.parameters() if p.grad is not None)
    terms = torch.stack(rows).sum(0)
    # One transfer tells everything: on a GPU each waits for all that was launched.
    *values, loss, size = torch.cat([terms, terms.sum()[None], norm[None]]).tolist()
    if not math.isfinite(loss):
        raise Diverged(f"the loss is {loss} {where}")
    if not math.isfinite(size):
        raise Diverged(f"the loss is {loss}, its gradient {size} {where}")
    optimizer.step()
    if fabric.world_size > 1:
        values = cast(Tensor, fabric.all_reduce(torch.tensor(values, device=fabric.device))).tolist()
    return dict(zip(losses, values, strict=True)) | {"loss": sum(values)}


def count_steps(cfg: Settings, fabric: Fabric, system: Any, optimizer: Any, step: Step, loader: Any) -> int:
    """Steps that fit into ``cfg.minutes``, from the speed of a few steps on copies that are thrown away.

    They are timed at the beginning and at the end of a run, between which a step may change at ``cfg.arap_from``.
    """
    if cfg.steps is not None:
        return cfg.steps
    assert cfg.minutes is not None
    weights, moments = copy.deepcopy(system.state_dict()), copy.deepcopy(optimizer.state_dict())
    seconds = []
    for first in (0, 995):
        times = []
        for s, batch in zip(range(first, first + 5), loader, strict=False):
            start = time.perf_counter()
            train_step(fabric, system, optimizer, batch.to(fabric.device), cfg, step, s, 1000)
            times.append(time.perf_counter() - start)
        seconds.append(sorted(times[1:])[1])
    system.load_state_dict(weights)
    optimizer.load_state_dict(moments)
    share = 1 - getattr(cfg, "arap_from", 1.0) if getattr(cfg, "arap", False) else 0.0
    steps = max(1, round(cfg.minutes * 60 / ((1 - share) * seconds[0] + share * seconds[1])))
    return int(fabric.broadcast(steps))
