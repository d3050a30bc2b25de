"""X-DualNet: unsupervised 3D pose transfer with cross consistency and dual reconstruction (Song et al.).

    python recipes/xdualnet.py                      # train on the shipped humans, on a laptop's CPU
    python recipes/xdualnet.py --preset paper       # the paper's sizes and schedule
    python recipes/xdualnet.py --name demo --apply identity.obj pose.obj --result posed.obj

A run writes to runs/<name>/: weights (model.safetensors, model.json), log.jsonl, curves.png, sheet.png, meshes/ and
summary.json. A killed run goes on with --resume.
"""

from __future__ import annotations

import copy
import json
import sys
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import torch
import tyro
from _apply import apply
from _report import evaluate, report
from _run import Interruption, Run, UserError, guard, keep_freed_memory, pick_precision
from _setup import check, data, resumed
from lightning_fabric import Fabric
from torch import Tensor
from tqdm import tqdm

from meshkit.consistency import DualReconstruction
from meshkit.data import PairBatch, PairSampler, pair_loader
from meshkit.deform import ARAPDeformer
from meshkit.losses import backward_correspondence_loss, edge_length_loss, edge_ratio_loss, reconstruction_loss
from meshkit.models import NPT, GeneratorConfig, PoseTransferGenerator
from meshkit.models.presets import PRESETS as MODELS


@dataclass(frozen=True)
class Config:
    """Everything a run depends on. The values below are those of the preset; comments give the paper's."""

    preset: Literal["tiny", "paper"] = "tiny"
    """tiny trains on a CPU in minutes; paper has the printed sizes and schedule."""
    name: str = "xdualnet"
    """Name of the run."""
    out: Path = Path("runs")
    """Folder that holds the runs."""
    resume: bool = False
    """Go on from the run's last checkpoint, if it has one, with the settings it was begun with: of the other flags only
    --out, --name, --threads and --accelerator count then."""
    apply: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="IDENTITY POSE")] = None
    """Do not train: give the first mesh file the pose of the second, with the weights of run --name."""
    result: Path = Path("posed.obj")
    """Where --apply writes the posed mesh."""

    supervised: bool = False
    """Train with ground truth instead (3D-CoreNet's objective)."""
    minutes: float | None = 8.0
    """Training time; turned into a number of steps once, by the measured speed, and recorded. Paper: about 90 hours."""
    steps: int | None = None
    """Number of steps, instead of --minutes. Paper: 200 epochs of 1600."""
    batch: int = 4
    """Pairs per step. Paper: 4."""
    pairs: int = 6400
    """Training pairs per epoch. Paper: 6400."""
    resample: bool = True
    """Draw new pairs each epoch. Paper: one fixed set."""
    vertices: Literal[1000, 2000, 3445, 6890] = 1000
    """Vertices per mesh. Paper: 6890."""
    points: int | None = 384
    """Vertices matched against and reconstructed per mesh and step, None for all. Paper: all."""
    pool: int = 1200
    """Training meshes whose signatures are computed beforehand (with --model.descriptors wks)."""

    model: GeneratorConfig = field(default_factory=GeneratorConfig)
    """Sizes of the generator."""

    lr: float = 1e-3
    """Learning rate. Paper: 1e-4."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Adam's betas. Released code: 0, 0.9."""
    adam_eps: float = 1e-8
    """Adam's eps. Released code: 1e-3."""
    warmup: int = 50
    """Steps over which the learning rate rises from zero. Paper: none."""
    decay_from: float = 0.5
    """Share of the run after which the learning rate falls linearly to zero. Paper: 0.5 (epoch 100 of 200)."""
    lambda_rec: float = 2000.0
    """Weight of the two reconstructions. Paper: 2000."""
    lambda_corr: float = 200.0
    """Weight of the backward correspondence loss. Paper: 200."""
    lambda_edge: float = 1.0
    """Weight of the edge loss. Paper: 1."""
    edge: Literal["ratio", "length"] = "ratio"
    """Edge loss: length ratios as in the released code, or the paper's squared lengths."""
    corr_normalization: Literal["rows", "both", "none"] = "both"
    """Normalisation of the plan in the backward correspondence loss. Released code: rows. Paper: none."""
    arap_from: float = 0.75
    """Share of the run after which the ARAP deformer joins; 1 for never. Paper: 0.75 (the last 50 of 200 epochs)."""
    arap_fraction: float = 0.1
    """Share of vertices that are handles. Paper: 0.1."""
    arap_iters: int = 10
    """Local-global iterations. Paper: 50."""
    arap_energy: Literal["spokes_and_rims", "spokes"] = "spokes_and_rims"
    """Energy. Paper: spokes."""
    arap_grad: Literal["unroll", "none"] = "unroll"
    """Gradient through the deformer; the released code has none."""

    eval_pairs: int = 100
    """Unseen pairs at the end. Paper: 400."""
    eval_every: int = 200
    """Steps between evaluations on 24 unseen pairs, for the curve."""
    save_every: int = 100
    """Steps between checkpoints."""
    seed: int = 0
    """Of weights, pairs, vertex orders and handles."""
    threads: int = 0
    """Threads, 0 for torch's choice. At 1 a run repeats bit for bit."""
    precision: Literal["auto", "32-true", "bf16-mixed"] = "auto"
    """auto measures whether bfloat16 is faster here."""
    accelerator: str = "auto"
    """Where to train: auto, cpu, cuda, mps."""


