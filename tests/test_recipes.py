"""The other recipes: what they minimise, and that each runs from data to report."""

import errno
import itertools
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from recipe_runs import ROOT, read_json, read_log, recipe_module
from torch.utils._python_dispatch import TorchDispatchMode

from meshkit.data import (
    MeshPool,
    MeshStore,
    PairBatch,
    PosePairs,
    human_split,
    load_humans,
    load_shipped,
    sample_bone_factors,
    scale_bones,
)
from meshkit.io import save_mesh
from meshkit.models import GeneratorConfig, load_generator, load_pretrained
from meshkit.norm import SPAdaIN

pytest.importorskip("tyro")
pytest.importorskip("lightning_fabric")

TINY = (
    *("--threads", 1, "--accelerator", "cpu", "--precision", "32-true"),
    *("--pairs", 12, "--pool", 3, "--eval-pairs", 2, "--batch", 2),
)
SMALL_EXTRACTOR = ("--model.k", 4, "--model.extractor-widths", 8, 8)
WITH_DESCRIPTORS = ("--model.num-signatures", 5, *SMALL_EXTRACTOR, "--model.widths", 8, 8)
WITHOUT_DESCRIPTORS = ("--model.descriptors", "none", "--model.condition", "features")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Path]:
    """Runs a recipe's ``main`` in this process and gives the run's folder."""

    def run(recipe: str, *arguments: Any) -> Path:
        words = [f"{recipe}.py", "--out", tmp_path, "--name", "run", *TINY, *arguments]
        monkeypatch.setattr(sys, "argv", [str(word) for word in words])
        recipe_module(recipe).main()
        return tmp_path / "run"

    return run


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that look at training alone: figures and pictures take longer than a few small steps."""
    monkeypatch.setattr(recipe_module("_train"), "report", lambda *_, **options: None)


@pytest.fixture(scope="module")
def batch() -> PairBatch:
    split = human_split()
    return PosePairs(load_humans(), split.train_identities, split.train_poses)[[(0, 0), (0, 1)]]


def small(recipe: ModuleType, **changes: Any) -> Any:
    model = GeneratorConfig(widths=(8, 8), extractor_widths=(8, 8), k=4)
    return replace(recipe.PRESETS["tiny"], model=model, **changes)


def mean_ratio_penalty(output: torch.Tensor, rest: torch.Tensor, faces: torch.Tensor) -> float:
    """Mean over faces of the sum over their edges of \\|length / length at rest - 1\\|, then over samples."""
    values = []
    for x, a, f in zip(output.double(), rest.double(), faces, strict=True):
        new, old = ((v[f] - v[f].roll(1, 1)).norm(dim=2) for v in (x, a))
        values.append((new / old - 1).abs().sum(1).mean())
    return float(torch.stack(values).mean())


# 3D-CoreNet


def test_corenet3d_compares_with_the_truth(batch: PairBatch) -> None:
    recipe = recipe_module("corenet3d")
    cfg = small(recipe)
    torch.manual_seed(0)
    generator, system = recipe.build(cfg)
    losses = {name: value.detach() for name, value in recipe.step(system, batch, cfg, 0.0).items()}
    output = generator(batch.identity, batch.pose).vertices.detach()
    expected = cfg.lambda_rec * (output - batch.ground_truth).double().square().mean((1, 2)).mean()
    assert float(losses["rec"]) == pytest.approx(float(expected), rel=1e-4)
    penalty = mean_ratio_penalty(output, batch.identity, batch.identity_faces)
    assert float(losses["edge"]) == pytest.approx(cfg.lambda_edge * penalty, rel=1e-4)


def test_corenet3d_may_be_told_the_matches(batch: PairBatch) -> None:
    recipe = recipe_module("corenet3d")
    cfg = replace(small(recipe), lambda_match=3.0)
    torch.manual_seed(0)
    generator, system = recipe.build(cfg)
    losses = recipe.step(system, batch, cfg, 0.0)
    plan = generator(batch.identity, batch.pose).plan.dense().detach()
    shares = plan.gather(2, batch.correspondence[..., None])[..., 0] / plan.sum(2)
    assert float(losses["match"].detach()) == pytest.approx(-3 * float(shares.log().mean()), rel=1e-4)
    losses["match"].backward()
    assert any(p.grad is not None and bool((p.grad != 0).any()) for p in generator.extractor.parameters())
    unknown = replace(batch, correspondence=torch.full_like(batch.correspondence, -1))
    with pytest.raises(recipe_module("_run").UserError, match="--lambda-match needs true matches, which --data humans"):
        recipe.step(system, unknown, cfg, 0.0)


def test_corenet3d_told_the_matches_may_be_recorded(batch: PairBatch) -> None:
    """While a CUDA graph is recorded, which is at the first step, no condition may be read back."""

    class Recorded(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            assert func is not torch.ops.aten._local_scalar_dense.default or args[0].dtype != torch.bool
            return func(*args, **(kwargs or {}))

    recipe = recipe_module("corenet3d")
    cfg = replace(small(recipe), lambda_match=1.0, graph=True)
    _, system = recipe.build(cfg)
    with Recorded():
        assert "match" in recipe.step(system, batch, cfg, 0.0)


def test_corenet3d_may_learn_the_matching_alone(batch: PairBatch) -> None:
    recipe = recipe_module("corenet3d")
    cfg = replace(small(recipe), lambda_rec=0.0, lambda_edge=0.0, lambda_match=1.0)
    generator, system = recipe.build(cfg)
    losses = recipe.step(system, batch, cfg, 0.0)
    assert list(losses) == ["match"]
    losses["match"].backward()
    learning = {name.partition(".")[0] for name, p in generator.named_parameters() if p.grad is not None}
    assert "extractor" in learning and "transfer" not in learning
    # Several processes wait for the gradients of all that require one.
    assert all(p.grad is not None for p in generator.parameters() if p.requires_grad)
    with pytest.raises(recipe_module("_run").UserError, match="nothing to learn: one of --lambda-rec"):
        recipe.build(replace(cfg, lambda_match=0.0))


def test_corenet3d_may_keep_its_matching(batch: PairBatch) -> None:
    recipe = recipe_module("corenet3d")
    cfg = replace(small(recipe), frozen_matching=True, init="first")
    generator, system = recipe.build(cfg)
    sum(recipe.step(system, batch, cfg, 0.0).values()).backward()
    learning = {name.partition(".")[0] for name, p in generator.named_parameters() if p.grad is not None}
    assert learning == {"transfer"}
    npt = GeneratorConfig(architecture="npt_maxpool")
    with pytest.raises(
        recipe_module("_run").UserError, match=r"npt_maxpool has no matching: recipes/npt\.py trains it"
    ):
        recipe.build(replace(cfg, model=npt))
    for wrong in ({"init": None}, {"lambda_match": 1.0}):
        with pytest.raises(recipe_module("_run").UserError, match="--frozen-matching keeps the matching that --init"):
            recipe.build(replace(cfg, **wrong))


def test_corenet3d_for_a_time_without_descriptors(run: Any) -> None:
    folder = run("corenet3d", "--minutes", 0.02, *WITHOUT_DESCRIPTORS, *SMALL_EXTRACTOR, "--model.widths", 16, 8)
    steps = read_json(folder / "config.json")["steps"]
    assert steps >= 1
    records = read_log(folder)
    assert [record["step"] for record in records] == list(range(1, steps + 1))
    assert set(records[0]) - {"step", "seconds", "eval"} == {"rec", "edge", "loss"}
    summary = read_json(folder / "summary.json")
    assert (summary["steps"], summary["pairs_seen"]) == (steps, steps * 2)
    # Within a factor of the speed measured at the start; machines are not that steady.
    assert records[-1]["seconds"] < 10 * 0.02 * 60
    assert not list(folder.glob("pool_*"))
    assert load_generator(folder)[1].descriptors == "none"


@pytest.mark.usefixtures("without_report")
def test_corenet3d_with_spadain(run: Any) -> None:
    folder = run("corenet3d", "--norm", "spadain", "--steps", 1, *WITHOUT_DESCRIPTORS, *SMALL_EXTRACTOR)
    generator, model = load_generator(folder)
    assert model.norm == "spadain"
    assert all(isinstance(norm, SPAdaIN) for block in generator.transfer.blocks for norm in norms(block))


def norms(block: torch.nn.Module) -> list[torch.nn.Module]:
    return [block.norm_0, block.norm_1, block.norm_s]


# NPT


def test_npt_compares_with_the_truth(batch: PairBatch) -> None:
    recipe = recipe_module("npt")
    cfg = replace(recipe.PRESETS["tiny"], model=GeneratorConfig("npt_maxpool", extractor_widths=(8, 9)))
    torch.manual_seed(0)
    generator, system = recipe.build(cfg)
    losses = {name: value.detach() for name, value in recipe.step(system, batch, cfg, 0.0).items()}
    output = generator(batch.identity, batch.pose).vertices.detach()
    expected = (output - batch.ground_truth).double().square().mean((1, 2)).mean()
    assert float(losses["rec"]) == pytest.approx(float(expected), rel=1e-4)
    penalty = mean_ratio_penalty(output, batch.identity, batch.identity_faces)
    assert float(losses["edge"]) == pytest.approx(0.0005 * penalty, rel=1e-4)


def test_npt_paper_preset_is_the_published_setting() -> None:
    cfg = recipe_module("npt").PRESETS["paper"]
    assert (cfg.lr, cfg.batch, cfg.steps) == (5e-5, 8, 1000 * cfg.pairs // 8)
    assert (cfg.lambda_rec, cfg.lambda_edge) == (1.0, 0.0005)


@pytest.mark.parametrize("variant", ["maxpool", "original"])
def test_npt_trains(run: Any, variant: str) -> None:
    folder = run("npt", "--variant", variant, "--steps", 2, "--model.extractor-widths", 8, 9)
    assert load_generator(folder)[0].variant == variant
    figures = read_json(folder / "summary.json")["test"]
    assert set(figures) == {"pmd", "chamfer", "pmd_copy_identity", "chamfer_copy_identity"}


# The baseline of cycles


def test_cycle_baseline_asks_for_both_meshes_back(batch: PairBatch) -> None:
    recipe = recipe_module("cycle_baseline")
    cfg = small(recipe, lambda_self=500.0)
    torch.manual_seed(0)
    generator, system = recipe.build(cfg)
    generator.eval()  # each pass moves the spectral norms' buffers
    losses = {name: float(value.detach()) for name, value in recipe.step(system, batch, cfg, 0.0).items()}

    def passed(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return generator(a, b).vertices.detach()

    a, b = batch.identity, batch.pose
    ab, ba = passed(a, b), passed(b, a)
    expected = {
        "cycle_a": 2000 * (passed(ab, ba) - a).square().mean(),
        "cycle_b": 2000 * (passed(ba, ab) - b).square().mean(),
        "self": 500 * (passed(a, a) - a).square().mean(),
    }
    assert losses == {name: pytest.approx(float(value), rel=1e-3) for name, value in expected.items()}


@pytest.mark.usefixtures("without_report")
def test_cycle_baseline_trains(run: Any) -> None:
    folder = run("cycle_baseline", "--steps", 1, *WITHOUT_DESCRIPTORS, *SMALL_EXTRACTOR, "--model.widths", 16, 8)
    assert set(read_log(folder)[0]) == {"step", "seconds", "cycle_a", "cycle_b", "self", "loss"}


# Deformation transfer


@pytest.mark.parametrize("source", ["subject", "template"])
def test_deformation_transfer_is_near_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str) -> None:
    """Told the source in the identity's pose it must beat any copy by far; with the average body it is off by shape."""
    words = ["x", "--out", tmp_path, "--name", "dt", "--eval-pairs", 3, "--source", source, "--threads", 1]
    monkeypatch.setattr(sys, "argv", [str(word) for word in words])
    recipe_module("deformation_transfer").main()
    figures = read_json(tmp_path / "dt" / "summary.json")["test"]
    assert figures["pmd"] < figures["pmd_copy_identity"] * (0.02 if source == "subject" else 0.3)


