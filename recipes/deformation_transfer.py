"""Deformation transfer (Sumner and Popović), the classic method that the paper compares with. Nothing is trained.

    python recipes/deformation_transfer.py                        # the test pairs of the shipped humans
    python recipes/deformation_transfer.py --data animals
    python recipes/deformation_transfer.py --source template      # when nothing is known of the pose mesh's body

It is told more than the learned methods: which vertices correspond, and what the pose mesh's body looks like in the
pose of the identity mesh (``--source subject``), or at least what an average body looks like in it (``--source
template``; the difference between the two bodies is then transferred along with the pose). Figures, pictures and meshes
are those of the other recipes, on the same test pairs.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, cast

import torch
from _command_line import read
from _data import data
from _report import report
from _run import Run, UserError, guard
from torch import Tensor, nn

from meshkit.data import PairBatch, PosePairs
from meshkit.deform import deformation_transfer
from meshkit.models import GeneratorConfig


@dataclass(frozen=True)
class Config:
    """What to transfer."""

    name: str = "deformation_transfer"
    """Name of the run."""
    out: Path = Path("runs")
    """Folder that holds the runs."""
    data: str = "humans"
    """humans or animals, which ship with meshkit; smpl:<file> or smal:<file>, a licensed model."""
    vertices: int | None = None
    """Vertices per mesh, None for the smallest there are: humans have 1000, 2000, 3445 or 6890. Paper: 6890."""
    source: Literal["subject", "template"] = "subject"
    """Body of which a mesh in the identity mesh's pose is known: the pose mesh's own, or the average one."""
    eval_pairs: int = 100
    """Test pairs. Paper: 400."""
    threads: int = 0
    """Threads, 0 for torch's choice."""


class DeformationTransfer(nn.Module):
    """As a generator of test pairs, which it knows the identities and poses of."""

    takes_batches = True

    def __init__(self, pairs: PosePairs, source: str) -> None:
        super().__init__()
        self.pairs, self.source, self.times = pairs, source, list[float]()

    def forward(self, batch: PairBatch, place: int) -> SimpleNamespace:
        """Vertices in the order of the identity meshes; there is no warped mesh and no plan."""
        outputs = [self.transfer(batch, b, place + b) for b in range(len(batch))]
        return SimpleNamespace(vertices=torch.stack(outputs), warped=None, plan=None)

    def transfer(self, batch: PairBatch, b: int, i: int) -> Tensor:
        """Row ``b`` of the batch, which is test pair ``i``."""
        model, faces = self.pairs.model, batch.identity_faces[b]
        _, how_a, who_b, _ = cast(Tensor, self.pairs.listed)[i].split(1)
        body = who_b if self.source == "subject" else torch.zeros(1, len(model.shape_dirs))
        # The vertices of the source, posed and at rest, in the order of the identity mesh.
        posed = batch.pose[b, batch.correspondence[b]]
        order = torch.empty(len(posed), dtype=torch.int64)
        order[faces.flatten()] = model.faces.flatten()
        rest = model(body, how_a)[0, order]
        start = time.perf_counter()
        result = deformation_transfer(rest, posed, batch.identity[b], faces=faces)
        self.times.append(time.perf_counter() - start)
        return result


def main() -> None:
    """Transfer all test pairs, and report."""
    cfg = read(Config, __doc__)
    if cfg.threads < 0:
        raise UserError(f"--threads must not be negative, got {cfg.threads}")
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    if not 1 <= cfg.eval_pairs <= 400:
        raise UserError(f"there are 400 test pairs, --eval-pairs asks for {cfg.eval_pairs}")
    if cfg.data.partition(":")[0] in ("faust", "mgn", "folder"):
        raise UserError(f"--data {cfg.data}: a rigged body is needed, to pose the source like the identity mesh")
    run = Run(cfg.out / cfg.name, resume=False)
    settings = SimpleNamespace(
        **vars(cfg),
        model=GeneratorConfig(),
        pairs=1,
        seed=0,
        resample=False,
        ground_truth=True,
        pool=0,
        sampled_identities=0,
        bone_spread=0.0,
        sampled_poses=0,
    )
    _, pairs = data(settings, run, workers=1)
    assert isinstance(pairs, PosePairs)
    generator = DeformationTransfer(pairs, cfg.source)
    report(run, generator, pairs, torch.device("cpu"), {"source": cfg.source}, kind=cfg.data)
    print(f"{sum(generator.times) / len(generator.times):.3f} s for each transfer")


if __name__ == "__main__":
    guard(main)
