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
from typing import Any, Literal, cast

import torch
import tyro
from _run import Run, UserError, guard, keep_freed_memory, pick_precision
from lightning_fabric import Fabric
from torch import Tensor
from tqdm import tqdm

from meshkit.batching import bounding_box_center, center
from meshkit.consistency import DualReconstruction
from meshkit.data import MeshPool, PairBatch, PairSampler, PosePairs, human_split, load_humans, pair_loader
from meshkit.deform import ARAPDeformer
from meshkit.descriptors import intrinsic_descriptors
from meshkit.io import MeshFileError, load_mesh, save_mesh
from meshkit.losses import (
    backward_correspondence_loss,
    edge_length_loss,
    edge_ratio_loss,
    reconstruction_loss,
)
from meshkit.metrics import chamfer_distance, correspondence_error, pmd
from meshkit.models import GeneratorConfig, PoseTransferGenerator, load_generator
from meshkit.models.presets import PRESETS as MODELS
from meshkit.viz import contact_sheet, error_colors, plot_curves, render


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
    """Go on from the run's last checkpoint, if it has one."""
    apply: tuple[Path, Path] | None = None
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
        corr_normalization="rows",
        arap_iters=50,
        arap_energy="spokes",
        arap_grad="none",
        eval_pairs=400,
        eval_every=1600,
        save_every=400,
    ),
}


def build(cfg: Config) -> tuple[PoseTransferGenerator, torch.nn.Module]:
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
        back = backward_correspondence_loss(
            result.plan, result.target_b, warped=result.warped, normalization=cfg.corr_normalization
        )
        losses = {
            "rec_a": cfg.lambda_rec * reconstruction_loss(result.reconstruction_a, result.target_a),
            "rec_b": cfg.lambda_rec * reconstruction_loss(result.reconstruction_b, result.target_b),
            "corr": cfg.lambda_corr * back,
        }
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
    losses = step(system, batch, cfg, arap=s >= cfg.arap_from * steps)
    total = torch.stack(list(losses.values())).sum()
    if not torch.isfinite(total):
        raise UserError(
            f"the loss is {float(total)} at step {s} (identities {batch.identity_index.tolist()}, poses "
            f"{batch.pose_index.tolist()}): the last checkpoint is sound; resume it with a smaller --lr"
        )
    optimizer.zero_grad()
    fabric.backward(total)
    optimizer.step()
    return {name: value.item() for name, value in losses.items()} | {"loss": total.item()}


@torch.no_grad()
def evaluate(generator: PoseTransferGenerator, pairs: PosePairs, device: torch.device, count: int) -> dict[str, float]:
    """Means over ``count`` unseen pairs, of the output and of two baselines; PMD and Chamfer in 1e-3 square metres."""
    generator.eval()
    columns: dict[str, list[Tensor]] = {}
    for start in range(0, count, 4):
        batch = pairs[[(0, i) for i in range(start, min(start + 4, count))]].to(device)
        result = generate(generator, batch)
        candidates = {"": result.vertices, "_copy_identity": batch.identity, "_copy_warped": result.warped}
        for name, verts in candidates.items():
            columns.setdefault(f"pmd{name}", []).append(1e3 * pmd(verts, batch.ground_truth))
            columns.setdefault(f"chamfer{name}", []).append(1e3 * chamfer_distance(center(verts), batch.ground_truth))
        matched = correspondence_error(result.plan.argmax(), batch.pose, batch.correspondence)
        columns.setdefault("correspondence_m", []).append(matched)
    generator.train()
    return {name: round(float(torch.cat(values).mean()), 4) for name, values in columns.items()}


def generate(generator: PoseTransferGenerator, batch: PairBatch) -> Any:
    return generator(
        batch.identity,
        batch.pose,
        identity_descriptors=batch.identity_descriptors,
        pose_descriptors=batch.pose_descriptors,
    )