def test_deformation_transfer_needs_a_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, said in ((["--data", "folder:x"], "a rigged body is needed"), (["--eval-pairs", "0"], "400 test")):
        monkeypatch.setattr(sys, "argv", ["x", "--out", str(tmp_path), *arguments])
        with pytest.raises(recipe_module("_run").UserError, match=said):
            recipe_module("deformation_transfer").main()


# Data


def body_files(folder: Path, identities: range, poses: range) -> Path:
    body, other = load_humans(1000), load_humans(2000)
    for who in identities:
        for how in poses:
            model = body if who % 2 else other
            verts = model(torch.tensor([who]), torch.tensor([how]))[0]
            save_mesh(folder / f"{who}_{how}.ply", verts, model.faces)
    return folder


FAST = ("--steps", 1, *WITHOUT_DESCRIPTORS, *SMALL_EXTRACTOR, "--model.widths", 8, 8)


def test_meshes_of_different_sizes_from_a_folder(run: Any, tmp_path: Path) -> None:
    place = body_files(tmp_path / "meshes", range(4), range(4))
    folder = run("corenet3d", "--data", f"folder:{place}", "--eval-pairs", 1, *FAST)
    assert read_json(folder / "summary.json")["test"]["pmd"] > 0
    assert (folder / "sheet.png").exists()


