"""Figure sheets beside the paper's tables: comparison, ablation, topologies, correspondence, noise, failures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from _report import generate
from _tables_measure import generator_of, pretrained, shipped, test_pairs
from _tables_train import SYSTEMS, Job
from torch import Tensor
from tqdm import tqdm

from meshkit.batching import center
from meshkit.io import atomic_write, simplify
from meshkit.metrics import pmd
from meshkit.viz import contact_sheet, correspondence_figure, plot_curves, render

NOISE_PAIRS, TOPOLOGY_PAIRS = 40, 20  # the first test pairs, that noise and triangulations are measured on
NOISE = (0.0, 5.0, 10.0, 20.0)  # millimetres
SIZES = (1000, 2000, 3445)
WEIGHTS = ("corenet3d-humans", "xdualnet-humans")
TOPOLOGY_WEIGHTS = NOISE_WEIGHTS = WEIGHTS[0]  # of the sheets
MATCHING_WEIGHTS = WEIGHTS[1]
COARSE = 700  # vertices of the sheet's coarsest mesh, which the table of triangulations leaves out
PICTURE = (220, 220)
ABLATED = ("corenet3d_spadain", "corenet3d", "xdualnet_no_arap", "xdualnet_no_corr", "xdualnet")


def score(output: Tensor, truth: Tensor) -> str:
    return f"PMD {1e3 * float(pmd(output[None], truth[None])):.1f}e-3"


def pictures(meshes: Sequence[tuple[Tensor, Tensor]]) -> list[Any]:
    """Meshes side by side at one scale."""
    placed = [(center(verts[None])[0], faces) for verts, faces in meshes]
    everything = torch.cat([verts for verts, _ in placed])
    bounds = torch.stack([everything.amin(0), everything.amax(0)])
    return [render(verts, faces, bounds=bounds, size=PICTURE) for verts, faces in placed]


def save(sheet: Any, path: Path) -> None:
    with atomic_write(path) as temporary:
        sheet.quantize(128).save(temporary, format="PNG", optimize=True)


@torch.no_grad()
def transfer_sheet(path: Path, kind: str, columns: dict[str, str], rows: Iterable[int], cfg: Any) -> None:
    """Rows of test pairs: identity, pose, what each system makes of it, and the truth."""
    pairs = test_pairs(kind, None, cfg.eval_pairs, cfg.out)
    nets = {title: generator_of(name, cfg.out).eval() for title, name in columns.items()}
    grid, captions = [], []
    for i in (row for row in rows if row < len(pairs)):
        batch = pairs[[(0, i)]]
        faces, truth = batch.identity_faces[0], batch.ground_truth[0]
        outputs = [center(generate(net, batch, i).vertices)[0] for net in nets.values()]
        sides = [(batch.identity[0], faces), (batch.pose[0], batch.pose_faces[0])]
        grid.append(pictures([*sides, *((o, faces) for o in outputs), (truth, faces)]))
        captions.append(["", "", *(score(o, truth) for o in outputs), ""])
    titles = ["identity", "pose", *nets, "ground truth"]
    save(contact_sheet(grid, column_titles=titles, captions=captions), path)


@torch.no_grad()
def noise_curve(count: int = NOISE_PAIRS) -> dict[str, list[float]]:
    """Mean PMD (e-3) of the shipped weights over ``count`` test pairs whose pose meshes are noisy."""
    body, split = shipped("humans", 1000)
    curve: dict[str, list[float]] = {"sigma_mm": list(NOISE)}
    for name in WEIGHTS:
        net = pretrained(name)
        curve[name] = []
        for sigma in NOISE:
            chosen = tqdm(split.test_pairs[:count], desc=f"{name}, noise {sigma:g} mm", unit="pair", dynamic_ncols=True)
            errors = [noisy(net, body, pair, sigma)[3] for pair in chosen]
            curve[name].append(sum(errors) / count)
    return curve


def noisy(net: Any, body: Any, pair: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor, float]:
    """Identity, noisy pose mesh, result, and its PMD (e-3)."""
    a, p, b, q = pair[:, None]
    identity, pose, truth = body(a, p)[0], body(b, q)[0], body(a, q)
    draw = torch.Generator().manual_seed(int(pair.sum()))
    pose = pose + 1e-3 * sigma * torch.randn(pose.shape, generator=draw)
    output = net(identity, pose, identity_faces=body.faces, pose_faces=body.faces)
    return identity, pose, output, 1e3 * float(pmd(output[None], center(truth))[0])


@torch.no_grad()
def topology_errors(count: int = TOPOLOGY_PAIRS) -> dict[str, Any]:
    """Mean PMD (e-3) of the shipped weights on bodies of other triangulations, all pairs of their sizes."""
    _, split = shipped("humans", 1000)
    bodies = {size: shipped("humans", size)[0] for size in SIZES}
    nets = [pretrained(name) for name in WEIGHTS]
    table: dict[str, list[float]] = {}
    for first, one in bodies.items():
        for second, two in bodies.items():
            errors = torch.zeros(len(nets))
            title = f"shipped weights, {first} and {second} vertices"
            for a, p, b, q in tqdm(split.test_pairs[:count, :, None], desc=title, unit="pair", dynamic_ncols=True):
                identity, pose, truth = one(a, p)[0], two(b, q)[0], center(one(a, q))
                for j, net in enumerate(nets):
                    output = net(identity, pose, identity_faces=one.faces, pose_faces=two.faces)
                    errors[j] += 1e3 * float(pmd(output[None], truth)[0]) / count
            table[f"{first}, {second}"] = errors.tolist()
    return {"weights": list(WEIGHTS), "pmd": table}


@torch.no_grad()
def topology_sheet(path: Path) -> None:
    """One pose on bodies of different triangulations, and on a coarse one of none of the shipped topologies."""
    _, split = shipped("humans", 1000)
    net, grid, captions = pretrained(TOPOLOGY_WEIGHTS), [], []
    for a, p, b, q in split.test_pairs[2:5, :, None]:
        two = shipped("humans", 3445)[0]
        pose = (two(b, q)[0], two.faces)
        shown = [pose]
        for size in (1000, 2000):
            one = shipped("humans", size)[0]
            identity = one(a, p)[0]
            shown += [(identity, one.faces)]
            shown += [(net(identity, pose[0], identity_faces=one.faces, pose_faces=two.faces), one.faces)]
        fine = shipped("humans", 6890)[0]
        coarse = simplify(fine(a, p)[0], fine.faces, COARSE)
        shown += [(coarse.verts, coarse.faces)]
        output = net(coarse.verts, pose[0], identity_faces=coarse.faces, pose_faces=two.faces)
        grid.append(pictures([*shown, (output, coarse.faces)]))
        captions.append(["", *("", TOPOLOGY_WEIGHTS) * 3])
    titles = ["pose, 3445", "identity, 1000", "output", "identity, 2000", "output", f"identity, {COARSE}", "output"]
    save(contact_sheet(grid, column_titles=titles, captions=captions), path)


@torch.no_grad()
def correspondence_sheet(path: Path, cfg: Any) -> None:
    """Matches of the shipped weights between two bodies; lines of those more than 10 cm off are red."""
    row = min(5, cfg.eval_pairs - 1)
    batch = test_pairs("humans", None, cfg.eval_pairs, cfg.out)[[(0, row)]]
    result = generate(generator_of(MATCHING_WEIGHTS, cfg.out).eval(), batch, row)
    matches = result.plan.argmax()[0]
    off = (batch.pose[0, matches] - batch.pose[0, batch.correspondence[0]]).norm(dim=1)
    figure = correspondence_figure(
        (batch.identity[0], batch.identity_faces[0]),
        (batch.pose[0], batch.pose_faces[0]),
        matches,
        correct=off < 0.1,
        titles=[f"identity, matched by {MATCHING_WEIGHTS}", "pose"],
    )
    save(figure, path)


@torch.no_grad()
def noise_sheet(path: Path) -> None:
    """A pose mesh with more and more noise, and what becomes of the result."""
    body, split = shipped("humans", 1000)
    net, grid, captions = pretrained(NOISE_WEIGHTS), [], []
    for i in (1, 4):
        found = [noisy(net, body, split.test_pairs[i], sigma) for sigma in NOISE]
        meshes = [(found[0][0], body.faces)] + [(m, body.faces) for f in found for m in (f[1], f[2])]
        grid.append(pictures(meshes))
        captions.append([NOISE_WEIGHTS, *(text for f in found for text in ("", f"PMD {f[3]:.1f}e-3"))])
    titles = ["identity", *(text for sigma in NOISE for text in (f"pose, {sigma:g} mm", "output"))]
    save(contact_sheet(grid, column_titles=titles, captions=captions), path)


def draw_sheets(
    to: Path, jobs: list[Job], noise: dict[str, list[float]] | None, errors: Callable[[Job], list[float]], cfg: Any
) -> list[str]:
    """All sheets; those of systems show the first of a system's runs among ``jobs``. Without ``noise`` these alone.

    ``errors`` gives the PMD of every test pair of a run. Returns the names of what was drawn.
    """
    there = {(job.data, job.system): job for job in reversed(jobs)}
    drawn = []

    def sheet(name: str, draw: Callable[..., None], *arguments: Any) -> None:
        print(f"sheet {name}", flush=True)
        draw(to / f"{name}.png", *arguments)
        drawn.append(name)

    for kind in cfg.data:
        for name, systems, rows in (
            (f"comparison-{kind}", ("npt", "cycle", "corenet3d", "xdualnet"), (0, 3, 7, 11)),
            ("ablation", ABLATED if kind == "humans" else (), (0, 3, 7)),
        ):
            columns = {SYSTEMS[s].title: there[kind, s].name for s in systems if (kind, s) in there}
            if columns:
                sheet(name, transfer_sheet, kind, columns, rows, cfg)
        if (kind, "xdualnet") in there:
            job = there[kind, "xdualnet"]
            worst = torch.tensor(errors(job)).topk(min(4, cfg.eval_pairs)).indices.tolist()
            columns = {"X-DualNet": job.name, f"xdualnet-{kind}, shipped": f"xdualnet-{kind}"}
            sheet(f"failures-{kind}", transfer_sheet, kind, columns, worst, cfg)
    if "humans" in cfg.data and noise is not None:
        sheet("topologies", topology_sheet)
        sheet("correspondence", correspondence_sheet, cfg)
        sheet("noise", noise_sheet)
        series = {name: (noise["sigma_mm"], noise[name]) for name in WEIGHTS}
        plot_curves(to / "noise_curve.png", series, xlabel="noise of the pose mesh (mm)", ylabel="PMD (1e-3 m²)")
        drawn.append("noise_curve")
    return drawn