def data(cfg: Config, run: Run, workers: int) -> tuple[PosePairs, PosePairs]:
    """Training pairs, and test pairs of unseen identities in unseen poses."""
    body, split = load_humans(cfg.vertices), human_split()
    sides = {
        "train": (split.train_identities, split.train_poses, cfg.pool, cfg.seed),
        "test": (split.test_identities, split.test_poses, max(cfg.eval_pairs, 24), 1_000_000),
    }
    pairs = []
    for side, (identities, poses, size, seed) in sides.items():
        pool = None
        if cfg.model.descriptors == "wks":
            stored = run.load_tensors(f"pool_{side}.safetensors")
            if stored is not None and len(stored["identity"]) == size:
                pool = MeshPool(**stored)
            else:
                pool = MeshPool.build(
                    body,
                    identities,
                    poses,
                    size,
                    num_signatures=cfg.model.num_signatures,
                    seed=seed,
                    workers=workers,
                    progress=True,
                )
                run.save_tensors(f"pool_{side}.safetensors", pool.state_dict())
        pairs.append(PosePairs(body, identities, poses, length=cfg.pairs, seed=seed, resample=cfg.resample, pool=pool))
    return pairs[0], pairs[1]


def count_steps(cfg: Config, fabric: Fabric, system: Any, optimizer: Any, loader: Any) -> int:
    """Steps that fit into ``cfg.minutes``, from the speed of a few steps on copies that are thrown away."""
    if cfg.steps is not None:
        return cfg.steps
    if cfg.minutes is None or cfg.minutes <= 0:
        raise UserError(f"give --steps, or positive --minutes, got {cfg.minutes}")
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
    torch.manual_seed(cfg.seed)
    run = Run(cfg.out / cfg.name, resume=cfg.resume)
    recorded = run.load_json("config.json") if cfg.resume else None
    if recorded is not None:
        cfg = resumed(cfg, recorded)
    elif cfg.precision == "auto":
        device = Fabric(accelerator=cfg.accelerator, devices=1).device
        cfg = replace(cfg, precision=pick_precision(device))
    fabric = Fabric(accelerator=cfg.accelerator, devices=1, precision=cast(Any, cfg.precision))
    train_pairs, test_pairs = data(cfg, run, workers=torch.get_num_threads())

    generator, system = build(cfg)
    if train_pairs.pool is not None:
        generator.descriptor_mean.copy_(train_pairs.pool.descriptors.mean((0, 1)))
        generator.descriptor_std.copy_(train_pairs.pool.descriptors.std((0, 1)))
    optimizer = torch.optim.Adam(generator.parameters(), lr=cfg.lr, betas=cfg.betas, eps=cfg.adam_eps)
    system, optimizer = fabric.setup(system, optimizer)

    def loader(start: int, stop: int) -> Any:
        return pair_loader(train_pairs, PairSampler(cfg.pairs, cfg.batch, start=start, stop=stop, seed=cfg.seed))

    steps = count_steps(cfg, fabric, system, optimizer, loader(0, 5))
    cfg = replace(cfg, steps=steps)
    run.save_json("config.json", json.loads(json.dumps(asdict(cfg), default=str)))
    run.save_json("model.json", asdict(cfg.model))

    first, seconds, waiting = 0, 0.0, 0.0
    state = run.load_state() if cfg.resume else None
    if state is not None:
        generator.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        first, seconds, waiting = state["step"], state["seconds"], state["waiting"]
        run.cut_log(first)
    else:
        run.cut_log(-1)

    clock = time.perf_counter()
    bar = tqdm(total=steps, initial=first, unit="step", dynamic_ncols=True, smoothing=0.05)
    batches = iter(loader(first, steps))
    for s in range(first, steps):
        asked = time.perf_counter()
        batch = next(batches).to(fabric.device)
        waiting += time.perf_counter() - asked
        losses = train_step(fabric, system, optimizer, batch, cfg, s, steps)
        seconds, clock = seconds + time.perf_counter() - clock, time.perf_counter()
        bar.update()
        bar.set_postfix({name: f"{value:.3g}" for name, value in losses.items()}, refresh=False)
        record: dict[str, Any] = {"step": s + 1, "seconds": round(seconds, 2), **losses}
        if (s + 1) % cfg.eval_every == 0 and s + 1 < steps:
            record["eval"] = evaluate(generator, test_pairs, fabric.device, 24)
            bar.write(f"step {s + 1}: PMD {record['eval']['pmd']:.2f}e-3 on 24 unseen pairs")
        run.log(**record)
        if (s + 1) % cfg.save_every == 0 or s + 1 == steps:
            run.save_state(generator, optimizer, s + 1, {"seconds": seconds, "waiting": waiting})
        clock = time.perf_counter()
    bar.close()
    report(cfg, run, generator, test_pairs, fabric.device, seconds, waiting)