PRESETS = {
    "tiny": Config(model=MODELS["tiny"], lr=2e-3, lambda_edge=40.0),
    "paper": Config(
        preset="paper",
        name="xdualnet-paper",
        model=MODELS["paper"],
        minutes=None,
        steps=200 * 1600,
        resample=False,
        vertices=6890,
        points=None,
        lr=1e-4,
        betas=(0.0, 0.9),
        adam_eps=1e-3,
        warmup=0,
        corr_normalization="rows",  # as released; the printed raw plan shrinks the mesh N times. Likewise the edge loss
        arap_iters=50,
        arap_energy="spokes",
        arap_grad="none",
        eval_pairs=400,
        eval_every=1600,
        save_every=400,
    ),
}


def build(cfg: Config) -> tuple[PoseTransferGenerator | NPT, torch.nn.Module]:
    """The generator, and what is trained around it."""
    generator = cfg.model.build()
    if cfg.supervised:
        return generator, generator
    deform = ARAPDeformer(cfg.arap_fraction, energy=cfg.arap_energy, max_iter=cfg.arap_iters, grad=cfg.arap_grad)
    return generator, DualReconstruction(generator, deform, points=cfg.points)


def step(system: torch.nn.Module, batch: PairBatch, cfg: Config, *, arap: bool) -> dict[str, Tensor]:
    """The weighted losses of one step."""
    descriptors = {
        "identity_descriptors": batch.identity_descriptors,
        "pose_descriptors": batch.pose_descriptors,
    }
    if cfg.supervised:
        output = system(batch.identity, batch.pose, **descriptors).vertices
        losses = {"rec": cfg.lambda_rec * reconstruction_loss(output, batch.ground_truth)}
    else:
        # O = G(A, B);  Ô = ARAP(A, O);  A' = G(Ô, A) ≈ A;  B' = G(B, Ô) ≈ B
        result = system(batch.identity, batch.pose, identity_faces=batch.identity_faces, use_deform=arap, **descriptors)
        output = result.output
        losses = {
            "rec_a": cfg.lambda_rec * reconstruction_loss(result.reconstruction_a, result.target_a),
            "rec_b": cfg.lambda_rec * reconstruction_loss(result.reconstruction_b, result.target_b),
        }
        if result.plan is not None:  # NPT has no correspondence
            back = backward_correspondence_loss(result.plan, result.target_b, normalization=cfg.corr_normalization)
            losses["corr"] = cfg.lambda_corr * back
    if cfg.edge == "ratio":
        losses["edge"] = cfg.lambda_edge * edge_ratio_loss(output, batch.identity, batch.identity_faces)
    else:
        losses["edge"] = cfg.lambda_edge * edge_length_loss(output, batch.identity_faces, reduction="sum")
    return losses