def test_unsupervised_training_on_meshes_without_ground_truth(run: Any, tmp_path: Path) -> None:
    place = tmp_path / "wardrobe"
    for who in range(10):
        body = load_humans(1000)
        verts = body(torch.tensor([who]), torch.tensor([who]))[0]
        save_mesh(place / f"person{who}" / "smpl_registered.obj", verts, body.faces)
    folder = run("xdualnet", "--data", f"mgn:{place}", "--points", "None", "--no-arap", *FAST)
    assert read_json(folder / "summary.json")["test"].keys() == {"correspondence_m"}  # of one topology
    assert not (folder / "meshes" / "pair0_ground_truth.obj").exists()


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("cars", "must be humans, animals"),
        ("humans:here", "must be humans, animals"),
        ("folder", "must be humans, animals|there is no"),
        ("faust:nowhere", "there is no nowhere"),
        ("smpl:README.md", "cannot be read"),
        ("folder:docs", "{identity}_{pose}"),
    ],
)
def test_wrong_data_is_named(run: Any, word: str, said: str) -> None:
    with pytest.raises(recipe_module("_run").UserError) as caught:
        run("corenet3d", "--data", word, *FAST)
    assert any(part in str(caught.value) for part in said.split("|")), str(caught.value)


def test_sampled_identities_join_the_training_ones_alone(run: Any, without_report: None) -> None:
    more = ("--data", "animals", "--sampled-identities", 50, "--steps", 1, *SMALL_EXTRACTOR)
    folder = run("corenet3d", *more, *WITHOUT_DESCRIPTORS)
    assert read_json(folder / "config.json")["sampled_identities"] == 50
    data = recipe_module("_data")
    body, split = load_shipped("animals")
    known = body.identities
    body, wider = data.with_sampled_identities(body, split, 50, seed=0)
    assert len(wider.train_identities) == len(split.train_identities) + 50
    assert torch.equal(body.identities[: len(known)], known) and torch.equal(
        wider.test_identities, split.test_identities
    )
    assert bool((body.identities[wider.train_identities][:, split.test_identities].abs() < 1e-6).all())
    again = data.with_sampled_identities(load_shipped("animals")[0], split, 50, seed=0)[0]
    assert torch.equal(again.identities, body.identities)