def resumed(cfg: Config, recorded: dict[str, Any]) -> Config:
    """The recorded configuration: a run that goes on must be the run that was begun."""
    model = GeneratorConfig.from_json(json.dumps(recorded.pop("model")))
    values = {key: value for key, value in recorded.items() if key in Config.__dataclass_fields__}
    values |= {"betas": tuple(values["betas"]), "out": cfg.out, "name": cfg.name, "resume": True, "apply": None}
    values |= {"result": cfg.result, "threads": cfg.threads, "accelerator": cfg.accelerator}
    return Config(**values, model=model)


def report(
    cfg: Config,
    run: Run,
    generator: PoseTransferGenerator,
    pairs: PosePairs,
    device: torch.device,
    seconds: float,
    waiting: float,
) -> None:
    """Evaluate on unseen pairs; write summary.json, curves.png, sheet.png and meshes/."""
    figures = evaluate(generator, pairs, device, cfg.eval_pairs)
    summary = {
        "test": figures,
        "test_pairs": cfg.eval_pairs,
        "units": "PMD and Chamfer (squared, both directions summed) in 1e-3 m^2, correspondence in m",
        "steps": cfg.steps,
        "pairs_seen": (cfg.steps or 0) * cfg.batch,
        "train_minutes": round(seconds / 60, 2),
        "share_of_time_waiting_for_data": round(waiting / max(seconds, 1e-9), 4),
        "parameters": sum(p.numel() for p in generator.parameters()),
        "machine": run.load_json("machine.json"),
        "threads": torch.get_num_threads(),
    }
    run.save_json("summary.json", summary)
    draw_curves(run)
    draw_sheet(run, generator, pairs, device)
    print(f"\n{cfg.eval_pairs} unseen pairs        PMD e-3   Chamfer e-3")
    for title, key in (("copy the identity", "_copy_identity"), ("copy the warped", "_copy_warped"), ("output", "")):
        print(f"  {title:<20} {figures[f'pmd{key}']:8.2f}   {figures[f'chamfer{key}']:8.2f}")
    print(f"matched vertices are {100 * figures['correspondence_m']:.1f} cm from the true ones on average")
    print(f"pictures, meshes and figures: {run.folder}")


