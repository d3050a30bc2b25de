"""Checkpoints of the released codes against hand-written ones and literal forward passes, and model cards."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import literal_models as literal
import pytest
import torch
from conftest import assert_near, rand
from torch import Tensor, nn

from meshkit.models import NPT, PoseTransferGenerator, corenet3d, load_released_checkpoint, model_card, npt, xdualnet

SHAPES = {
    "xdualnet": {"net_G": literal.pose_transfer_shapes(128), "net_Corr": literal.setconv_shapes()},
    "corenet3d": {"net_G": literal.pose_transfer_shapes(256), "net_Corr": literal.pointwise_shapes()},
}
FORWARD = {"xdualnet": literal.xdualnet_forward, "corenet3d": literal.corenet3d_forward}


def bodies(n: int = 40, m: int = 45) -> tuple[Tensor, Tensor]:
    return 0.4 * rand(n, 3, seed=5), 0.4 * rand(m, 3, seed=6)


def spoil(file: Path, change) -> None:
    """Rewrite a checkpoint after ``change(state)``."""
    state = torch.load(file, weights_only=True)
    torch.save(change(state) or state, file)


@pytest.fixture(scope="module")
def weights() -> dict[str, dict[str, literal.State]]:
    return {
        model: {part: literal.random_state(shapes, seed) for seed, (part, shapes) in enumerate(parts.items())}
        for model, parts in SHAPES.items()
    }


@pytest.fixture(scope="module")
def checkpoints(weights, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("released")
    for model, parts in weights.items():
        for part, state in parts.items():
            (folder / model).mkdir(exist_ok=True)
            torch.save(state, folder / model / f"latest_{part}.pth")
    return {model: folder / model for model in weights}


@pytest.fixture(scope="module")
def npt_checkpoint(tmp_path_factory) -> tuple[literal.State, Path]:
    state, file = literal.random_state(literal.npt_shapes(), 2), tmp_path_factory.mktemp("npt") / "original_169.model"
    torch.save(state, file)
    return state, file


# Outputs


@pytest.mark.parametrize("model", ["xdualnet", "corenet3d"])
def test_released_checkpoint_gives_the_released_output(model, weights, checkpoints):
    net, (identity, pose) = load_released_checkpoint(checkpoints[model], model), bodies()
    assert isinstance(net, PoseTransferGenerator) and not net.training
    net_g, net_corr = ({n: v.double() for n, v in weights[model][part].items()} for part in ("net_G", "net_Corr"))
    vertices, warped = FORWARD[model](net_g, net_corr, identity, pose)
    assert vertices.std() > 0.1  # the output is a shape, not a point
    # In float32 part by part: rounding of the features, amplified by the matching, is no error of the blocks.
    features = (literal.setconv_features if model == "xdualnet" else literal.pointwise_features)(net_corr, identity)
    for value, expected in (
        (net.encode(identity.float()[None])[0], features),
        (net(identity.float()[None], pose.float()[None]).warped[0], warped),
        (net.transfer(warped.float()[None], features.float()[None])[0], vertices),
    ):
        assert (value - expected).norm() < 1e-5 * expected.norm()
    exact = net.double()(identity[None], pose[None])
    assert_near(exact.vertices[0], vertices, 1e-10)
    assert_near(exact.warped[0], warped, 1e-10)


@pytest.mark.parametrize("variant", ["original", "maxpool"])
def test_npt_checkpoint_gives_the_released_output(variant, npt_checkpoint):
    state, file = npt_checkpoint
    net, (identity, pose) = load_released_checkpoint(file, "npt", variant=variant), bodies(40, 40)
    assert isinstance(net, NPT) and net.variant == variant and not net.training
    expected = literal.npt_forward(
        {n: v.double() for n, v in state.items()}, identity, pose, max_pool=variant == "maxpool"
    )
    assert expected.std() > 0.1
    assert_near(net(identity.float()[None], pose.float()[None]).vertices[0], expected, 1e-5)
    assert_near(net.double()(identity[None], pose[None]).vertices[0], expected, 1e-9)


# Ways a checkpoint is stored


def same_weights(a: nn.Module, b: nn.Module) -> bool:
    other = b.state_dict()
    return all(torch.equal(value, other[name]) for name, value in a.state_dict().items())


def test_either_file_or_their_folder_names_the_checkpoint(checkpoints):
    folder = checkpoints["xdualnet"]
    expected = load_released_checkpoint(folder / "latest_net_G.pth")
    for path in (folder / "latest_net_Corr.pth", str(folder)):
        assert same_weights(load_released_checkpoint(path), expected)


def test_data_parallel_prefixes_and_precision(npt_checkpoint, tmp_path):
    state, file = npt_checkpoint
    torch.save({f"module.{name}": value.double() for name, value in state.items()}, tmp_path / "x.model")
    loaded = load_released_checkpoint(tmp_path / "x.model", "npt")
    assert {p.dtype for p in loaded.parameters()} == {torch.float64}
    assert same_weights(loaded.float(), load_released_checkpoint(file, "npt"))


# Errors


@pytest.fixture
def copied(npt_checkpoint, tmp_path) -> Path:
    (tmp_path / "npt.model").write_bytes(npt_checkpoint[1].read_bytes())
    return tmp_path / "npt.model"


def test_foreign_names_are_listed(copied):
    spoil(copied, lambda s: s.update(surplus=s.pop("decoder.conv4.bias")))
    with pytest.raises(
        ValueError, match=r"not a checkpoint of npt: unexpected surplus in npt.model; nothing for decoder.narrow.2.bias"
    ):
        load_released_checkpoint(copied, "npt")


def test_long_lists_are_cut(copied):
    spoil(copied, lambda s: {f"{name}.x": value for name, value in s.items()})
    wrong = 2 * len(literal.npt_shapes())  # each name is foreign, and each is missing
    with pytest.raises(ValueError, match=f"unexpected encoder.conv1.weight.x .*; and {wrong - 8} more"):
        load_released_checkpoint(copied, "npt")


def test_wrong_shapes_are_named(copied):
    spoil(copied, lambda s: s.update({"encoder.conv2.weight": torch.zeros(128, 65, 1)}))
    with pytest.raises(ValueError, match=r"encoder.conv2.weight in npt.model has shape \(128, 65, 1\), not \(128, 64"):
        load_released_checkpoint(copied, "npt")


def test_weights_of_the_other_model_are_refused(checkpoints):
    with pytest.raises(
        ValueError, match=r"not a checkpoint of corenet3d: .*mlp_same.weight in latest_net_G.pth has shape"
    ):
        load_released_checkpoint(checkpoints["xdualnet"], "corenet3d")


@pytest.mark.parametrize("content", [b"", b"not a checkpoint"])
def test_damaged_files(copied, content):
    copied.write_bytes(content)
    with pytest.raises(ValueError, match=r"npt.model cannot be read as a dict of tensors"):
        load_released_checkpoint(copied, "npt")


def test_only_tensors_are_read(copied):
    """A pickle that would run code is refused, and so is one that holds no state dict."""
    torch.save(nn.Linear(2, 2), copied)
    with pytest.raises(ValueError, match="cannot be read as a dict of tensors"):
        load_released_checkpoint(copied, "npt")
    torch.save({"epoch": 3}, copied)
    with pytest.raises(ValueError, match="must hold a dict of tensors"):
        load_released_checkpoint(copied, "npt")


def test_missing_files(tmp_path):
    with pytest.raises(ValueError, match=r"must hold one \*_net_G.pth beside its \*_net_Corr.pth, found \[\]"):
        load_released_checkpoint(tmp_path)
    for epoch in (1, 2):
        (tmp_path / f"{epoch}_net_G.pth").touch()
    with pytest.raises(ValueError, match=r"found \['1_net_G.pth', '2_net_G.pth'\]: name the file"):
        load_released_checkpoint(tmp_path)
    with pytest.raises(ValueError, match=r"there is no file .*1_net_Corr.pth"):
        load_released_checkpoint(tmp_path / "1_net_G.pth")
    with pytest.raises(ValueError, match=r"must end in net_G.pth or net_Corr.pth, got weights.pt"):
        load_released_checkpoint(tmp_path / "weights.pt")
    with pytest.raises(ValueError, match=r"there is no file .*none.model"):
        load_released_checkpoint(tmp_path / "none.model", "npt")
    with pytest.raises(ValueError, match=r"model must be one of \['xdualnet', 'corenet3d', 'npt'\], got 'NPT'"):
        load_released_checkpoint(tmp_path, "NPT")


# Cards


def counts(build: Callable[[], nn.Module]) -> dict[str, int]:
    """Parameters of each part, and of the whole."""
    card = model_card(build())
    return {part.name: part.parameters for part in (*card.parts, card.whole)}


def test_parameter_counts_of_the_released_models():
    expected = {"extractor": 55_360, "transfer": 23_073_795, "total": 55_360 + 23_073_795}
    assert counts(lambda: xdualnet(released=True)) == expected
    corenet = counts(lambda: corenet3d(released=True))
    assert corenet["extractor"] + corenet["theta"] + corenet["phi"] == 699_524
    assert corenet["transfer"] == 23_761_923 and corenet["total"] == 699_524 + 23_761_923
    for variant in ("maxpool", "original"):
        assert counts(partial(npt, variant))["total"] == 6_054_941
    # The default differs by the first map alone: kernel 1 instead of 3.
    assert counts(xdualnet)["transfer"] == expected["transfer"] - 2 * 3 * 1024


def test_literal_shapes_hold_the_same_counts():
    """The oracle's tables, summed by themselves."""

    def total(shapes: literal.Shapes) -> int:
        return sum(torch.Size(s).numel() for n, s in shapes.items() if not n.endswith(("_u", "_v")))

    assert [total(s) for s in SHAPES["xdualnet"].values()] == [23_073_795, 55_360]
    assert [total(s) for s in SHAPES["corenet3d"].values()] == [23_761_923, 699_524]
    assert total(literal.npt_shapes()) == 6_054_941


