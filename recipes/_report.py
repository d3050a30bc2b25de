"""What a run leaves behind: figures on unseen pairs, curves, a contact sheet and meshes."""

from __future__ import annotations

from typing import Any

import torch
from _data import Pairs, inputs, told, unit_of
from _run import Run
from torch import Tensor, nn

from meshkit.batching import center
from meshkit.data import PairBatch, PosePairs
from meshkit.io import save_mesh
from meshkit.metrics import chamfer_distance, correspondence_error, pmd
from meshkit.viz import contact_sheet, error_colors, plot_curves, render


@torch.no_grad()
def evaluate(generator: nn.Module, pairs: Pairs, device: torch.device, count: int, unit: str) -> dict[str, float]:
    """Means over ``count`` unseen pairs, of the output and of two baselines; PMD and Chamfer times 1000.

    Empty where neither ground truth nor correspondence is known.
    """
    training = generator.training
    generator.eval()
    columns: dict[str, list[Tensor]] = {}
    together = 4 if isinstance(pairs, PosePairs) else 1  # meshes from files differ in size
    for start in range(0, count, together):
        batch = pairs[[(0, i) for i in range(start, min(start + together, count))]].to(device)
        result = generate(generator, batch, start)
        candidates = {"": result.vertices, "_copy_identity": batch.identity}
        if result.warped is not None:
            candidates["_copy_warped"] = result.warped
        for name, verts in candidates.items() if batch.ground_truth.shape[1] else ():
            columns.setdefault(f"pmd{name}", []).append(1e3 * pmd(verts, batch.ground_truth))
            columns.setdefault(f"chamfer{name}", []).append(1e3 * chamfer_distance(center(verts), batch.ground_truth))
        if result.plan is not None and bool((batch.correspondence >= 0).all()):
            matched = correspondence_error(result.plan.argmax(), batch.pose, batch.correspondence)
            columns.setdefault(f"correspondence_{unit}", []).append(matched)
    generator.train(training)
    return {name: round(float(torch.cat(values).mean()), 4) for name, values in columns.items()}


def generate(generator: nn.Module, batch: PairBatch, place: int) -> Any:
    """The generator's result; one that is told more than the meshes takes the batch and its place among the pairs."""
    if getattr(generator, "takes_batches", False):
        return generator(batch, place)
    known = inputs(batch) | {"identity_faces": batch.identity_faces}
    return generator(batch.identity, batch.pose, **told(generator, known))


def report(
    run: Run, generator: nn.Module, pairs: Pairs, device: torch.device, facts: dict[str, Any], *, kind: str
) -> None:
    """Evaluate on unseen pairs of ``kind`` of data; write summary.json, curves.png, pmd.png, sheet.png and meshes/."""
    unit = unit_of(kind)
    figures = evaluate(generator, pairs, device, len(pairs), unit)
    summary = {
        "test": figures,
        "test_pairs": len(pairs),
        "units": f"PMD and Chamfer (squared, both directions summed) in 1e-3 {unit}^2, correspondence in {unit}",
        **facts,
        "parameters": sum(p.numel() for p in generator.parameters()),
        "machine": run.load_json("machine.json"),
        "threads": torch.get_num_threads(),
    }
    run.save_json("summary.json", summary)
    draw_curves(run, unit)
    draw_sheet(run, generator, pairs, device, unit)
    print(f"\n{len(pairs)} unseen pairs        PMD e-3   Chamfer e-3" if "pmd" in figures else "")
    for title, key in (("copy the identity", "_copy_identity"), ("copy the warped", "_copy_warped"), ("output", "")):
        if f"pmd{key}" in figures:
            print(f"  {title:<20} {figures[f'pmd{key}']:8.2f}   {figures[f'chamfer{key}']:8.2f}")
    off = figures.get(f"correspondence_{unit}")
    if off is not None:
        length = f"{100 * off:.1f} cm" if unit == "m" else f"{off:.3f} {unit}"
        print(f"matched vertices are {length} from the true ones on average")
    print(f"pictures, meshes and figures: {run.folder}")


def draw_curves(run: Run, unit: str) -> None:
    records = run.read_log()
    if not records:
        return
    names = [name for name in records[-1] if name not in ("step", "seconds", "eval")]
    window = max(1, len(records) // 100)
    minutes = torch.tensor([record["seconds"] / 60 for record in records])
    series = {}
    for name in names:
        values = torch.tensor([record[name] for record in records])
        smooth = torch.nn.functional.avg_pool1d(values[None], window, window)[0]
        series[name] = (torch.nn.functional.avg_pool1d(minutes[None], window, window)[0], smooth)
    plot_curves(run.path("curves.png"), series, xlabel="training time (minutes)", ylabel="weighted loss", logy=True)
    points = [(r["seconds"] / 60, r["eval"]["pmd"]) for r in records if "pmd" in r.get("eval", {})]
    if points:
        plot_curves(
            run.path("pmd.png"),
            {"unseen pairs": ([t for t, _ in points], [value for _, value in points])},
            xlabel="training time (minutes)",
            ylabel=f"PMD (1e-3 {unit}²)",
            logy=False,
        )


@torch.no_grad()
def draw_sheet(run: Run, generator: nn.Module, pairs: Pairs, device: torch.device, unit: str, *, rows: int = 6) -> None:
    """Rows of pictures, and the meshes as files; ground truth and error where they are known."""
    generator.eval()
    worst, sheet, captions, titles = 0.15, [], [], [""]
    for b in range(min(rows, len(pairs))):
        batch = pairs[[(0, b)]].to(device)
        result = generate(generator, batch, b)
        faces, output = batch.identity_faces[0], center(result.vertices)[0]
        views: dict[str, tuple[Tensor, Tensor, Any]] = {"identity": (batch.identity[0], faces, None)}
        views["pose"] = (batch.pose[0], batch.pose_faces[0], None)
        if result.warped is not None:
            views["warped"] = (center(result.warped)[0], faces, None)
        views["output"] = (output, faces, None)
        captions.append([""] * len(views))
        if batch.ground_truth.shape[1]:
            truth = batch.ground_truth[0]
            views["ground truth"] = (truth, faces, None)
            views["error"] = (output, faces, error_colors((output - truth).norm(dim=1), vmax=worst))
            captions[-1][-1] = f"PMD {1e3 * float(pmd(output[None], batch.ground_truth)):.1f}e-3"
            captions[-1] += ["", ""]
        # One scale per row, so that sizes can be compared.
        everything = torch.cat([verts for verts, _, _ in views.values()])
        bounds = torch.stack([everything.amin(0), everything.amax(0)])
        sheet.append([render(verts, f, colors=colors, bounds=bounds) for verts, f, colors in views.values()])
        titles = list(views)
        for name in ("identity", "pose", "output", "ground truth"):
            if name in views:
                save_mesh(run.path("meshes") / f"pair{b}_{name.replace(' ', '_')}.obj", *views[name][:2])
    bar = (100 * worst, "cm") if unit == "m" else (worst, unit)
    colorbar = (0.0, bar[0], f"distance to ground truth ({bar[1]})") if "error" in titles else None
    contact_sheet(sheet, column_titles=titles, captions=captions, colorbar=colorbar).save(run.path("sheet.png"))
