"""The X-DualNet recipe as a user runs it: what a run leaves, what a killed one resumes, what mistakes are answered."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from recipe_runs import ROOT, command, environment, launch, read_json, read_log, recipe_module
from safetensors.torch import load_file
from scipy.spatial import cKDTree

from meshkit.data import MeshPool, PairSampler, PosePairs, human_split, load_humans, pair_loader
from meshkit.io import load_mesh, save_mesh
from meshkit.models import GeneratorConfig, load_generator

pytest.importorskip("tyro")
Fabric = pytest.importorskip("lightning_fabric").Fabric

STEPS, BATCH, EVAL_PAIRS = 8, 2, 4
# The processor and full precision, so that runs repeat bit for bit wherever the tests run.
TINY = (
    "--threads 1 --accelerator cpu --precision 32-true --pool 6 --pairs 40 --points 64 --eval-every 4 --save-every 2 "
    f"--batch {BATCH} --eval-pairs {EVAL_PAIRS} --model.widths 16 8 --model.extractor-widths 8 8 --model.k 6"
).split()


@pytest.fixture(scope="module")
def recipe() -> ModuleType:
    return recipe_module("xdualnet")


@pytest.fixture(scope="module")
def setup() -> ModuleType:
    return recipe_module("_setup")


@pytest.fixture(scope="module")
def loop() -> ModuleType:
    return recipe_module("_step")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """A whole run in the folder ``runs/whole`` of its own base folder, shared by the tests: they must not change it."""
    out = tmp_path_factory.mktemp("finished")
    run = launch("xdualnet", "--out", out, "--name", "whole", "--steps", STEPS, *TINY)
    assert run.returncode == 0, run.stderr
    return run


@pytest.fixture(scope="module")
def whole(finished: subprocess.CompletedProcess[str]) -> Path:
    arguments = finished.args
    return Path(arguments[arguments.index("--out") + 1]) / "whole"


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    """A copy of the run without its pictures and meshes, to be damaged."""
    folder = tmp_path / "copied"
    folder.mkdir()
    for file in whole.iterdir():
        if file.is_file() and file.suffix != ".png":
            (folder / file.name).write_bytes(file.read_bytes())
    return folder


@pytest.fixture
def refuse(recipe: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs the recipe in this process with arguments that it must refuse: status 2 and one line, which is returned."""

    def run(*arguments: Any) -> str:
        monkeypatch.setattr(sys, "argv", ["xdualnet.py", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            recipe.guard(recipe.main)
        assert caught.value.code == 2
        # Progress bars rewrite their line; what is left on the screen besides them is the error, on a line of its own.
        lines = [line for line in re.split(r"[\r\n]+", capsys.readouterr().err) if line and not line.endswith("]")]
        assert len(lines) == 1, lines
        assert lines[0].startswith("error: ")
        return lines[0]

    return run


# What a run leaves


def test_log_has_one_line_per_step(whole: Path) -> None:
    records = read_log(whole)
    assert [record["step"] for record in records] == list(range(1, STEPS + 1))
    assert [record["step"] for record in records if "eval" in record] == [4]
    for record in records:
        terms = [record[name] for name in ("rec_a", "rec_b", "corr", "edge")]
        assert all(np.isfinite(terms)) and min(terms) > 0
        assert record["loss"] == pytest.approx(sum(terms), rel=1e-5)
    seconds = [record["seconds"] for record in records]
    assert seconds == sorted(seconds)


def test_summary_holds_the_figures_of_the_run(whole: Path, finished: subprocess.CompletedProcess[str]) -> None:
    summary = read_json(whole / "summary.json")
    for name in ("", "_copy_identity", "_copy_warped"):
        assert summary["test"][f"pmd{name}"] > 0
        assert summary["test"][f"chamfer{name}"] > 0
        assert f"{summary['test'][f'pmd{name}']:.2f}" in finished.stdout
    assert summary["test"]["correspondence_m"] > 0
    assert (summary["steps"], summary["pairs_seen"]) == (STEPS, STEPS * BATCH)
    assert (summary["test_pairs"], summary["threads"]) == (EVAL_PAIRS, 1)
    # Rounded to hundredths of a minute.
    assert abs(summary["train_minutes"] - read_log(whole)[-1]["seconds"] / 60) < 0.006
    assert 0 <= summary["share_of_time_waiting_for_data"] < 1
    assert summary["machine"]["torch"] == torch.__version__
    assert summary["machine"]["cores"] == os.cpu_count()
    generator, _ = load_generator(whole)
    assert summary["parameters"] == sum(p.numel() for p in generator.parameters())


def test_figures_follow_from_the_saved_meshes(whole: Path) -> None:
    """PMD and Chamfer by their definitions, from the first pairs' files."""
    sums = dict.fromkeys(["pmd", "chamfer", "pmd_copy_identity", "chamfer_copy_identity"], 0.0)
    for b in range(EVAL_PAIRS):
        truth = load_mesh(whole / "meshes" / f"pair{b}_ground_truth.obj")[0].double().numpy()
        for suffix, name in (("", "output"), ("_copy_identity", "identity")):
            verts = load_mesh(whole / "meshes" / f"pair{b}_{name}.obj")[0].double().numpy()
            verts = verts - (verts.min(0) + verts.max(0)) / 2
            sums[f"pmd{suffix}"] += ((verts - truth) ** 2).mean()
            there, back = cKDTree(truth).query(verts)[0], cKDTree(verts).query(truth)[0]
            sums[f"chamfer{suffix}"] += (there**2).mean() + (back**2).mean()
    figures = read_json(whole / "summary.json")["test"]
    for name, total in sums.items():
        assert figures[name] == pytest.approx(1e3 * total / EVAL_PAIRS, rel=1e-3), name


def test_meshes_load(whole: Path) -> None:
    files = sorted((whole / "meshes").iterdir())
    kinds = ("ground_truth", "identity", "output", "pose")
    assert [file.name for file in files] == [
        f"pair{b}_{kind}.obj" for b in range(4) for kind in kinds
    ]  # one per test pair
    for file in files:
        verts, faces = load_mesh(file)
        assert (len(verts), len(faces)) == (1000, 1996)
    identity, output = (load_mesh(whole / "meshes" / f"pair0_{name}.obj") for name in ("identity", "output"))
    assert torch.equal(identity[1], output[1])


def test_pictures_open(whole: Path) -> None:
    for name in ("sheet.png", "curves.png"):
        with Image.open(whole / name) as picture:
            picture.load()
            assert min(picture.size) > 200
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 20


def test_no_half_written_files_remain(whole: Path) -> None:
    names = {file.name for file in whole.iterdir()}
    assert {"model.safetensors", "model.json", "config.json", "state.pt", "machine.json"} <= names
    assert not {name for name in names if name.startswith(".")}


def test_configuration_is_recorded(whole: Path, recipe: ModuleType) -> None:
    config = read_json(whole / "config.json")
    assert set(config) == {field.name for field in fields(recipe.Config)}
    assert (config["steps"], config["batch"], config["points"], config["precision"]) == (STEPS, BATCH, 64, "32-true")
    assert config["model"] == read_json(whole / "model.json")
    assert config["model"]["widths"] == [16, 8]


def test_training_shows_no_warnings(finished: subprocess.CompletedProcess[str]) -> None:
    assert "Warning" not in finished.stderr


# Resuming


def test_a_killed_run_resumes_as_if_nothing_had_happened(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    arguments = ("--out", tmp_path, "--name", "killed", "--steps", STEPS, *TINY)
    with subprocess.Popen(
        command("xdualnet", *arguments),
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        deadline = time.monotonic() + 120
        while not (folder / "state.pt").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    reached = torch.load(folder / "state.pt", weights_only=True)["step"]
    assert 0 < reached < STEPS
    assert not (folder / "summary.json").exists()
    # What a kill can leave besides: a step logged after the checkpoint, and half a line.
    with (folder / "log.jsonl").open("a") as stream:
        stream.write(json.dumps(read_log(whole)[reached] | {"loss": -1.0}) + '\n{"step": ' + str(reached + 2))

    run = launch("xdualnet", "--resume", *arguments)
    assert run.returncode == 0, run.stderr
    ours, theirs = load_file(folder / "model.safetensors"), load_file(whole / "model.safetensors")
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    timeless = [[{k: v for k, v in r.items() if k != "seconds"} for r in read_log(f)] for f in (folder, whole)]
    assert timeless[0] == timeless[1]
    summaries = [read_json(f / "summary.json") for f in (folder, whole)]
    assert summaries[0]["test"] == summaries[1]["test"]
    assert summaries[0]["pairs_seen"] == summaries[1]["pairs_seen"]
    configs = [read_json(f / "config.json") for f in (folder, whole)]
    changed = {name for name in configs[0] if configs[0][name] != configs[1][name]}
    assert changed <= {"name", "out", "resume"}


def test_an_interrupted_run_saves_the_step_it_was_in(tmp_path: Path) -> None:
    folder = tmp_path / "interrupted"
    arguments = ("--out", tmp_path, "--name", "interrupted", "--steps", 400, *TINY, "--save-every", 400)
    with subprocess.Popen(
        command("xdualnet", *arguments),
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        deadline = time.monotonic() + 120
        while not (folder / "log.jsonl").exists() or not (folder / "log.jsonl").read_text().count("\n"):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
        errors = process.communicate(timeout=60)[1]
        assert process.returncode == 130
    reached = torch.load(folder / "state.pt", weights_only=True)["step"]
    assert 1 <= reached < 400
    assert len(read_log(folder)) == reached
    assert f"interrupted after step {reached}, which is saved" in errors and "Traceback" not in errors


@pytest.mark.parametrize("preset", ["tiny", "paper"])
def test_the_recorded_configuration_is_the_one_resumed(recipe: ModuleType, setup: ModuleType, preset: str) -> None:
    begun = replace(recipe.PRESETS[preset], steps=77, seed=5, batch=3, arap_from=1.0, corr=False, data="animals")
    recorded = json.loads(json.dumps(asdict(begun), default=str))
    asked = replace(recipe.PRESETS["tiny"], name="other", out=Path("else"), resume=True, threads=1)
    expected = replace(begun, name="other", out=Path("else"), resume=True, threads=1)
    assert setup.resumed(asked, recorded) == expected


def test_an_existing_run_is_not_overwritten(whole: Path, refuse: Any) -> None:
    before = {file: file.stat().st_mtime_ns for file in whole.rglob("*")}
    line = refuse("--out", whole.parent, "--name", whole.name, "--steps", 1, *TINY[2:])
    assert str(whole) in line and "--resume" in line
    assert {file: file.stat().st_mtime_ns for file in whole.rglob("*")} == before


@pytest.mark.parametrize("name", ["state.pt", "config.json", "pool_train.safetensors"])
@pytest.mark.parametrize("damage", ["truncated", "empty"])
def test_a_damaged_file_is_named(copied: Path, refuse: Any, name: str, damage: str) -> None:
    content = (copied / name).read_bytes()
    (copied / name).write_bytes(content[: len(content) // 2] if damage == "truncated" else b"")
    line = refuse("--resume", "--out", copied.parent, "--name", copied.name, *TINY[2:])
    assert str(copied / name) in line


def test_a_pool_of_another_configuration_is_not_reused(recipe: ModuleType, tmp_path: Path) -> None:
    """A run killed before its first checkpoint may be begun anew with other values."""
    cfg = replace(recipe.PRESETS["tiny"], pool=3, eval_pairs=1)
    data, run = recipe_module("_data").data, recipe_module("_run").Run(tmp_path, resume=False)
    data(cfg, run, workers=1)
    model = replace(cfg.model, num_signatures=4)
    pairs, _ = data(replace(cfg, seed=1, model=model), run, workers=1)
    split = human_split()
    fresh = MeshPool.build(
        load_humans(), split.train_identities, split.train_poses, 3, num_signatures=4, num_eigenpairs=5, seed=1
    )
    assert torch.equal(pairs.pool.identity, fresh.identity)
    assert pairs.pool.descriptors.shape == fresh.descriptors.shape


@pytest.fixture
def diverging(copied: Path) -> list[Any]:
    """Arguments of a run whose first update is absurd; it saves a checkpoint at every step."""
    for name in ("state.pt", "config.json", "log.jsonl"):
        (copied / name).unlink()
    wild = ("--steps", STEPS, "--lr", 1e30, "--warmup", 0, "--save-every", 1)
    return ["--out", copied.parent, "--name", copied.name, *TINY[2:], *wild]


def test_divergence_is_told_in_one_line(diverging: list[Any], refuse: Any) -> None:
    line = refuse(*diverging)
    assert "the loss is" in line and "step 1" in line


def test_advice_on_divergence_works(
    recipe: ModuleType, setup: ModuleType, copied: Path, diverging: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["xdualnet.py", *map(str, diverging)])
    with pytest.raises(setup.UserError) as caught:
        recipe.main()
    advice = str(caught.value)
    if "checkpoint is sound" in advice:
        state = torch.load(copied / "state.pt", weights_only=True)
        assert all(value.abs().max() < 1e6 for value in state["model"].values())
    if "resume" in advice and "--lr" in advice:
        asked = replace(recipe.PRESETS["tiny"], lr=1e-5, resume=True)
        assert setup.resumed(asked, read_json(copied / "config.json")).lr == 1e-5


def test_measuring_the_speed_leaves_no_trace(recipe: ModuleType, loop: ModuleType, small: Any) -> None:
    cfg, _ = small
    cfg = replace(cfg, minutes=2.0, warmup=0)
    split = human_split()
    pairs = PosePairs(load_humans(), split.train_identities, split.train_poses, length=20)
    fabric = Fabric(accelerator="cpu", devices=1)
    generator, system = recipe.build(cfg)
    system, optimizer = fabric.setup(system, torch.optim.Adam(generator.parameters()))
    weights = {name: value.clone() for name, value in generator.state_dict().items()}
    loader = pair_loader(pairs, PairSampler(20, 2, stop=5))
    trainer = loop.Trainer(fabric, system, optimizer, cfg, recipe.step, 0)
    steps = loop.count_steps(trainer, loader)
    assert 10 < steps < 1_000_000
    assert all(torch.equal(value, weights[name]) for name, value in generator.state_dict().items())
    assert optimizer.state_dict()["state"] == {}
    trainer.cfg = replace(cfg, steps=7)
    assert loop.count_steps(trainer, loader) == 7


# Other ways to run


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mesh files, good and bad."""
    folder = tmp_path_factory.mktemp("meshes")
    body, other = load_humans(2000), load_humans(1000)
    save_mesh(folder / "identity.obj", 3 + body(torch.tensor([190]), torch.tensor([0]))[0], body.faces)
    save_mesh(folder / "pose.ply", other(torch.tensor([191]), torch.tensor([5]))[0], other.faces)
    text = (folder / "identity.obj").read_text().splitlines()
    (folder / "nan.obj").write_text("\n".join(["v nan 0 0", *text[1:]]))
    (folder / "points.obj").write_text("\n".join(line for line in text if line.startswith("v")))
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (folder / "tetrahedron.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (folder / "single.obj").write_text("v 0 0 0\nf 1 1 1\n")
    (folder / "loose.obj").write_text("\n".join([*text, "v 0 0 0"]))
    (folder / "text.obj").write_text("not a mesh")
    return folder


def test_pose_transfer_between_files_of_different_sizes(whole: Path, files: Path, tmp_path: Path) -> None:
    result = tmp_path / "new" / "posed.obj"
    pair = (files / "identity.obj", files / "pose.ply")
    run = launch("xdualnet", "--out", whole.parent, "--name", whole.name, "--apply", *pair, "--result", result)
    assert run.returncode == 0, run.stderr
    verts, faces = load_mesh(result)
    assert verts.shape == (2000, 3)
    assert torch.equal(faces, load_mesh(pair[0])[1])
    assert verts.std(0).min() > 0
    assert str(result) in run.stdout


def test_transfer_ignores_where_the_meshes_stand(recipe: ModuleType, whole: Path, files: Path, tmp_path: Path) -> None:
    verts, faces = load_mesh(files / "identity.obj")
    save_mesh(tmp_path / "moved.obj", verts + torch.tensor([8.0, -4, 2]), faces)
    results = []
    for name, file in (("a", files / "identity.obj"), ("b", tmp_path / "moved.obj")):
        result = tmp_path / f"{name}.obj"
        recipe.apply(whole, (file, files / "pose.ply"), result)
        results.append(load_mesh(result)[0])
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ("missing.obj", "no such file"),
        ("nan.obj", "NaN"),
        ("single.obj", "3 vertices or more"),
        ("points.obj", "no faces"),
        ("loose.obj", "1 of 2001 vertices"),
        ("tetrahedron.obj", "4 vertices; this model looks at 6 neighbours"),
        ("text.obj", "line 1|no vertices"),
    ],
)
@pytest.mark.parametrize("place", [0, 1])
def test_bad_meshes_are_named(
    whole: Path, files: Path, tmp_path: Path, refuse: Any, bad: str, said: str, place: int
) -> None:
    pair = [files / "identity.obj", files / "pose.ply"]
    pair[place] = files / bad
    result = tmp_path / "posed.obj"
    line = refuse("--out", whole.parent, "--name", whole.name, "--apply", *pair, "--result", result)
    assert str(files / bad) in line
    assert any(part in line for part in said.split("|"))
    assert not result.exists()


@pytest.fixture
def odd(files: Path, tmp_path: Path) -> Callable[[Any], Path]:
    """A pose mesh 1.7 m tall, changed."""
    verts, faces = load_mesh(files / "pose.ply")
    verts = verts * (1.7 / (verts.amax(0) - verts.amin(0))[2])

    def odd(change: Any) -> Path:
        save_mesh(tmp_path / "odd.obj", change(verts), faces)
        return tmp_path / "odd.obj"

    return odd


@pytest.mark.parametrize("scale", [100, 1000, 1 / 1000], ids=["cm", "mm", "km"])
def test_meshes_that_cannot_be_metres_are_refused(
    whole: Path, files: Path, refuse: Any, odd: Any, scale: float
) -> None:
    result = files / "never.obj"
    pair = (files / "identity.obj", odd(lambda v: scale * v))
    line = refuse("--out", whole.parent, "--name", whole.name, "--apply", *pair, "--result", result)
    assert f"odd.obj is {1.7 * scale:.3g} long, but these weights take meshes of about 1 to 2 (metres" in line
    assert f"meshkit-transfer {pair[0]} {pair[1]} --weights {whole}`" in line
    assert not result.exists()


@pytest.mark.parametrize(
    ("change", "data", "said"),
    [
        (lambda v: 2 * v, "humans", "is 3.4 long"),
        (lambda v: v[:, [0, 2, 1]], "humans", "longest along y"),
        (lambda v: v, "animals", "longest along z"),
        (lambda v: v[:, [0, 2, 1]], "animals", None),
        (lambda v: 100 * v, "folder:meshes", None),
    ],
    ids=["large", "y up", "upright animal", "animal", "a unit of one's own"],
)
def test_what_is_merely_unusual_is_spoken_of(
    recipe: ModuleType, copied: Path, files: Path, odd: Any, capsys: pytest.CaptureFixture[str], change, data, said
) -> None:
    config = read_json(copied / "config.json") | {"data": data}
    (copied / "config.json").write_text(json.dumps(config))
    recipe.apply(copied, (files / "identity.obj", odd(change)), copied / "posed.obj")
    lines = [line for line in capsys.readouterr().err.splitlines() if "odd.obj" in line]
    assert len(lines) == (0 if said is None else 1)
    assert all(line.startswith("warning: ") and said in line for line in lines)


@pytest.mark.parametrize(
    ("name", "result", "said"),
    [
        ("nobody", "posed.obj", "nobody holds no model.json"),
        ("whole", "posed.txt", "cannot be written"),
        ("whole", "file/posed.obj", "cannot write"),
    ],
)
def test_transfer_without_weights_or_a_place_to_write(
    whole: Path, files: Path, tmp_path: Path, refuse: Any, name: str, result: str, said: str
) -> None:
    (tmp_path / "file").write_text("in the way")
    pair = (files / "identity.obj", files / "pose.ply")
    line = refuse("--out", whole.parent, "--name", name, "--apply", *pair, "--result", tmp_path / result)
    assert said in line


def test_an_unwritable_folder_ends_with_one_line(tmp_path: Path) -> None:
    """A folder below a file: nobody can write there, not even root."""
    (tmp_path / "file").write_text("in the way")
    run = launch("xdualnet", "--out", tmp_path / "file" / "runs", "--steps", 1, *TINY)
    assert run.returncode == 2
    assert run.stderr.startswith(f"error: cannot write to {tmp_path / 'file' / 'runs'}")
    assert "--out" in run.stderr
    assert len(run.stderr.splitlines()) == 1
    assert run.stdout == ""


@pytest.mark.parametrize(
    "mistake",
    [
        ("--steps", "0"),
        ("--minutes", "-1"),
        ("--batch", "0"),
        ("--batch", "41"),
        ("--pool", "1"),
        ("--points", "0"),
        ("--model.descriptors", "hks"),
        ("--accelerator", "abacus"),
        ("--lr", "-1.0"),
        ("--lr", "nan"),
        ("--betas", "1.5 0.9"),
        ("--adam-eps", "-0.1"),
        ("--warmup", "-2"),
        ("--lambda-edge", "-1.0"),
    ],
    ids=" ".join,
)
def test_impossible_values_are_refused_in_one_line(copied: Path, refuse: Any, mistake: tuple[str, str]) -> None:
    for name in ("state.pt", "config.json"):
        (copied / name).unlink()
    steps = () if mistake[0] in ("--steps", "--minutes") else ("--steps", 1)
    line = refuse("--out", copied.parent, "--name", copied.name, *steps, *TINY[2:], mistake[0], *mistake[1].split())
    assert mistake[1] in line


# Presets, schedule, losses


def test_help_gives_the_paper_values(
    recipe: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["xdualnet.py", "--help"])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as caught:
        recipe.main()
    assert not caught.value.code
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for said in ("6890 and 3889", "Paper: 1e-4", "Paper: 2000", "Paper: 200 epochs of 1600", "Paper: 50", "Paper: 0.1"):
        assert said in text, said
    for flag in ("--resume", "--apply", "--data", "--no-arap", "--no-corr", "--preset", "--minutes", "--model.widths"):
        assert flag in text


def test_paper_preset_is_the_printed_setting(recipe: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = recipe.PRESETS["paper"]
    assert (cfg.vertices, cfg.points, cfg.pairs, cfg.batch) == (6890, None, 6400, 4)
    assert cfg.steps == 320_000 == 200 * cfg.pairs // cfg.batch
    assert cfg.model.widths == (1024, 512, 256)
    assert cfg.model.extractor_widths == (32, 64, 128)
    assert (cfg.model.eps, cfg.model.n_iters, cfg.model.descriptors) == (0.03, 5, "none")
    assert (cfg.lambda_rec, cfg.lambda_corr, cfg.lambda_edge) == (2000, 200, 1)
    assert (cfg.arap_from, cfg.arap_fraction, cfg.arap_iters, cfg.arap_energy) == (0.75, 0.1, 50, "spokes")
    assert (cfg.lr, cfg.warmup, cfg.decay_from) == (1e-4, 0, 0.5)
    assert (cfg.betas, cfg.adam_eps) == ((0.0, 0.9), 1e-3)  # not printed: the released code's
    assert (cfg.resample, cfg.eval_pairs, cfg.arap, cfg.corr) == (False, 400, True, True)
    # The command line gives the same, and single values can be changed.
    parsed = []
    monkeypatch.setattr(recipe, "train", lambda cfg, build, step: parsed.append(cfg))
    for arguments in (["--preset", "paper"], ["--preset=paper"], ["--batch", "6", "--preset", "paper"], []):
        monkeypatch.setattr(sys, "argv", ["xdualnet.py", *arguments])
        recipe.main()
    assert parsed == [cfg, cfg, replace(cfg, batch=6), recipe.PRESETS["tiny"]]


def test_learning_rate_schedule(recipe: ModuleType, loop: ModuleType) -> None:
    paper, steps = recipe.PRESETS["paper"], 320_000
    for epoch in range(200):  # flat for 100 epochs, then 1e-6 less each epoch
        expected = 1e-4 if epoch <= 100 else 1e-4 - 1e-6 * (epoch - 100)
        assert loop.learning_rate(paper, 1600 * epoch, steps) == pytest.approx(expected)
    tiny = replace(paper, warmup=50, lr=1e-3)
    rates = [loop.learning_rate(tiny, s, 1000) for s in range(1000)]
    assert rates[0] == pytest.approx(1e-3 / 50)
    assert rates[:50] == pytest.approx([1e-3 * (s + 1) / 50 for s in range(50)])
    assert rates[50:500] == pytest.approx([1e-3] * 450)
    assert rates[-1] == pytest.approx(1e-3 * 2 / 1000)
    assert loop.learning_rate(replace(tiny, decay_from=1.0), 999, 1000) == pytest.approx(1e-3)


@pytest.fixture
def small(recipe: ModuleType) -> Any:
    """A configuration without descriptors, and a batch for it."""
    model = GeneratorConfig(widths=(8, 8), extractor_widths=(8, 8), k=4)
    cfg = replace(recipe.PRESETS["tiny"], model=model, points=32)
    split = human_split()
    return cfg, PosePairs(load_humans(), split.train_identities, split.train_poses)[[(0, 0), (0, 1)]]


def run_step(recipe: ModuleType, cfg: Any, batch: Any, *, progress: float = 0.0) -> dict[str, float]:
    torch.manual_seed(0)
    _, system = recipe.build(cfg)
    torch.manual_seed(1)
    return {name: float(value.detach()) for name, value in recipe.step(system, batch, cfg, progress).items()}


def test_weights_scale_their_losses(recipe: ModuleType, small: Any) -> None:
    cfg, batch = small
    losses = run_step(recipe, cfg, batch)
    assert set(losses) == {"rec_a", "rec_b", "corr", "edge"}
    for flag, names in (("rec", {"rec_a", "rec_b"}), ("corr", {"corr"}), ("edge", {"edge"})):
        changed = run_step(recipe, replace(cfg, **{f"lambda_{flag}": 3 * getattr(cfg, f"lambda_{flag}")}), batch)
        for name, value in losses.items():
            assert changed[name] == pytest.approx((3 if name in names else 1) * value, rel=1e-5), (flag, name)


def test_deformer_changes_the_reconstructions_only(recipe: ModuleType, small: Any) -> None:
    cfg, batch = small
    without, joined = run_step(recipe, cfg, batch), run_step(recipe, cfg, batch, progress=0.75)
    assert joined["rec_a"] != pytest.approx(without["rec_a"], rel=1e-6)
    assert joined["edge"] == pytest.approx(without["edge"], rel=1e-5)  # it acts on the output before the deformer


def test_deformer_joins_at_its_share_of_the_run(recipe: ModuleType, small: Any) -> None:
    cfg, batch = small
    without = run_step(recipe, cfg, batch)
    assert run_step(recipe, cfg, batch, progress=0.74) == without
    assert run_step(recipe, replace(cfg, arap_from=0.5), batch, progress=0.5) != without
    assert run_step(recipe, replace(cfg, arap=False), batch, progress=0.99) == without


def test_without_backward_correspondence(recipe: ModuleType, small: Any) -> None:
    cfg, batch = small
    losses = run_step(recipe, cfg, batch)
    del losses["corr"]
    assert run_step(recipe, replace(cfg, corr=False), batch) == losses


def test_edge_lengths_as_the_paper_prints_them(recipe: ModuleType, small: Any) -> None:
    cfg, batch = small
    losses = run_step(recipe, replace(cfg, edge="length"), batch)
    torch.manual_seed(0)
    _, system = recipe.build(cfg)
    torch.manual_seed(1)
    output = system(batch.identity, batch.pose, use_deform=False).output.detach()
    faces = batch.identity_faces
    corners = output[torch.arange(len(faces))[:, None, None], faces].double()
    # Over vertices and their neighbours, so over edges in both directions; each edge belongs to two faces of three.
    lengths = (corners - corners.roll(1, 2)).square().sum((1, 2, 3))
    assert losses["edge"] == pytest.approx(cfg.lambda_edge * float(lengths.mean()), rel=1e-4)
