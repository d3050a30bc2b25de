"""The unsupervised baseline of X-DualNet's appendix: cycle and self reconstruction.

    python recipes/cycle_baseline.py                # train on the shipped humans, on a laptop's CPU
    python recipes/cycle_baseline.py --preset small # more of everything: hours on a CPU, minutes on a GPU
    python recipes/cycle_baseline.py --preset paper # the paper's sizes and schedule

Two meshes exchange their poses and exchange them back, and a mesh is given its own pose: five passes of one generator,
three reconstructions, no ground truth. A run writes what a run of ``xdualnet.py`` writes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from _apply import apply
from _data import inputs
from _run import guard
from _settings import Settings, parse
from _train import train
from torch import Tensor

from meshkit.consistency import CycleReconstruction
from meshkit.data import PairBatch
from meshkit.losses import reconstruction_loss
from meshkit.models.presets import PRESETS as MODELS


@dataclass(frozen=True)
class Config(Settings):
    """The baseline's settings."""

    ground_truth: ClassVar[bool] = False
    name: str = "cycle"
    """Name of the run."""
    lambda_cycle: float = 2000.0
    """Weight of the two cycle reconstructions. The paper prints none; this is X-DualNet's for reconstructions."""
    lambda_self: float = 2000.0
    """Weight of the self reconstruction. Likewise."""


PRESETS = {
    "tiny": Config(model=MODELS["tiny"], lr=2e-3),
    "small": Config(
        preset="small",
        name="cycle-small",
        model=MODELS["small"],
        minutes=None,
        steps=6000,
        batch=16,
        pool=8000,
        lr=2e-3,
        warmup=200,
        eval_pairs=400,
        eval_every=500,
        save_every=500,
    ),
    "paper": Config(
        preset="paper",
        name="cycle-paper",
        model=MODELS["paper"],
        minutes=None,
        steps=200 * 1600,
        resample=False,
        vertices=6890,
        lr=1e-4,
        betas=(0.0, 0.9),
        adam_eps=1e-3,
        warmup=0,
        eval_pairs=400,
        eval_every=1600,
        save_every=400,
    ),
}


def build(cfg: Config) -> tuple[torch.nn.Module, torch.nn.Module]:
    """The generator, and what is trained around it."""
    generator = cfg.model.build()
    return generator, CycleReconstruction(generator)


def step(system: torch.nn.Module, batch: PairBatch, cfg: Config, progress: float) -> dict[str, Tensor]:
    """The weighted losses of one step."""
    # AB = G(A, B), BA = G(B, A);  A' = G(AB, BA) ≈ A;  B' = G(BA, AB) ≈ B;  A'' = G(A, A) ≈ A
    result = system(batch.identity, batch.pose, **inputs(batch))
    a, b = {"target": result.target_a, "mask": result.mask_a}, {"target": result.target_b, "mask": result.mask_b}
    return {
        "cycle_a": cfg.lambda_cycle * reconstruction_loss(result.reconstruction_a, **a),
        "cycle_b": cfg.lambda_cycle * reconstruction_loss(result.reconstruction_b, **b),
        "self": cfg.lambda_self * reconstruction_loss(result.self_reconstruction, **a),
    }


def main() -> None:
    """Train, or apply what was trained."""
    cfg = parse(PRESETS, __doc__)
    if cfg.apply is not None:
        apply(cfg.out / cfg.name, cfg.apply, cfg.result)
    else:
        train(cfg, build, step)


if __name__ == "__main__":
    guard(main)