def test_limbs_of_sampled_identities_are_stretched(run: Any, without_report: None) -> None:
    more = ("--data", "animals", "--sampled-identities", 20, "--bone-spread", 0.2, "--steps", 1, *SMALL_EXTRACTOR)
    folder = run("corenet3d", *more, *WITHOUT_DESCRIPTORS)
    assert read_json(folder / "config.json")["bone_spread"] == 0.2
    data = recipe_module("_data")
    known, split = load_shipped("animals")
    plain, _ = data.with_sampled_identities(load_shipped("animals")[0], split, 20, seed=0)
    body, wider = data.with_sampled_identities(load_shipped("animals")[0], split, 20, seed=0, bone_spread=0.2)
    old = torch.cat([split.train_identities, split.test_identities])
    pose = torch.zeros_like(old)
    assert torch.allclose(body(old, pose), known(old, pose), atol=1e-6)
    new = wider.train_identities[-20:]
    (rest, joints), (before, joints_before) = body.shape(new), plain.shape(new)
    factors = sample_bone_factors(
        known.joints, known.parents, 20, spread=0.2, generator=torch.Generator().manual_seed(1)
    )
    expected = scale_bones(before, joints_before, known.weights, known.parents, factors)
    assert torch.allclose(rest, expected[0], atol=1e-6) and torch.allclose(joints, expected[1], atol=1e-6)
    assert (rest - before).norm(dim=2).mean() > 0.02


def test_signatures_of_other_limbs_are_not_taken(tmp_path: Path) -> None:
    """A run that was killed before its first step may be begun again with other stretches, and has a pool by then."""
    data, keys = recipe_module("_data"), []

    class Asked(Exception):
        pass

    def asked(name: str, made_from: str) -> None:
        keys.append((name, made_from))
        raise Asked

    for spread in (0.0, 0.2, 0.3):
        cfg = replace(recipe_module("corenet3d").PRESETS["tiny"], sampled_identities=4, bone_spread=spread)
        with pytest.raises(Asked):
            data.data(cfg, SimpleNamespace(load_tensors=asked), 1)
    assert len(set(keys)) == 3 and {name for name, _ in keys} == {"pool_train.safetensors"}


def test_stretched_limbs_need_sampled_identities(run: Any) -> None:
    error = recipe_module("_run").UserError
    with pytest.raises(error, match="--bone-spread stretches sampled identities: give --sampled-identities too"):
        run("corenet3d", "--bone-spread", 0.2, "--steps", 1)
    with pytest.raises(error, match=r"--bone-spread must lie between 0 and 1, got -0\.1"):
        run("corenet3d", "--bone-spread", -0.1, "--sampled-identities", 4, "--steps", 1)


