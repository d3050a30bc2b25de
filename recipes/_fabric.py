"""Connecting the processes of a run: one by default, several with ``--devices`` or under torchrun."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from _machine import pick_precision, world_size
from _run import UserError
from _settings import Settings

if TYPE_CHECKING:
    from lightning_fabric import Fabric

S = TypeVar("S", bound=Settings)


def connect(cfg: S) -> tuple[Fabric, S]:
    """Fabric with its processes started, and the configuration with the precision that was picked."""
    from lightning_fabric import Fabric  # slow: --help, --apply and most refusals do without

    if cfg.threads:  # precisions are timed with so many
        torch.set_num_threads(cfg.threads)
    if cfg.precision == "auto":
        cfg = replace(cfg, precision=pick_precision(Fabric(accelerator=cfg.accelerator, **shape(cfg)).device))
    fabric = Fabric(accelerator=cfg.accelerator, precision=cast(Any, cfg.precision), **shape(cfg))
    fabric.launch()
    if cfg.threads:  # again, as the launcher of several processes has shared out the cores
        torch.set_num_threads(cfg.threads)
    if fabric.world_size > 1:
        share = fabric.all_reduce(torch.tensor(float(cfg.precision == "bf16-mixed"), device=fabric.device))
        if cast(torch.Tensor, share) not in (0, 1):
            raise UserError("the processes do not agree on whether bfloat16 is faster: choose with --precision")
    if cfg.graph and fabric.device.type != "cuda":
        raise UserError(f"--graph records CUDA kernels, but this run is on {fabric.device}: leave it out")
    if cfg.graph and cfg.data not in ("humans", "animals"):
        raise UserError("--graph needs meshes of one size, those of --data humans or animals: leave it out")
    if cfg.workers and fabric.device.type != "cpu" and cfg.data in ("humans", "animals"):
        raise UserError(f"pairs of --data {cfg.data} are made on {fabric.device} itself: leave --workers out")
    if cfg.graph and (cfg.compile or fabric.world_size > 1):
        raise UserError("--graph is for one process and without --compile: leave one of them out")
    return fabric, cfg


def shape(cfg: Settings) -> dict[str, Any]:
    """Number and kind of the processes."""
    if world_size(cfg.devices) == 1:
        return {"devices": 1}
    from lightning_fabric.strategies.ddp import DDPStrategy

    # The other processes wait while the first computes descriptors and figures.
    strategy = DDPStrategy(timeout=timedelta(hours=6))
    if "LOCAL_WORLD_SIZE" not in os.environ:  # not torchrun: Fabric starts the other processes
        return {"devices": cfg.devices, "strategy": strategy}
    each = int(os.environ["LOCAL_WORLD_SIZE"])
    return {"devices": each, "num_nodes": int(os.environ["WORLD_SIZE"]) // each, "strategy": strategy}