def test_card_counts_by_hand():
    model = nn.Sequential(nn.Linear(2, 3).double(), nn.ReLU(), nn.BatchNorm1d(3))
    card = model_card(model)
    linear, norm = card.parts
    assert (linear.name, linear.kind, linear.parameters, linear.buffers, linear.bytes) == ("0", "Linear", 9, 0, 72)
    assert (norm.parameters, norm.buffers, norm.bytes) == (6, 7, 6 * 4 + 2 * 3 * 4 + 8)
    assert card.whole.parameters == 15 and card.whole.inert == 0
    lines = str(card).splitlines()
    assert len(lines) == 5 and {line.count("|") for line in lines} == {7}
    assert lines[-1] == "| total | Sequential | 15 | 0 | 7 | 0.0 |"


def test_card_counts_inert_parameters():
    """Biases before an instance norm: of 3D-CoreNet's extractor all, of NPT those before its norms."""
    corenet, original = model_card(corenet3d()), model_card(npt("original"))
    assert {p.name: p.inert for p in corenet.parts if p.inert} == {"extractor": 64 + 128 + 256 + 4 * 2 * 256}
    encoder, decoder = original.parts
    assert encoder.inert == 64 + 128 + 1024
    # Maps into a block and inside it, then the two branches' ends in front of the next block.
    assert decoder.inert == 2 * (1027 + 513 + 256) + 2 * (1027 + 513)
    assert original.whole.inert == encoder.inert + decoder.inert