def test_sampled_poses_join_the_training_ones_alone(run: Any, without_report: None) -> None:
    folder = run("corenet3d", "--sampled-poses", 30, "--steps", 1, *SMALL_EXTRACTOR, *WITHOUT_DESCRIPTORS)
    assert read_json(folder / "config.json")["sampled_poses"] == 30
    data = recipe_module("_data")
    body, split = load_shipped("humans")
    known = body.poses
    body, wider = data.with_sampled_poses(body, split, 30, seed=0)
    assert torch.equal(body.poses[: len(known)], known) and torch.equal(wider.test_poses, split.test_poses)
    assert torch.equal(wider.train_poses[:-30], split.train_poses)
    # Each joint turns as in a training pose.
    new, train = body.poses[wider.train_poses[-30:]], known[split.train_poses]
    assert bool((new[:, None] == train).all(3).any(1).all())
    again = data.with_sampled_poses(load_shipped("humans")[0], split, 30, seed=0)[0]
    assert torch.equal(again.poses, body.poses)


@pytest.mark.parametrize("what", ["identities", "poses"])
def test_fewer_than_no_samples_are_refused(what: str, run: Any) -> None:
    with pytest.raises(recipe_module("_run").UserError, match=f"--sampled-{what} must not be negative, got -3"):
        run("corenet3d", f"--sampled-{what}", -3, "--steps", 1)


