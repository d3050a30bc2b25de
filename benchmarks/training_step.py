"""X-DualNet's training step against a literal transcription of the released one: time and peak memory.

One step is the three passes of dual reconstruction, its losses, the backward pass and Adam, in the paper's sizes. The
literal form computes as the released code does: neighbours by sorting the whole distance matrix, features of both
meshes anew in every pass (six extractions), plans stored under autograd, ElaIN with its C x C maps per vertex, the edge
loss mesh by mesh. Both have the same parameters and the same batch, so their first losses agree; each runs in a process
of its own. Time is the CPU time of the second step, memory the high-water mark of the resident set beyond what was
resident before the first.

    python benchmarks/training_step.py --threads 1

The literal form takes minutes and 13 GiB at 6890 vertices. ``--bf16`` also times the step under autocast; that pays
only on processors with bfloat16 products.
"""

import argparse
import json
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor, nn

from meshkit.consistency import DualReconstruction
from meshkit.data import PairBatch, PosePairs, human_split, load_humans
from meshkit.losses import backward_correspondence_loss, edge_ratio_loss, reconstruction_loss
from meshkit.models import PoseTransferGenerator, xdualnet

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from literal import LiteralStack
from literal_models import matching
from literal_setconv import extractor_literally

LAMBDAS = {"rec_a": 2000.0, "rec_b": 2000.0, "corr": 200.0, "edge": 1.0}


class LiteralGenerator(nn.Module):
    """The same function as the package's generator, with its parameters."""

    def __init__(self, generator: PoseTransferGenerator) -> None:
        super().__init__()
        widths = [block.conv_0.in_features for block in generator.transfer.blocks]
        cond = generator.transfer.blocks[0].norm_0.cond_features
        self.extractor = generator.extractor
        self.stack = LiteralStack(cond, widths).load(generator.transfer.state_dict())

    def forward(self, identity: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        f, g = extractor_literally(self.extractor, identity), extractor_literally(self.extractor, pose)
        plan = torch.stack([matching(x, y, stabilizer=0.0) for x, y in zip(f, g, strict=True)])
        plan = plan / plan.sum(2, keepdim=True)
        return self.stack(plan @ pose, f), plan


def literal_losses(generator: nn.Module, batch: PairBatch) -> dict[str, Tensor]:
    a, b = batch.identity, batch.pose
    output, plan = generator(a, b)
    edge = []
    for x, rest, faces in zip(output, a, batch.identity_faces, strict=True):
        for i, j in ((0, 1), (1, 2), (2, 0)):
            new, old = ((v[faces[:, i]] - v[faces[:, j]]).square().sum(1).sqrt() for v in (x, rest))
            edge.append((new / old - 1).abs().mean())
    return {
        "rec_a": (generator(output, a)[0] - a).square().mean(),
        "rec_b": (generator(b, output)[0] - b).square().mean(),
        "corr": (plan.mT @ (plan @ b) - b).square().mean(),
        "edge": torch.stack(edge).sum() / len(a),
    }


def composed_losses(system: nn.Module, batch: PairBatch) -> dict[str, Tensor]:
    result = system(batch.identity, batch.pose)
    return {
        "rec_a": reconstruction_loss(result.reconstruction_a, result.target_a),
        "rec_b": reconstruction_loss(result.reconstruction_b, result.target_b),
        "corr": backward_correspondence_loss(result.plan, result.target_b, normalization="rows"),
        "edge": edge_ratio_loss(result.output, batch.identity, batch.identity_faces),
    }


def resident(field: str) -> float:
    """MiB of this process's memory: ``VmRSS`` now, or ``VmHWM`` at its highest."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(field))) / 1024


def measure(form: str, vertices: int, size: int, steps: int, bf16: bool) -> dict[str, float]:
    torch.manual_seed(0)
    generator = xdualnet("paper")
    system = LiteralGenerator(generator) if form == "literal" else DualReconstruction(generator)
    losses = literal_losses if form == "literal" else composed_losses
    optimizer = torch.optim.Adam(system.parameters(), lr=1e-4)
    split = human_split()
    pairs = PosePairs(load_humans(vertices), split.train_identities, split.train_poses)
    batch = pairs[[(0, i) for i in range(size)]]
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    result: dict[str, float] = {}
    for step in range(steps):
        start = time.process_time()
        optimizer.zero_grad()
        with torch.autocast("cpu", torch.bfloat16) if bf16 else nullcontext():
            terms = losses(system, batch)
        total = torch.stack([LAMBDAS[name] * value for name, value in terms.items()]).sum()
        total.backward()
        optimizer.step()
        result["seconds"] = time.process_time() - start
        if step == 0:
            result |= {name: float(value.detach()) for name, value in terms.items()}
    return result | {"MiB": resident("VmHWM") - before}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=6890)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--steps", type=int, default=2, help="the last one is timed")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--bf16", action="store_true", help="also under bfloat16 autocast")
    parser.add_argument("--only", choices=["literal", "composed", "composed, bf16"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.only:
        form, bf16 = args.only.split(",")[0], "bf16" in args.only
        print(json.dumps(measure(form, args.vertices, args.batch, args.steps, bf16)))
        return
    results = {}
    for form in ["literal", "composed", *(["composed, bf16"] if args.bf16 else [])]:
        command = [sys.executable, __file__, *sys.argv[1:], "--only", form]
        results[form] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    print(f"N = {args.vertices}, B = {args.batch}, paper sizes, fp32 unless said, {args.threads} thread(s)")
    print(f"{'':<16}{'CPU s':>8}{'peak MiB':>10}{'faster':>8}{'memory':>8}   losses before the first update")
    first = results["literal"]
    for form, r in results.items():
        terms = ", ".join(f"{name} {r[name]:.6g}" for name in LAMBDAS)
        ratios = f"{first['seconds'] / r['seconds']:>8.1f}{'1/' + format(first['MiB'] / r['MiB'], '.1f'):>8}"
        print(f"{form:<16}{r['seconds']:>8.2f}{r['MiB']:>10.0f}{ratios}   {terms}")


if __name__ == "__main__":
    main()
