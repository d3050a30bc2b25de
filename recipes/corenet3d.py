"""3D-CoreNet: supervised 3D pose transfer with correspondence learning (Song et al.), the generator of X-DualNet.

    python recipes/corenet3d.py                     # train on the shipped humans, on a laptop's CPU
    python recipes/corenet3d.py --norm spadain      # the paper's ablation: SPAdaIN instead of ElaIN
    python recipes/corenet3d.py --preset small      # more of everything: hours on a CPU, minutes on a GPU
    python recipes/corenet3d.py --name corenet3d --apply identity.obj pose.obj --result posed.obj

Like X-DualNet's paper it takes that paper's extractor of three set convolutions; ``--model.extractor pointwise`` is the
released 3D-CoreNet's. A run writes what a run of ``xdualnet.py`` writes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from _apply import apply
from _data import inputs
from _run import UserError, guard
from _settings import Settings, parse
from _train import train
from torch import Tensor

from meshkit.data import PairBatch
from meshkit.losses import RowPlanLike, edge_ratio_loss, matching_loss, reconstruction_loss
from meshkit.models import PoseTransferGenerator
from meshkit.models.presets import PRESETS as MODELS


@dataclass(frozen=True)
class Config(Settings):
    """3D-CoreNet's settings."""

    name: str = "corenet3d"
    """Name of the run."""
    lambda_rec: float = 1000.0
    """Weight of the reconstruction. Released code: 1000. With 0 for it and the edge loss, the matching alone learns."""
    lambda_edge: float = 0.5
    """Weight of the edge loss (length ratios). Released code: 0.5."""
    lambda_match: float = 0.0
    """Weight of the likelihood of the true matches, which the data must know. Paper: 0, reconstruction alone."""
    frozen_matching: bool = False
    """The matching that --init brings stays as it is: the blocks alone learn."""
    norm: Literal["elain", "spadain"] | None = None
    """Conditional norm of the blocks, None for that of --model.norm; spadain is the paper's ablation of ElaIN."""


PRESETS = {
    "tiny": Config(model=replace(MODELS["tiny"], symmetry=False), lr=2e-3),
    "small": Config(
        preset="small",
        name="corenet3d-small",
        model=replace(MODELS["small"], symmetry=False),
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
        name="corenet3d-paper",
        model=MODELS["paper"],
        minutes=None,
        steps=200 * 800,
        batch=8,
        resample=False,
        vertices=6890,
        lr=1e-4,
        betas=(0.0, 0.9),
        adam_eps=1e-3,
        warmup=0,
        eval_pairs=400,
        eval_every=800,
        save_every=400,
    ),
}


class Matching(torch.nn.Module):
    """The matching of a generator alone: nothing is warped, and the blocks stay as they are."""

    def __init__(self, generator: PoseTransferGenerator) -> None:
        super().__init__()
        self.generator = generator
        generator.transfer.requires_grad_(False)

    def forward(self, identity: Tensor, pose: Tensor, **known: Tensor | None) -> RowPlanLike:
        """The plan between the meshes of a batch; known is what :func:`inputs` gives."""
        masks = {name: mask for name, mask in known.items() if name.endswith("mask")}
        first, second = (
            self.generator.encode(verts, mask=known[f"{side}_mask"], descriptors=known[f"{side}_descriptors"])
            for side, verts in (("identity", identity), ("pose", pose))
        )
        return self.generator.match(first, second, **masks)


def build(cfg: Config) -> tuple[torch.nn.Module, torch.nn.Module]:
    """The generator, which is trained as it is, or its matching alone."""
    if not (cfg.lambda_rec or cfg.lambda_edge or cfg.lambda_match):
        raise UserError("nothing to learn: one of --lambda-rec, --lambda-edge and --lambda-match must not be 0")
    generator = cfg.model.build()
    if not isinstance(generator, PoseTransferGenerator):
        raise UserError(f"--model.architecture {cfg.model.architecture} has no matching: recipes/npt.py trains it")
    if cfg.frozen_matching:
        if cfg.lambda_match or cfg.init is None:
            raise UserError("--frozen-matching keeps the matching that --init brings; it goes without --lambda-match")
        for part in (generator.extractor, generator.theta, generator.phi):
            part.requires_grad_(False)
    return generator, generator if cfg.lambda_rec or cfg.lambda_edge else Matching(generator)


def step(system: torch.nn.Module, batch: PairBatch, cfg: Config, progress: float) -> dict[str, Tensor]:
    """The weighted losses of one step."""
    result = system(batch.identity, batch.pose, **inputs(batch))
    if cfg.lambda_rec or cfg.lambda_edge:
        output, _, plan = result
    else:
        plan = result
    losses = {}
    if cfg.lambda_rec:
        losses["rec"] = cfg.lambda_rec * reconstruction_loss(output, batch.ground_truth, mask=batch.identity_mask)
    if cfg.lambda_edge:
        losses["edge"] = cfg.lambda_edge * edge_ratio_loss(output, batch.identity, batch.identity_faces)
    if cfg.lambda_match:
        # A CUDA graph cannot be asked; it is for shipped bodies, whose matches are known.
        if progress == 0 and not cfg.graph and not bool((batch.correspondence >= 0).any()):
            raise UserError(f"--lambda-match needs true matches, which --data {cfg.data} does not know: drop it")
        losses["match"] = cfg.lambda_match * matching_loss(plan, batch.correspondence)
    return losses


def main() -> None:
    """Train, or apply what was trained."""
    cfg = parse(PRESETS, __doc__)
    if cfg.apply is not None:
        apply(cfg.out / cfg.name, cfg.apply, cfg.result)
    else:
        model = cfg.model if cfg.norm is None else replace(cfg.model, norm=cfg.norm)
        train(replace(cfg, model=model), build, step)


if __name__ == "__main__":
    guard(main)
