"""A recipe is a file to be edited: what meshkit refuses is one line, errors of edited code keep their traceback."""

import traceback
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from recipe_runs import recipe_module

from meshkit.batching import check_verts
from meshkit.models import GeneratorConfig

pytest.importorskip("tyro")


def own_mistake(*inputs: Any) -> Any:
    first, second = (1, 2, 3)  # ValueError: too many values to unpack
    return first, second


def trained(tmp_path: Any, **change: Any) -> None:
    xdualnet, train = recipe_module("xdualnet"), recipe_module("_train")
    cfg = xdualnet.Config(out=tmp_path, name="run", steps=1, model=GeneratorConfig(n_iters=0))
    train.train(cfg, change.get("build", xdualnet.build), xdualnet.step)


def test_settings_that_meshkit_refuses_are_one_line(tmp_path: Any) -> None:
    with pytest.raises(recipe_module("_run").UserError, match="eps, n_iters and k must be positive"):
        trained(tmp_path)


def test_an_error_of_ones_own_build_keeps_its_traceback(tmp_path: Any) -> None:
    with pytest.raises(ValueError, match="too many values to unpack") as caught:
        trained(tmp_path, build=own_mistake)
    assert traceback.extract_tb(caught.value.__traceback__)[-1].name == "own_mistake"


@pytest.mark.parametrize(
    ("step", "kind"),
    [(own_mistake, "ValueError"), (lambda *inputs: check_verts(torch.zeros(3, 3)), "UserError")],
    ids=["own", "meshkit"],
)
def test_an_error_of_ones_own_step_keeps_its_traceback(step: Any, kind: str) -> None:
    module = recipe_module("_step")
    batch = SimpleNamespace(identity_index=torch.tensor([7]), pose_index=torch.tensor([8]))
    fabric = SimpleNamespace(global_rank=0, device=torch.device("cpu"))
    cfg = SimpleNamespace(threads=1, seed=0)
    trainer = module.Trainer(fabric, None, SimpleNamespace(param_groups=[]), cfg, step, 9)
    trainer.gradients = lambda batch, s: step(None, batch, cfg, 0.0)
    with pytest.raises((ValueError, recipe_module("_run").UserError)) as caught:
        trainer.update(batch, 3)
    assert type(caught.value).__name__ == kind
    if kind == "UserError":
        assert "got (3, 3)" in str(caught.value) and "(at step 3 (identities [7], poses [8]))" in str(caught.value)
    else:
        assert traceback.extract_tb(caught.value.__traceback__)[-1].name == "own_mistake"
