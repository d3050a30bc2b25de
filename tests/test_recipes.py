"""The other recipes: what they minimise, and that each runs from data to report."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from recipe_runs import read_json, read_log, recipe_module

from meshkit.data import PairBatch, PosePairs, human_split, load_humans
from meshkit.models import GeneratorConfig, load_generator

pytest.importorskip("tyro")
pytest.importorskip("lightning_fabric")

TINY = (
    *("--threads", 1, "--accelerator", "cpu", "--precision", "32-true"),
    *("--pairs", 12, "--pool", 3, "--eval-pairs", 2, "--batch", 2),
)
SMALL_EXTRACTOR = ("--model.k", 4, "--model.extractor-widths", 8, 8)
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