def learning_rate(cfg: Config, s: int, steps: int) -> float:
    """Linear warm-up, flat, then linear to zero."""
    rise = min(1.0, (s + 1) / cfg.warmup) if cfg.warmup else 1.0
    fall = min(1.0, (1 - s / steps) / (1 - cfg.decay_from)) if cfg.decay_from < 1 else 1.0
    return cfg.lr * rise * fall


def train_step(
    fabric: Fabric, system: Any, optimizer: Any, batch: PairBatch, cfg: Config, s: int, steps: int
) -> dict[str, float]:
    """One update; everything random in it follows from the seed and the step."""
    torch.manual_seed(cfg.seed * 1_000_003 + s * 7919 + fabric.global_rank)
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(cfg, s, steps)
    where = f"at step {s} (identities {batch.identity_index.tolist()}, poses {batch.pose_index.tolist()})"
    advice = "training has diverged. Begin again under another --name with a smaller --lr"
    try:
        losses = step(system, batch, cfg, arap=s >= cfg.arap_from * steps)
    except ValueError as error:
        raise UserError(f"{error} {where}: {advice}") from None
    total = torch.stack(list(losses.values())).sum()
    optimizer.zero_grad()
    fabric.backward(total)
    # Weights that turn NaN would be saved; they are looked at before, not after, the update.
    norm = torch.nn.utils.get_total_norm(p.grad for p in system.parameters() if p.grad is not None)
    if not torch.isfinite(total + norm):
        raise UserError(f"the loss is {total.item()}, its gradient {norm.item()} {where}: {advice}")
    optimizer.step()
    return {name: value.item() for name, value in losses.items()} | {"loss": total.item()}


def count_steps(cfg: Config, fabric: Fabric, system: Any, optimizer: Any, loader: Any) -> int:
    """Steps that fit into ``cfg.minutes``, from the speed of a few steps on copies that are thrown away."""
    if cfg.steps is not None:
        return cfg.steps
    assert cfg.minutes is not None
    weights, moments = copy.deepcopy(system.state_dict()), copy.deepcopy(optimizer.state_dict())
    seconds = []
    for arap in (False, True):
        times = []
        trial = replace(cfg, arap_from=0.0 if arap else 1.0)
        for s, batch in zip(range(5), loader, strict=False):
            start = time.perf_counter()
            train_step(fabric, system, optimizer, batch.to(fabric.device), trial, s, 1000)
            times.append(time.perf_counter() - start)
        seconds.append(sorted(times[1:])[1])
    system.load_state_dict(weights)
    optimizer.load_state_dict(moments)
    share = 0.0 if cfg.supervised else 1 - cfg.arap_from
    return max(1, round(cfg.minutes * 60 / ((1 - share) * seconds[0] + share * seconds[1])))


def train(cfg: Config) -> None:
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
        torch.manual_seed(cfg.seed)
        generator, system = build(cfg)
        train_pairs, test_pairs = data(cfg, run, workers=torch.get_num_threads())
    except (ValueError, RuntimeError) as error:
        raise UserError(str(error)) from None
    if train_pairs.pool is not None:
        generator.fit_descriptors(train_pairs.pool.descriptors)
    optimizer = torch.optim.Adam(generator.parameters(), lr=cfg.lr, betas=cfg.betas, eps=cfg.adam_eps)
    system, optimizer = fabric.setup(system, optimizer)

    def loader(start: int, stop: int) -> Any:
        return pair_loader(train_pairs, PairSampler(cfg.pairs, cfg.batch, start=start, stop=stop, seed=cfg.seed))

    steps = count_steps(cfg, fabric, system, optimizer, loader(0, 5))
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
        losses = train_step(fabric, system, optimizer, batch, cfg, s, steps)
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


def main() -> None:
    """Parse the command line against the chosen preset's values."""
    words = " ".join(sys.argv[1:]).replace("--preset=", "--preset ").split()
    chosen = words[words.index("--preset") + 1] if "--preset" in words[:-1] else "tiny"
    cfg = tyro.cli(Config, default=PRESETS.get(chosen, PRESETS["tiny"]), description=__doc__)
    if cfg.apply is not None:
        apply(cfg.out / cfg.name, cfg.apply, cfg.result)
    else:
        train(cfg)


if __name__ == "__main__":
    guard(main)
