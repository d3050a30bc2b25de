"""One update of the weights, on one process or a part of it on each of several; and how many fit into a given time."""

from __future__ import annotations

import copy
import math
import time
import traceback
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, cast

import torch
from _graph import GraphedStep
from _run import UserError
from _settings import Settings
from _threads import Threads
from torch import Tensor, nn

from meshkit.data import PairBatch

if TYPE_CHECKING:
    from lightning_fabric import Fabric

Step = Callable[[nn.Module, PairBatch, Any, float], dict[str, Tensor]]


class Diverged(UserError):
    """A loss or its gradient is not finite."""


def refused(error: ValueError, place: str = "") -> Exception:
    """One line for what meshkit refuses, settings or meshes; any other error is the recipe's own and stays as it is."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    if innermost.f_globals.get("__name__", "").startswith("meshkit."):
        return UserError(f"{error}{place}")
    return error


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


class Trainer:
    """What one update needs: the trained module, its optimiser, and the recipe's step."""

    def __init__(self, fabric: Fabric, system: Any, optimizer: Any, cfg: Settings, step: Step, steps: int) -> None:
        self.fabric, self.system, self.optimizer = fabric, system, optimizer
        self.cfg, self.step, self.steps = cfg, step, steps
        self.graphed: GraphedStep | None = None
        # Where a GPU computes, no thread spins for another; to take them away would only slow the evaluation down.
        self.threads = Threads(stay=cfg.threads > 0 or fabric.device.type != "cpu")

    def update(self, batch: PairBatch, s: int) -> dict[str, float]:
        """One update; everything random in it follows from the seed, the step and the number of the process.

        Losses are means over the samples of all processes and accumulated batches.
        """
        torch.manual_seed(self.cfg.seed * 1_000_003 + s * 7919 + self.fabric.global_rank)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.cfg, s, self.steps)
        try:
            losses, norm = self.gradients(batch, s)
        except ValueError as error:
            raise refused(error, f" ({where(batch, s)})") from None
        # One transfer tells everything: on a GPU each waits for all that was launched.
        *values, size = torch.stack([*losses.values(), norm]).tolist()
        # Weights that turn NaN would be saved; they are looked at before, not after, the update.
        if not math.isfinite(sum(values) + size):
            raise Diverged(f"the loss is {sum(values)}, its gradient {size} {where(batch, s)}")
        self.optimizer.step()
        self.threads.look()
        if self.fabric.world_size > 1:
            values = cast(Tensor, self.fabric.all_reduce(torch.tensor(values, device=self.fabric.device))).tolist()
        return dict(zip(losses, values, strict=True)) | {"loss": sum(values)}

    def gradients(self, batch: PairBatch, s: int) -> tuple[dict[str, Tensor], Tensor]:
        """Losses, and the norm of their sum's gradient, which is left at the parameters."""
        cfg: Any = self.cfg
        solving = s >= solver_from(cfg) * self.steps  # a solver looks at its residuals
        if not cfg.graph or solving:
            self.optimizer.zero_grad()
            return self.backward(batch, s)
        if self.graphed is None:
            self.graphed = GraphedStep(self, batch, s)
        return self.graphed(batch)

    def backward(self, batch: PairBatch, s: int) -> tuple[dict[str, Tensor], Tensor]:
        """Forward and backward pass, in ``accumulate`` parts."""
        count, several = self.cfg.accumulate, self.fabric.world_size > 1
        sums: dict[str, Tensor] = {}
        for j, part in enumerate(parts(batch, count)):
            # Processes exchange gradients once, with the last part.
            with self.fabric.no_backward_sync(self.system, enabled=several and j + 1 < count):
                losses = self.step(self.system, part, self.cfg, s / self.steps)
                self.fabric.backward(torch.stack(list(losses.values())).sum() / count)
            sums = {name: sums.get(name, 0.0) + loss.detach() / count for name, loss in losses.items()}
        gradients = [p.grad for p in self.system.parameters() if p.grad is not None]
        return sums, torch.nn.utils.get_total_norm(gradients)


def where(batch: PairBatch, s: int) -> str:
    return f"at step {s} (identities {batch.identity_index.tolist()}, poses {batch.pose_index.tolist()})"


def solver_from(cfg: Any) -> float:
    """Share of the run after which a solver is part of a step; 1 for never."""
    return float(cfg.arap_from) if getattr(cfg, "arap", False) else 1.0


def seconds_of_step(trainer: Trainer, loader: Any, first: int) -> float:
    """Time of an update, from five that begin at step ``first``."""
    times = []
    for s, batch in zip(range(first, first + 5), loader, strict=False):
        start = time.perf_counter()
        trainer.update(batch.to(trainer.fabric.device), s)
        times.append(time.perf_counter() - start)
    return sorted(times[1:])[1]


def count_steps(trainer: Trainer, loader: Any) -> int:
    """Steps that fit into ``minutes``, from the speed of a few steps on copies that are thrown away.

    They are timed at the beginning of a run, and at its end if a step changes in between, at ``arap_from``; and anew
    until :class:`~_threads.Threads` has looked and left their number as it is: steps may be many times slower before.
    """
    cfg, system, optimizer = trainer.cfg, trainer.system, trainer.optimizer
    if cfg.steps is not None:
        return cfg.steps
    assert cfg.minutes is not None
    weights, moments = copy.deepcopy(system.state_dict()), copy.deepcopy(optimizer.state_dict())
    share = 1 - solver_from(cfg)
    trainer.steps, threads, settled = 1000, trainer.threads, False
    while not settled:
        number, began = threads.number, threads.began
        seconds = [seconds_of_step(trainer, loader, first) for first in ((0, 995) if share else (0,))]
        settled = threads.all == 1 or (threads.began != began and threads.number == number)
        settled = trainer.fabric.broadcast(settled)  # processes exchange gradients: all go on, or none
    system.load_state_dict(weights)
    optimizer.load_state_dict(moments)
    steps = max(1, round(cfg.minutes * 60 / ((1 - share) * seconds[0] + share * seconds[-1])))
    return int(trainer.fabric.broadcast(steps))
