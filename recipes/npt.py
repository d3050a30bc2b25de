"""NPT: supervised pose transfer without correspondence (Wang et al.), which the paper compares with.

    python recipes/npt.py                           # the max-pool variant on the shipped humans, on a laptop's CPU
    python recipes/npt.py --variant original        # vertex i of one mesh beside vertex i of the other
    python recipes/npt.py --preset paper            # the released sizes and schedule
    python recipes/npt.py --name npt --apply identity.obj pose.obj --result posed.obj

A run writes what a run of ``xdualnet.py`` writes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from _apply import apply
from _data import inputs
from _run import guard
from _settings import Settings, parse
from _train import train
from torch import Tensor

from meshkit.data import PairBatch
from meshkit.losses import edge_ratio_loss, reconstruction_loss
from meshkit.models import GeneratorConfig


@dataclass(frozen=True)
class Config(Settings):
    """NPT's settings."""

    name: str = "npt"
    """Name of the run."""
    variant: Literal["maxpool", "original"] = "maxpool"
    """maxpool pools the pose feature over the mesh, so that sizes and orders may differ; original pairs the vertices of
    the two meshes by their numbers, which here are in random order."""
    lambda_rec: float = 1.0
    """Weight of the reconstruction. Released code: 1."""
    lambda_edge: float = 0.0005
    """Weight of the edge loss (length ratios). Paper: 0.0005."""


MODELS = {
    "tiny": GeneratorConfig(architecture="npt_maxpool", extractor_widths=(32, 64, 253)),
    "paper": GeneratorConfig(architecture="npt_maxpool", extractor_widths=(64, 128, 1024)),
}
PRESETS = {
    "tiny": Config(model=MODELS["tiny"], lr=1e-3),
    "small": Config(
        preset="small",
        name="npt-small",
        model=MODELS["tiny"],
        minutes=None,
        steps=6000,
        batch=16,
        warmup=200,
        eval_pairs=400,
        eval_every=500,
        save_every=500,
    ),
    "paper": Config(
        preset="paper",
        name="npt-paper",
        model=MODELS["paper"],
        minutes=None,
        steps=1000 * 800,
        batch=8,
        resample=False,
        vertices=6890,
        lr=5e-5,
        warmup=0,
        decay_from=1.0,  # the released code keeps its rate
        eval_pairs=400,
        eval_every=800,
        save_every=400,
    ),
}


def build(cfg: Config) -> tuple[torch.nn.Module, torch.nn.Module]:
    """The generator, which is trained as it is."""
    generator = cfg.model.build()
    return generator, generator


def step(system: torch.nn.Module, batch: PairBatch, cfg: Config, progress: float) -> dict[str, Tensor]:
    """The weighted losses of one step."""
    output = system(batch.identity, batch.pose, **inputs(batch)).vertices
    return {
        "rec": cfg.lambda_rec * reconstruction_loss(output, batch.ground_truth, mask=batch.identity_mask),
        "edge": cfg.lambda_edge * edge_ratio_loss(output, batch.identity, batch.identity_faces),
    }


def main() -> None:
    """Train, or apply what was trained."""
    cfg = parse(PRESETS, __doc__)
    if cfg.apply is not None:
        apply(cfg.out / cfg.name, cfg.apply, cfg.result)
    else:
        variants: dict[str, Literal["npt_maxpool", "npt_original"]]
        variants = {"maxpool": "npt_maxpool", "original": "npt_original"}
        train(replace(cfg, model=replace(cfg.model, architecture=variants[cfg.variant])), build, step)


if __name__ == "__main__":
    guard(main)