@pytest.mark.parametrize("what", ["identities", "poses"])
def test_samples_need_a_rig(what: str, run: Any, tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    with pytest.raises(recipe_module("_run").UserError, match=f"--sampled-{what} needs a rig"):
        run("corenet3d", "--data", f"folder:{tmp_path / 'meshes'}", f"--sampled-{what}", 5, *WITHOUT_DESCRIPTORS)


@pytest.mark.usefixtures("without_report")
def test_meshes_from_files_have_signatures(
    run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    place = body_files(tmp_path / "meshes", range(4), range(4))
    words = ("corenet3d", "--data", f"folder:{place}", *WITH_DESCRIPTORS, "--eval-pairs", 2)
    folder = run(*words, "--steps", 1)
    net = load_generator(folder)[0]
    stores = [MeshStore(folder / f"cache_{side}") for side in ("train", "test")]
    for store in stores:
        store.describe(num_signatures=5, progress=False)
    flat = torch.cat([stores[0].view("descriptors", k) for k in range(len(stores[0]))])
    assert torch.allclose(net.descriptor_mean, flat.mean(0), atol=1e-4), "standardised by the training meshes alone"
    monkeypatch.setattr("meshkit.data.store.signatures", lambda *a, **k: pytest.fail("computed again"))
    run(*words, "--steps", 2, "--resume")
    assert "metres" not in capsys.readouterr().err


def test_shipped_weights_go_on_with_meshes_from_files(run: Any, tmp_path: Path) -> None:
    place = body_files(tmp_path / "meshes", range(4), range(4))
    known = ("--preset", "small", "--init", "corenet3d-humans", "--batch", 1, "--steps", 1, "--eval-pairs", 1)
    folder = run("corenet3d", "--data", f"folder:{place}", *known, "--lr", 0, "--pairs", 1)
    shipped = load_pretrained("corenet3d-humans").generator
    assert torch.equal(load_generator(folder)[0].descriptor_mean, shipped.descriptor_mean)
    # Bodies that it was trained on: the error is that of the weights, not of a new network.
    assert read_json(folder / "summary.json")["test"]["pmd"] < 3


def test_a_folder_that_is_too_small_or_of_another_unit_is_told(
    run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = body_files(tmp_path / "meshes", range(1), range(1))
    with pytest.raises(recipe_module("_run").UserError, match="0 meshes to train on are too few, of 1"):
        run("corenet3d", "--data", f"folder:{place}", *FAST)
    body = load_humans(1000)
    for who, how in itertools.product(range(4), range(4)):
        verts = body(torch.tensor([who]), torch.tensor([how]))[0]
        save_mesh(
            tmp_path / "cm" / f"{who}_{how}.ply", 100 * verts, body.faces[: -700 if (who, how) == (0, 0) else None]
        )
    words = ("corenet3d", "--data", f"folder:{tmp_path / 'cm'}", "--steps", 1)
    with pytest.raises(recipe_module("_run").UserError, match=r"0_0\.ply: no descriptors: .*--model\.descriptors none"):
        run(*words, *WITH_DESCRIPTORS)
    with pytest.raises(recipe_module("_run").UserError, match=r"0_0\.ply: no descriptors: .* or remove it$"):
        run(*words, "--preset", "small", "--init", "corenet3d-humans")  # which know no network without
    run(*words, *FAST, "--eval-pairs", 1)
    assert "long; the settings are for bodies of 0.5 to 4 (metres): scale the files" in capsys.readouterr().err


# Failures


@pytest.mark.usefixtures("without_report")
def test_a_full_disk_leaves_the_last_checkpoint(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written, save = [], torch.save

    def save_until_full(state: Any, path: Path) -> None:
        save(state, path)
        written.append(path)
        if len(written) > 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(torch, "save", save_until_full)
    arguments = ("corenet3d", "--save-every", 1, "--resume", *FAST, "--steps", 4)
    with pytest.raises(recipe_module("_run").UserError) as caught:
        run(*arguments)
    folder, said = tmp_path / "run", str(caught.value)
    assert "state.pt: No space left on device" in said and "after step 2, is usable" in said and "\n" not in said
    assert torch.load(folder / "state.pt", weights_only=True)["step"] == 2
    assert not [file for file in folder.iterdir() if file.name.startswith(".")]
    monkeypatch.setattr(torch, "save", save)
    run(*arguments)
    assert [record["step"] for record in read_log(folder)] == [1, 2, 3, 4]


def test_a_loss_that_is_nan_is_told_with_step_pairs_and_checkpoint(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, seen = recipe_module("corenet3d"), []
    step = recipe.step

    def step_until_nan(system: torch.nn.Module, batch: PairBatch, *others: Any) -> dict[str, torch.Tensor]:
        seen.append(batch)
        return {
            name: loss * (math.nan if len(seen) == 4 else 1.0) for name, loss in step(system, batch, *others).items()
        }

    monkeypatch.setattr(recipe, "step", step_until_nan)
    with pytest.raises(recipe_module("_run").UserError) as caught:
        run("corenet3d", "--save-every", 2, *FAST, "--steps", 6)
    said = str(caught.value)
    assert "the loss is nan" in said and "at step 3 " in said and "after step 2, is usable" in said
    assert str(seen[-1].identity_index.tolist()) in said and str(seen[-1].pose_index.tolist()) in said
    state = torch.load(tmp_path / "run" / "state.pt", weights_only=True)
    assert state["step"] == 2 and all(bool(value.isfinite().all()) for value in state["model"].values())


# Larger batches


@pytest.mark.usefixtures("without_report")
def test_accumulated_batches_equal_one_large_batch(run: Any) -> None:
    """Without spectral normalisation, whose power iterations go on with every pass."""
    logs = []
    for name, sizes in (("large", (4, 1)), ("parts", (1, 4))):
        batches = ("--batch", sizes[0], "--accumulate", sizes[1])
        folder = run("corenet3d", *FAST, "--model.no-spectral", "--steps", 3, "--name", name, *batches).parent / name
        logs.append([record["loss"] for record in read_log(folder)])
    assert logs[0] == pytest.approx(logs[1], rel=1e-4)


def test_another_number_of_processes_keeps_the_pairs_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    setup, cfg = recipe_module("_setup"), replace(recipe_module("corenet3d").PRESETS["tiny"], batch=2, accumulate=2)
    recorded = json.dumps(asdict(cfg), default=str)
    for processes, expected in ((1, (2, 4)), (2, (2, 2)), (4, (2, 1)), (8, (1, 1))):
        monkeypatch.setenv("WORLD_SIZE", str(processes))
        begun = setup.resumed(cfg, json.loads(recorded), 8)
        assert (begun.batch, begun.accumulate) == expected
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(recipe_module("_run").UserError, match="8 pairs per step, which 3 processes"):
        setup.resumed(cfg, json.loads(recorded), 8)


@pytest.mark.usefixtures("without_report")
def test_a_failed_start_leaves_no_folder_and_a_begun_run_its_own(run: Any, tmp_path: Path) -> None:
    error = recipe_module("_run").UserError
    with pytest.raises(error, match="there is no nowhere"):
        run("corenet3d", "--data", "faust:nowhere", *FAST)
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    with pytest.raises(error, match="there is no nowhere"):
        run("corenet3d", "--data", "faust:nowhere", *FAST)
    assert (tmp_path / "run").exists()  # another's folder


@pytest.mark.usefixtures("without_report")
def test_flags_that_do_not_count_on_resume_are_named(run: Any, capsys: pytest.CaptureFixture[str]) -> None:
    run("corenet3d", *FAST)
    assert "do not count" not in capsys.readouterr().err
    run("corenet3d", *FAST, "--resume")
    assert "do not count" not in capsys.readouterr().err
    run("corenet3d", *FAST, "--resume", "--lr", 0.5, "--model.k", 5)
    said = capsys.readouterr().err
    assert "these do not count: " in said and "--lr (recorded: " in said and "--model.k (recorded: 4)" in said
    assert "--steps" not in said and "--preset" not in said
    run("corenet3d", *FAST, "--resume", "--preset", "small", "--batch", 2)
    assert "--preset (recorded: tiny)" in capsys.readouterr().err


def test_meshes_of_both_sides_are_counted(run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = body_files(tmp_path / "meshes", range(4), range(4))
    run("corenet3d", "--data", f"folder:{place}", "--eval-pairs", 20, *FAST)
    said = capsys.readouterr()
    assert "4 meshes to test on: 2 identities, 2 poses" in said.out
    assert "4 test meshes make 12 distinct pairs at most" in said.err


def test_different_vertex_counts_name_the_option(run: Any, tmp_path: Path) -> None:
    place = body_files(tmp_path / "meshes", range(4), range(4))
    with pytest.raises(recipe_module("_run").UserError, match="--points None"):
        run("xdualnet", "--data", f"folder:{place}", "--no-arap", *FAST)


def test_init_begins_with_the_weights_of_a_run(run: Callable[..., Path], without_report: None, tmp_path: Path) -> None:
    size = ("--model.extractor-widths", 4, 4, 5)
    known = run("npt", "--steps", 2, *size)
    begun = (
        run("npt", "--name", "second", "--steps", 1, "--seed", 1, "--lr", 0, "--init", known, *size).parent / "second"
    )
    before, after = (load_generator(folder)[0].state_dict() for folder in (known, begun))
    parameters = [name for name, _ in load_generator(known)[0].named_parameters()]
    assert parameters and all(torch.equal(before[name], after[name]) for name in parameters)
    other = ("npt", "--name", "third", "--steps", 1, "--init", known, "--model.extractor-widths", 4, 4, 6)
    said = r"run has another network: extractor-widths 4 4 5 \(here 4 4 6\); add --model.extractor-widths 4 4 5$"
    with pytest.raises(recipe_module("_run").UserError, match=said):
        run(*other)
    assert not (tmp_path / "third").exists(), "refused before anything is computed"


def test_no_steps_report_what_the_weights_are_worth(run: Callable[..., Path]) -> None:
    known = run("npt", "--steps", 2, "--model.extractor-widths", 4, 4, 5)
    run("npt", "--name", "again", "--steps", 0, "--init", known, "--seed", 1, "--model.extractor-widths", 4, 4, 5)
    first, second = (read_json(known.parent / name / "summary.json") for name in ("run", "again"))
    assert second["test"] == first["test"] and second["test"]["pmd"] > 0
    assert (second["init"], second["steps"], second["pairs_seen"]) == (str(known), 0, 0) and first["init"] is None
    assert (known.parent / "again" / "sheet.png").exists() and not (known.parent / "again" / "state.pt").exists()
    with pytest.raises(recipe_module("_run").UserError, match="--steps 0 evaluates weights without training: say"):
        run("npt", "--name", "third", "--steps", 0)
    with pytest.raises(recipe_module("_run").UserError, match=r"this run's own: --init \S+run, under another --name"):
        run("npt", "--steps", 0, "--resume")


def test_no_steps_make_no_more_of_the_training_pool_than_a_pair(
    run: Callable[..., Path], without_report: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = run("corenet3d", "--steps", 1, *SMALL_EXTRACTOR, "--model.widths", 8, 8)
    counts, build = [], MeshPool.build
    monkeypatch.setattr(MeshPool, "build", lambda *a, **options: counts.append(a[3]) or build(*a, **options))
    size = ("--pool", 50, *SMALL_EXTRACTOR, "--model.widths", 8, 8)
    run("corenet3d", "--name", "again", "--steps", 0, "--init", known, *size)
    assert counts == [2]


@pytest.mark.parametrize(
    ("recipe", "init", "flags", "said"),
    [
        (
            "xdualnet",
            "xdualnet-humans",
            (),
            "xdualnet-humans has another network: extractor-widths 32 64 64 (here 16 32 32); add --preset small",
        ),
        (
            "corenet3d",
            "corenet3d-humans",
            ("--model.widths", 8, "--lr", 1),
            "extractor-widths 32 64 64 (here 16 32 32), widths 256 128 64 (here 8); add --preset small and leave out "
            "--model.widths",
        ),
        ("corenet3d", "corenet3d-humans", ("--preset=small", "--norm", "spadain"), "(here spadain); leave out --norm"),
        (
            "xdualnet",
            "xdualnet-humans",
            ("--preset", "small", "--model.no-spectral"),
            "spectral True (here False); leave out --model.spectral",
        ),
        ("npt", "corenet3d-humans", (), "architecture matching (here npt_maxpool); give weights of the same network"),
        ("xdualnet", "nobody", (), "--init nobody: neither shipped weights nor a folder are named so; there are coren"),
        ("xdualnet", "corenet-human", (), "named so: did you mean corenet3d-humans? There are corenet3d-animals, c"),
        ("xdualnet", str(Path(__file__).parent), (), "holds no model.json: give the folder of a finished or checkp"),
    ],
)
def test_weights_of_another_network_say_what_to_type(run: Any, recipe: str, init: str, flags: Any, said: str) -> None:
    with pytest.raises(recipe_module("_run").UserError) as refused:
        run(recipe, "--steps", 1, "--init", init, *flags)
    assert said in str(refused.value)


def test_other_settings_that_fit_are_spoken_of(capsys: pytest.CaptureFixture[str]) -> None:
    recipe, setup = recipe_module("corenet3d"), recipe_module("_setup")
    cfg = replace(recipe.PRESETS["small"], init="corenet3d-humans")
    setup.initialize(recipe.build(cfg)[0], cfg)
    assert capsys.readouterr().err == ""
    cfg = replace(cfg, model=replace(cfg.model, k=8, symmetry=True))
    setup.initialize(recipe.build(cfg)[0], cfg)
    assert capsys.readouterr().err.endswith("trained with other --model settings: k 16 (here 8)\n")


def test_flags_are_read_as_they_are_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    settings, recipe = recipe_module("_settings"), recipe_module("xdualnet")
    words = "--no-arap --lambda_edge=3 --model.no-residual --model.extractor_widths 4 4 --eval-pairs 2 --lr -1"
    words = ["--preset", "small", *words.split(), "--preset=tiny", "--nonsense", "batch"]
    expected = [
        "preset",
        "arap",
        "lambda_edge",
        "model.residual",
        "model.extractor_widths",
        "eval_pairs",
        "lr",
    ]
    assert recipe_module("_command_line").typed(recipe.Config, words) == expected
    monkeypatch.setattr(sys, "argv", ["xdualnet.py", "--preset", "small", "--preset=tiny"])
    assert settings.parse(recipe.PRESETS, None) == recipe.PRESETS["tiny"], "of two presets the last counts, whole"


def test_a_generator_is_told_what_it_takes(batch: PairBatch) -> None:
    data = recipe_module("_data")
    known = data.inputs(batch) | {"identity_faces": batch.identity_faces}
    matching = GeneratorConfig(extractor_widths=(4, 4), widths=(4,), k=2)
    takes = {
        name: set(data.told(config.build(), known))
        for name, config in {
            "npt": GeneratorConfig(architecture="npt_maxpool", extractor_widths=(4, 5)),
            "plain": matching,
            "symmetric": replace(matching, symmetry=True),
        }.items()
    }
    masks, descriptors = {"identity_mask", "pose_mask"}, {"identity_descriptors", "pose_descriptors"}
    assert takes["npt"] == masks
    assert takes["plain"] == masks | descriptors
    assert takes["symmetric"] == masks | descriptors | {"identity_faces"}


@pytest.mark.usefixtures("without_report")
def test_damaged_files_are_named_or_left_out(run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = body_files(tmp_path / "meshes", range(5), range(5))
    damaged = place / "1_1.ply"
    damaged.write_text("not a mesh")
    words = ("corenet3d", "--data", f"folder:{place}", *FAST)
    with pytest.raises(
        recipe_module("_run").UserError, match=rf"{damaged.name}.*; remove the file, or leave out .* --skip-bad$"
    ):
        run(*words)
    capsys.readouterr()
    folder = run(*words, "--skip-bad")
    said = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(said) == 1 and re.match(r"warning: 1 of 9 mesh files was left out, the first: .*1_1.ply", said[0])
    assert (folder / "model.safetensors").exists()


def test_help_does_without_what_trains() -> None:
    """Fabric, and what it imports of torch, take seconds."""
    code = "import sys; sys.argv = ['xdualnet.py', '--help']; sys.path.insert(0, 'recipes'); import xdualnet\n"
    code += "print({'lightning_fabric', 'torch._dynamo', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "set()"), done.stderr
