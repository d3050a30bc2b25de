"""The recipe of the paper's tables: which runs it asks for, what it makes of them, that it goes on where it stopped."""

import csv
import json
import math
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from recipe_runs import recipe_module
from safetensors.torch import save_file

from meshkit.batching import center
from meshkit.data import human_split, load_humans
from meshkit.metrics import chamfer_distance, earth_movers_distance, edge_ratio, pmd
from meshkit.models import GeneratorConfig

pytest.importorskip("tyro")
pytest.importorskip("lightning_fabric")

MODEL = GeneratorConfig(architecture="npt_maxpool", extractor_widths=(4, 4, 5))


@pytest.fixture
def config(tmp_path: Path) -> Any:
    return recipe_module("paper_tables").Config(
        data=("humans",), pairs=8, seeds=2, eval_pairs=3, emd_pairs=2, large_pairs=0, sheets="none", out=tmp_path
    )


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Path]:
    """Runs the recipe's ``main`` without training, on three test pairs, and gives the tables' folder."""

    def tables(*arguments: Any) -> Path:
        words = [
            "--data",
            "humans",
            "--pairs",
            8,
            "--seeds",
            2,
            "--eval-pairs",
            3,
            "--emd-pairs",
            2,
            "--large-pairs",
            0,
        ]
        words = ["paper_tables.py", *words, "--no-train", "--sheets", "none", "--out", tmp_path, *arguments]
        monkeypatch.setattr(sys, "argv", [str(word) for word in words])
        recipe_module("paper_tables").main()
        return tmp_path

    return tables


def finished_run(folder: Path, seed: int, **changes: Any) -> torch.nn.Module:
    """A run's folder as the NPT recipe leaves it, and its generator."""
    folder.mkdir()
    torch.manual_seed(seed)
    net = MODEL.build()
    save_file({k: v.contiguous() for k, v in net.state_dict().items()}, folder / "model.safetensors")
    (folder / "model.json").write_text(json.dumps(asdict(MODEL)))
    (folder / "config.json").write_text("{}")
    (folder / "budget.json").write_text(json.dumps({"preset": "tiny", "batch": 4, "pairs": 8} | changes))
    (folder / "summary.json").write_text("{}")
    return net.eval()


def figures_of(net: torch.nn.Module) -> dict[str, float]:
    """PMD, Chamfer, changes of edges and earth mover's distance on the first test pairs, in the tables' units."""
    body, found = load_humans(1000), {"pmd": [], "cd": [], "edges": [], "emd": []}
    for i, (a, p, b, q) in enumerate(human_split().test_pairs[:3].tolist()):
        who, how = torch.tensor([a, b, a]), torch.tensor([p, q, q])
        identity, pose, truth = center(body(who, how))[:, None]
        with torch.no_grad():
            output = center(net(identity, pose).vertices)
        found["pmd"].append(1e3 * float(pmd(output, truth)))
        found["cd"].append(1e3 * float(chamfer_distance(output, truth)))
        found["edges"].append(1e2 * float(edge_ratio(output, truth, body.faces)))
        if i < 2:
            found["emd"].append(1e2 * float(earth_movers_distance(output, truth)))
    return {name: sum(values) / len(values) for name, values in found.items()}


def test_every_system_comes_before_the_second_seed_of_any() -> None:
    train = recipe_module("_tables_train")
    listed = train.jobs(("humans", "animals"), 2)
    assert len(listed) == 2 * (len(train.SYSTEMS) + len(train.COMPARED))
    assert [job.seed for job in listed] == sorted(job.seed for job in listed)
    assert {job.system for job in listed if job.data == "animals"} == set(train.COMPARED)
    assert len({job.name for job in listed}) == len(listed)


