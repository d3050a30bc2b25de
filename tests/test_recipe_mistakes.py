"""What recipes say of a mistyped command line, of meshes that a split leaves out, and in which unit they report."""

import importlib
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from recipe_runs import launch, recipe_module

from meshkit.data import MeshEntry
from meshkit.io import MeshFileError

pytest.importorskip("tyro")

DATA = "--data takes one or more values, each humans or animals"


def told(monkeypatch: pytest.MonkeyPatch, recipe: str, line: str) -> str:
    """The error that a recipe's command line ends with."""
    module = recipe_module(recipe)
    monkeypatch.setattr(sys, "argv", [f"{recipe}.py", *line.split()])
    with pytest.raises(recipe_module("_run").UserError) as caught:
        module.main()
    return str(caught.value)


@pytest.mark.parametrize(
    ("recipe", "line", "said"),
    [
        ("xdualnet", "--step 3", "there is no option --step: did you mean --steps?"),
        ("xdualnet", "--eval_pair=3", "there is no option --eval_pair: did you mean --eval-pairs?"),
        ("xdualnet", "--model.norn elain", "there is no option --model.norn: did you mean --model.norm?"),
        ("xdualnet", "--noarap", "there is no option --noarap: did you mean --no-arap?"),
        ("xdualnet", "--zzzzzz", "there is no option --zzzzzz"),
        ("xdualnet", "--steps x", "--steps takes a whole number or None, got 'x'"),
        ("xdualnet", "--steps", "--steps takes a whole number or None, got nothing"),
        ("xdualnet", "--lr 1e-3x --batch 2", "--lr takes a number, got '1e-3x'"),
        ("xdualnet", "--model.k=a", "--model.k takes a whole number, got 'a'"),
        ("xdualnet", "--preset tinny", "--preset takes tiny, small or paper, got 'tinny': did you mean tiny?"),
        ("xdualnet", "--preset smal", "--preset takes tiny, small or paper, got 'smal': did you mean small?"),
        ("xdualnet", "--apply a.obj", "--apply takes 2 values, each a path, or None, got 'a.obj'"),
        ("xdualnet", "--resume=yes", "--resume takes no value, got 'yes'; --no-resume turns it off"),
        ("xdualnet", "--no-arap true --steps 1", "--no-arap takes no value, got 'true'; --no-arap turns it off"),
        ("xdualnet", "--no-steps 3", "there is no option --no-steps: did you mean --steps?"),
        ("xdualnet", "--model.widths", "--model.widths takes one or more values, each a whole number, got nothing"),
        ("xdualnet", "--model.widths a", "--model.widths takes one or more values, each a whole number, got 'a'"),
        ("paper_tables", "--data", f"{DATA}, got nothing"),
        ("xdualnet", "--model.norm foo", "--model.norm takes elain or spadain, got 'foo'"),
        ("xdualnet", "--model.descriptors hks", "--model.descriptors takes none or wks, got 'hks': did you mean wks?"),
        ("corenet3d", "--betas 0", "--betas takes 2 values, each a number, got '0'"),
        ("npt", "--seed 1 2", "'2' belongs to no option"),
        ("paper_tables", "--data human", f"{DATA}, got 'human': did you mean humans?"),
        ("paper_tables", "--data humans Animal", f"{DATA}, got 'humans', 'Animal': did you mean animals?"),
        ("deformation_transfer", "--source x", "--source takes subject or template, got 'x'"),
    ],
)
def test_a_mistake_in_the_command_line_is_one_line(
    recipe: str, line: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert told(monkeypatch, recipe, line) == f"{said}; --help lists the options"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--threads -1", "--threads must not be negative, got -1"),
        ("--workers -1", "--workers must not be negative, got -1"),
        ("--warmup -1", "--warmup must not be negative, got -1"),
        ("--seed -1", "--seed must lie between 0 and 2^63 - 1, got -1"),
        (f"--seed {2**63}", f"--seed must lie between 0 and 2^63 - 1, got {2**63}"),
        ("--minutes nan", "give --steps, or positive --minutes, got nan"),
        ("--minutes inf", "give --steps, or positive --minutes, got inf"),
        ("--lr nan", "--lr must be a number of at least 0, got nan"),
        ("--name=", "--name must not be empty: it is the run's folder below --out"),
    ],
)
def test_values_that_make_no_sense_are_refused_before_anything_is_written(
    line: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert told(monkeypatch, "corenet3d", f"--out {tmp_path / 'runs'} {line}") == said
    assert not (tmp_path / "runs").exists()


def test_deformation_transfer_wants_no_negative_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(monkeypatch, "deformation_transfer", "--threads -2") == "--threads must not be negative, got -2"


def test_a_damaged_configuration_of_a_run_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "broken"
    folder.mkdir()
    (folder / "model.safetensors").write_bytes(b"")
    for text, said in (("{", "the model configuration is not JSON"), ("[1]", "must be a JSON object")):
        (folder / "model.json").write_text(text)
        answer = told(monkeypatch, "npt", f"--out {tmp_path} --name broken --apply a.obj b.obj")
        assert answer.startswith(f"{folder / 'model.json'}: ") and said in answer


def test_a_rig_with_too_little_to_make_more_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the sampling refuses is a mistake of --data, not a traceback."""
    data, meshkit_data = recipe_module("_data"), importlib.import_module("meshkit.data")
    body, split = meshkit_data.load_shipped("humans")
    few = replace(split, train_identities=split.train_identities[:1])
    monkeypatch.setattr(data, "load_shipped", lambda kind, vertices: (body, few))
    cfg = replace(recipe_module("npt").PRESETS["tiny"], sampled_identities=5)
    with pytest.raises(recipe_module("_run").UserError, match="--data humans: a table of at least two rows"):
        data.data(cfg, None, 0)
    body.identities = None
    with pytest.raises(recipe_module("_run").UserError, match="this rig has no identities to make others of"):
        data.with_sampled_identities(body, split, 5, seed=0)


def test_a_file_that_changed_under_a_run_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """A worker's error comes with the traceback of its process in the message."""

    def fail() -> None:
        raise MeshFileError(
            "Caught it in worker 0.\nTraceback:\nmeshkit.io.files.MeshFileError: a.npy: shard is damaged"
        )

    with pytest.raises(SystemExit, match="2"):
        recipe_module("_run").guard(fail)
    assert capsys.readouterr().err == "error: a.npy: shard is damaged\n"


def test_it_ends_with_status_2_and_help_with_0() -> None:
    wrong = launch("xdualnet", "--step", 3)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert wrong.stderr.splitlines() == [
        "error: there is no option --step: did you mean --steps?; --help lists the options"
    ]
    right = launch("xdualnet", "--help")
    assert right.returncode == 0 and "--lambda-rec" in right.stdout


def grid(folder: Path, identities: int, poses: int) -> list[MeshEntry]:
    return [MeshEntry(folder / f"{i}_{p}.ply", i, p) for i in range(identities) for p in range(poses)]


def test_meshes_of_neither_side_of_a_split_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = grid(tmp_path, 5, 5)
    train = [e for e in entries if e.identity < 3 and e.pose < 3]
    test = [e for e in entries if e.identity >= 3 and e.pose >= 3]
    tell = recipe_module("_data").tell_left_out
    tell(entries, train, test)
    assert capsys.readouterr().out.splitlines() == [
        "12 of 25 meshes are on neither side: what is tested on must be new",
        "  6 of an identity to train on in a pose to test on: 0_3.ply, 0_4.ply, 1_3.ply, 1_4.ply, 2_3.ply, 2_4.ply",
        "  6 of an identity to test on in a pose to train on: 3_0.ply, 3_1.ply, 3_2.ply, 4_0.ply, 4_1.ply, 4_2.ply",
    ]
    tell([*entries, MeshEntry(tmp_path / "9_9.ply", 9, 9)], train, test)
    assert "  1 of an identity or a pose of neither side: 9_9.ply" in capsys.readouterr().out
    tell([*train, *test], train, test)
    assert capsys.readouterr().out == ""


def test_a_warning_shows_no_source_line(capsys: pytest.CaptureFixture[str]) -> None:
    with recipe_module("_data").plain_warnings():
        warnings.warn("1 of 9 mesh files was left out", stacklevel=1)
    assert capsys.readouterr().err == "warning: 1 of 9 mesh files was left out\n"


def test_a_resumed_run_may_skip_files_that_went_bad(capsys: pytest.CaptureFixture[str]) -> None:
    xdualnet, setup = recipe_module("xdualnet"), recipe_module("_setup")
    for recorded, asked, wanted in ((False, True, True), (True, False, True), (False, False, False)):
        begun = {"skip_bad": recorded, "model": {}, "betas": [0.0, 0.9]}
        cfg = setup.resumed(xdualnet.Config(skip_bad=asked), begun)
        assert cfg.skip_bad is wanted
    assert "do not count" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "unit", "said", "bar"),
    [
        ("humans", "m", "matched vertices are 20.0 cm from", (15.0, "distance to ground truth (cm)")),
        ("animals", "units", "matched vertices are 0.200 units from", (0.15, "distance to ground truth (units)")),
        ("smal:toy.pkl", "units", "matched vertices are 0.200 units from", (0.15, "distance to ground truth (units)")),
        ("folder:here", "units", "matched vertices are 0.200 units from", (0.15, "distance to ground truth (units)")),
    ],
)
def test_reports_are_in_the_unit_of_the_bodies(
    kind: str, unit: str, said: str, bar: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report, saved, drawn = recipe_module("_report"), {}, {}
    figures = {"pmd": 1.0, "chamfer": 2.0, f"correspondence_{unit}": 0.2}
    monkeypatch.setattr(report, "evaluate", lambda *arguments: figures)
    monkeypatch.setattr(report, "save_mesh", lambda *arguments: None)
    monkeypatch.setattr(report, "render", lambda *arguments, **options: None)
    monkeypatch.setattr(report, "pmd", lambda *arguments: torch.zeros(1))
    monkeypatch.setattr(report, "plot_curves", lambda path, series, **options: drawn.update({path: options["ylabel"]}))

    def contact_sheet(*arguments: Any, **options: Any) -> Any:
        drawn["bar"] = options["colorbar"]
        return SimpleNamespace(save=lambda path: None)

    monkeypatch.setattr(report, "contact_sheet", contact_sheet)
    verts, faces = torch.rand(1, 4, 3), torch.tensor([[[0, 1, 2], [1, 2, 3]]])
    batch = SimpleNamespace(
        identity=verts, pose=verts, ground_truth=verts, identity_faces=faces, pose_faces=faces, to=lambda device: batch
    )
    monkeypatch.setattr(report, "generate", lambda *arguments: SimpleNamespace(vertices=verts, warped=None))
    pairs = type("Pairs", (), {"__len__": lambda self: 1, "__getitem__": lambda self, places: batch})()
    run: Any = SimpleNamespace(
        folder=Path("run"),
        path=Path,
        load_json=lambda name: {},
        save_json=lambda name, value: saved.update(value),
        read_log=lambda: [{"step": 1, "seconds": 1.0, "rec": 1.0, "eval": {"pmd": 1.0}}],
    )
    report.report(run, torch.nn.Identity(), pairs, torch.device("cpu"), {}, kind=kind)
    assert said in capsys.readouterr().out
    assert saved["units"].endswith(f"in 1e-3 {unit}^2, correspondence in {unit}")
    assert drawn[Path("pmd.png")] == f"PMD (1e-3 {unit}²)"
    assert drawn["bar"] == (0.0, *bar)