def draw_curves(run: Run) -> None:
    records = run.read_log()
    names = [name for name in records[-1] if name not in ("step", "seconds", "eval")]
    window = max(1, len(records) // 100)
    minutes = torch.tensor([record["seconds"] / 60 for record in records])
    series = {}
    for name in names:
        values = torch.tensor([record[name] for record in records])
        smooth = torch.nn.functional.avg_pool1d(values[None], window, window)[0]
        series[name] = (torch.nn.functional.avg_pool1d(minutes[None], window, window)[0], smooth)
    plot_curves(run.path("curves.png"), series, xlabel="training time (minutes)", ylabel="weighted loss", logy=True)
    points = [(r["seconds"] / 60, r["eval"]["pmd"]) for r in records if "eval" in r]
    if points:
        plot_curves(
            run.path("pmd.png"),
            {"24 unseen pairs": ([t for t, _ in points], [value for _, value in points])},
            xlabel="training time (minutes)",
            ylabel="PMD (1e-3 m²)",
            logy=True,
        )


@torch.no_grad()
def draw_sheet(
    run: Run, generator: PoseTransferGenerator, pairs: PosePairs, device: torch.device, rows: int = 6
) -> None:
    batch = pairs[[(0, i) for i in range(rows)]].to(device)
    generator.eval()
    result = generate(generator, batch)
    output, warped = center(result.vertices), center(result.warped)
    worst, sheet, captions = 0.15, [], []
    for b in range(rows):
        faces, truth = batch.identity_faces[b], batch.ground_truth[b]
        views = [
            (batch.identity[b], faces, None),
            (batch.pose[b], batch.pose_faces[b], None),
            (warped[b], faces, None),
            (output[b], faces, None),
            (truth, faces, None),
            (output[b], faces, error_colors((output[b] - truth).norm(dim=1), vmax=worst)),
        ]
        # One scale per row, so that sizes can be compared.
        everything = torch.cat([verts for verts, _, _ in views])
        bounds = torch.stack([everything.amin(0), everything.amax(0)])
        sheet.append([render(verts, f, colors=colors, bounds=bounds) for verts, f, colors in views])
        score = 1e3 * float(pmd(output[b : b + 1], batch.ground_truth[b : b + 1]))
        captions.append(["", "", "", f"PMD {score:.1f}e-3", "", ""])
        for name, verts, f in (
            ("identity", batch.identity[b], faces),
            ("pose", batch.pose[b], batch.pose_faces[b]),
            ("output", output[b], faces),
            ("ground_truth", truth, faces),
        ):
            save_mesh(run.path("meshes") / f"pair{b}_{name}.obj", verts, f)
    titles = ["identity", "pose", "warped", "output", "ground truth", "error"]
    contact_sheet(
        sheet, column_titles=titles, captions=captions, colorbar=(0.0, 100 * worst, "distance to ground truth (cm)")
    ).save(run.path("sheet.png"))


@torch.no_grad()
def apply(cfg: Config) -> None:
    """Pose transfer between two mesh files with a run's weights."""
    assert cfg.apply is not None
    try:
        generator, model = load_generator(cfg.out / cfg.name)
        meshes = [load_mesh(path) for path in cfg.apply]
        signatures = [
            intrinsic_descriptors(verts, faces, num_signatures=model.num_signatures)[None]
            if model.descriptors == "wks"
            else None
            for verts, faces in meshes
        ]
        (identity, faces), (pose, _) = meshes
        output = generator(
            center(identity[None]),
            center(pose[None]),
            identity_descriptors=signatures[0],
            pose_descriptors=signatures[1],
        )
        # Training meshes are centred; the result goes to where the pose mesh stands.
        save_mesh(cfg.result, output.vertices[0] + bounding_box_center(pose[None])[0], faces)
    except (MeshFileError, ValueError) as error:
        raise UserError(str(error)) from None
    except OSError as error:
        raise UserError(f"cannot write {cfg.result}: {error.strerror}") from None
    print(f"{cfg.result}: {len(identity)} vertices of {cfg.apply[0]} in the pose of {cfg.apply[1]}")


def main() -> None:
    """Parse the command line against the chosen preset's values."""
    words = " ".join(sys.argv[1:]).replace("--preset=", "--preset ").split()
    chosen = words[words.index("--preset") + 1] if "--preset" in words[:-1] else "tiny"
    cfg = tyro.cli(Config, default=PRESETS.get(chosen, PRESETS["tiny"]), description=__doc__)
    if cfg.apply is not None:
        apply(cfg)
    else:
        train(cfg)


if __name__ == "__main__":
    guard(main)