def test_every_command_is_one_that_its_recipe_takes(config: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    train, settings = recipe_module("_tables_train"), recipe_module("_settings")
    for system in train.SYSTEMS:
        file, *flags = train.command(train.Job("humans", system, 1), config)
        monkeypatch.setattr(sys, "argv", [file, *flags])
        parsed = settings.parse(recipe_module(Path(file).stem).PRESETS, None)
        assert (parsed.seed, parsed.steps, parsed.batch, parsed.data) == (1, 2, 4, "humans")
        file, *flags = train.command(train.Job("humans", system, 1), replace(config, minutes=5.0, preset="small"))
        monkeypatch.setattr(sys, "argv", [file, *flags])
        parsed = settings.parse(recipe_module(Path(file).stem).PRESETS, None)
        assert (parsed.steps, parsed.minutes) == (None, 5.0), "the preset's steps do not count"


def test_tables_hold_means_and_spreads_over_runs(tables: Callable[..., Path], tmp_path: Path) -> None:
    direct = [figures_of(finished_run(tmp_path / f"humans-npt-{seed}", seed)) for seed in (0, 1)]
    folder = tables()
    with (folder / "comparison-humans.csv").open() as stream:
        rows = {row["method"]: row for row in csv.DictReader(stream)}
    npt = rows["NPT"]
    assert npt["runs"] == "2"
    for metric in ("pmd", "cd", "emd", "edges"):
        first, second = (figures[metric] for figures in direct)
        assert float(npt[f"{metric} mean"]) == pytest.approx((first + second) / 2, rel=1e-3)
        assert float(npt[f"{metric} spread"]) == pytest.approx(abs(first - second) / math.sqrt(2), rel=2e-2, abs=1e-3)
    assert npt["match mean"] == ""  # it matches nothing
    assert float(npt["pmd paper"]) == 2.77
    assert float(rows["deformation transfer"]["pmd mean"]) < float(rows["copy the identity"]["pmd mean"])
    text = (folder / "tables.md").read_text()
    assert text.startswith("# The paper's tables after 8 training pairs\n"), "pages of several budgets are told apart"
    assert "humans corenet3d (2)" in text and "animals npt (2)" in text, "runs that are missing are named"
    assert "recipes/npt.py" in text and "--seed 1" in text
    assert "`±` is the standard deviation" in text
    made_by = "python recipes/paper_tables.py --data humans --pairs 8 --seeds 2 --eval-pairs 3 --emd-pairs 2 "
    assert f"{made_by}--large-pairs 0\n" in text, "the command of the tables themselves"


def test_words_are_explained_where_they_are_used(config: Any) -> None:
    write = recipe_module("_tables_write")

    def row(metric: str, spread: float, runs: int) -> Any:
        return write.Row("NPT", {"pmd": (1.0, spread), metric: (2.0, spread)}, runs, {"pmd": 3.0})

    single = {"comparison-humans": [row("cd", math.nan, 1)]}
    text = write.budget_text(single, config, [])
    assert "on SMPL, after" in text
    assert not any(word in text for word in ("±", "animals", "SMAL", "Edges:", "Match error", "Runs that"))
    assert "Edges: mean" in write.budget_text({"comparison-humans": [row("edges", math.nan, 1)]}, config, [])
    both = single | {"comparison-animals": [row("match", 0.1, 3)]}
    text = write.budget_text(both, config, [])
    for words in ("`±` is", "on SMPL and SMAL", "animals with 1962", "humans in centimetres, of animals in hundredths"):
        assert words in text
    assert write.table(both["comparison-animals"], write.HEADS).splitlines()[0] == (
        "| method | runs | PMD (e-3) | match error (e-2) |"
    )
    assert "| match error (cm) |" in write.table(both["comparison-animals"], write.HEADS_OF_HUMANS)


def test_what_is_measured_once_says_on_how_many_pairs_and_by_which_command() -> None:
    write, sheets = recipe_module("_tables_write"), recipe_module("_tables_sheets")
    extra = {
        "seconds": {"seconds": {"NPT": 1.0}, "threads": 1, "processor": "P"},
        "noise": {"sigma_mm": [0.0], "a": [1.0]},
        "topologies": {"weights": ["a"], "pmd": {"1000, 1000": [1.0]}},
    }
    times, noise, triangulations = write.measured_once(extra, {"NPT": 0.5}, "`the command`")
    assert f"first {sheets.NOISE_PAIRS} test pairs" in noise.splitlines()[0]
    assert f"first {sheets.TOPOLOGY_PAIRS} test pairs" in triangulations.splitlines()[0]
    assert all("`the command`" in part for part in (times, noise, triangulations))
    assert "s (P, 1 thread)" in times


def test_measurements_are_made_once(
    tables: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished_run(tmp_path / "humans-npt-0", 0)
    before = (tables() / "tables.md").read_text()
    for module in ("paper_tables", "_tables_measure"):
        monkeypatch.setattr(recipe_module(module), "measure", None)
    assert (tables() / "tables.md").read_text() == before
    with pytest.raises(TypeError):  # another number of pairs is another measurement
        tables("--emd-pairs", 1)


def test_noise_and_triangulations_are_measured_anew_for_other_weights(
    config: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, made = recipe_module("paper_tables"), []
    for name in ("seconds_per_transfer", "noise_curve", "topology_errors"):
        monkeypatch.setattr(recipe, name, lambda name=name: made.append(name) or len(made))
    first = recipe.measured_once(config)
    assert first == recipe.measured_once(config) == {"seconds": 1, "noise": 2, "topologies": 3}
    finished_run(config.out / "corenet3d-humans", 0)  # a run of the name of shipped weights is not what is measured
    assert recipe.measured_once(config) == first
    other = config.out / "corenet3d-humans" / "model.safetensors"
    monkeypatch.setattr(recipe, "shipped_file", lambda name: other)
    assert recipe.measured_once(config) == {"seconds": 1, "noise": 4, "topologies": 5}


def test_a_run_with_another_budget_is_refused(tables: Callable[..., Path], tmp_path: Path) -> None:
    finished_run(tmp_path / "humans-npt-0", 0, pairs=12)
    with pytest.raises(recipe_module("_run").UserError, match=r"humans-npt-0 was begun with the budget .*'pairs': 12"):
        tables()


def test_training_shares_descriptors_and_goes_on_after_a_failure(config: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    train, ran = recipe_module("_tables_train"), []
    status = {"cycle": 3}

    def run_to_end(words: list[str], environment: dict[str, str]) -> int:
        folder = config.out / words[words.index("--name") + 1]
        ran.append(folder.name)
        if len(ran) > 1:
            assert (folder / "pool_train.safetensors").read_text() == "pool"
        (folder / "pool_train.safetensors").write_text("pool")
        (folder / "config.json").write_text("{}")
        result = status.get(folder.name.split("-")[1], 0)
        if result == 0:
            (folder / "summary.json").write_text("{}")
        return result

    monkeypatch.setattr(train, "run_to_end", run_to_end)
    wanted = [train.Job("humans", system, 0) for system in ("corenet3d", "cycle", "npt")]
    failures = {job.system: failure for job, failure in train.train_missing(wanted, config)}
    assert failures["corenet3d"] is failures["npt"] is None
    assert failures["cycle"].endswith("ended with status 3") and "recipes/cycle_baseline.py" in failures["cycle"]
    status.clear()
    assert [job.system for job, _ in train.train_missing(wanted, config)] == ["cycle"], "what is done stays done"
    for other in (replace(config, pairs=12), replace(config, minutes=8.0)):
        with pytest.raises(recipe_module("_run").UserError, match="humans-corenet3d-0 was begun with the budget"):
            train.finished(wanted[0], other)


def test_a_recipe_is_waited_for_when_interrupted() -> None:
    train = recipe_module("_tables_train")
    slow = "import time; time.sleep(1.5); raise SystemExit(7)"
    before = signal.getsignal(signal.SIGINT)
    timer = threading.Timer(0.7, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    assert train.run_to_end([sys.executable, "-c", slow], dict(os.environ)) == 7, "not killed half-way"
    timer.join()
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt):
        train.run_to_end([sys.executable, "-c", "raise SystemExit(130)"], dict(os.environ))


def test_the_order_of_methods_says_where_spreads_overlap() -> None:
    write = recipe_module("_tables_write")

    def row(title: str, mean: float, spread: float, paper: float) -> Any:
        return write.Row(title, {"pmd": (mean, spread)}, 3, {"pmd": paper})

    rows = [row("a", 3.0, 0.1, 1.0), row("b", 2.0, 0.1, 2.0), row("c", 2.15, 0.1, 3.0)]
    assert write.order(rows).startswith("PMD here: b ~ c < a. Paper: a < b < c.")  # two standard errors are 0.163
    single = [replace(r, runs=1, figures={"pmd": (r.figures["pmd"][0], math.nan)}) for r in rows]
    said = write.order(single)
    assert said.startswith("PMD here: b ? c ? a.")
    assert "`?`: a single run" in said and "`<`" not in said and "`~`" not in said, "signs that are used are explained"


def test_ablations_are_compared_seed_by_seed() -> None:
    write = recipe_module("_tables_write")

    def row(title: str, **by_seed: float) -> Any:
        return write.Row(title, {"pmd": (0.0, 0.0)}, len(by_seed), {}, {int(k[1:]): v for k, v in by_seed.items()})

    whole = row("whole", s0=8.0, s1=11.0, s2=7.0)
    said = write.paired([row("without a", s0=7.5, s1=10.7, s2=6.9), row("without b", s0=9.0, s2=9.0), whole])
    assert said == (
        "PMD less that of whole with the same seed and pairs: without a -0.30 ± 0.20 (-0.50, -0.30, -0.10); "
        "without b +1.50 ± 0.71 (+1.00, +2.00).\n"
    )
    assert write.paired([row("without a", s0=7.5), whole]) == "", "one pair of runs has no spread"


def test_sheets_are_drawn_of_what_there_is(config: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sheets, train = recipe_module("_tables_sheets"), recipe_module("_tables_train")
    monkeypatch.setattr(sheets, "NOISE", (0.0, 5.0))
    for name in ("topology_sheet", "noise_sheet"):  # pictures of the shipped weights: seconds each, tried below
        monkeypatch.setattr(sheets, name, lambda path: path.write_bytes(b""))
    measure, read = recipe_module("_tables_measure"), []
    load_file = measure.load_file
    monkeypatch.setattr(measure, "load_file", lambda file: read.append(file) or load_file(file))
    finished_run(tmp_path / "humans-npt-0", 0)
    noise = sheets.noise_curve(count=1)
    assert all(len(noise[name]) == 2 and min(noise[name]) > 0 for name in sheets.WEIGHTS)
    drawn = sheets.draw_sheets(tmp_path, [train.Job("humans", "npt", 0)], noise, lambda job: [1.0, 2.0, 3.0], config)
    assert drawn == ["comparison-humans", "topologies", "correspondence", "noise", "noise_curve"]
    assert [file.name for file in read] == ["descriptors-humans-1000-3.safetensors"], "read once for all sheets"
    drawn = sheets.draw_sheets(tmp_path, [train.Job("humans", "npt", 0)], None, lambda job: [1.0, 2.0, 3.0], config)
    assert drawn == ["comparison-humans"], "sheets of the runs alone"
    with Image.open(tmp_path / "comparison-humans.png") as picture:  # two of the four rows exist
        colors = picture.convert("RGB").getcolors(maxcolors=1 << 16)
    assert colors is not None and len(colors) > 40, "an empty sheet has white alone"


def test_bad_counts_are_named(tables: Callable[..., Path]) -> None:
    with pytest.raises(recipe_module("_run").UserError, match="multiple of --batch 3"):
        tables("--batch", 3)
    with pytest.raises(recipe_module("_run").UserError, match="there are 400 test pairs"):
        tables("--eval-pairs", 500)
    with pytest.raises(recipe_module("_run").UserError, match="cannot be negative"):
        tables("--large-pairs", -1)
    with pytest.raises(recipe_module("_run").UserError, match="twice: humans humans"):
        tables("--data", "humans", "humans")


def test_sheets_name_the_shipped_weights_they_are_made_with(
    config: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sheets, write, said = recipe_module("_tables_sheets"), recipe_module("_tables_write"), {}

    def contact_sheet(grid: Any, *, column_titles: list[str], captions: list[list[str]]) -> Any:
        assert all(len(row) == len(column_titles) for row in captions)
        return [*column_titles, *captions[0]]

    def transfer_sheet(path: Path, kind: str, columns: dict[str, str], *rest: Any) -> None:
        said[path.stem] = list(columns)

    monkeypatch.setattr(sheets, "contact_sheet", contact_sheet)
    monkeypatch.setattr(sheets, "correspondence_figure", lambda *meshes, titles, **options: titles)
    monkeypatch.setattr(sheets, "pictures", lambda meshes: [None] * len(meshes))
    monkeypatch.setattr(sheets, "save", lambda sheet, path: said.update({path.stem: sheet}))
    monkeypatch.setattr(sheets, "NOISE", (0.0,))
    monkeypatch.setattr(sheets, "transfer_sheet", transfer_sheet)
    monkeypatch.setattr(sheets, "plot_curves", lambda *arguments, **options: None)
    job = recipe_module("_tables_train").Job("humans", "xdualnet", 0)
    noise = {"sigma_mm": [0.0], **{name: [1.0] for name in sheets.WEIGHTS}}
    sheets.draw_sheets(tmp_path, [job], noise, lambda job: [1.0, 2.0, 3.0], config)
    for name, weights in (
        ("topologies", "corenet3d-humans"),
        ("correspondence", "xdualnet-humans"),
        ("noise", "corenet3d-humans"),
        ("failures-humans", "xdualnet-humans"),
    ):
        assert any(weights in text for text in said[name]), name
        assert weights in write.SHEETS[name], name
    assert "identity, 700" in said["topologies"] and "700 vertices" in write.SHEETS["topologies"]
