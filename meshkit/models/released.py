"""Checkpoints of the released codes: 3D-CoreNet, X-DualNet and NPT."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from meshkit.models.generator import PoseTransferGenerator
from meshkit.models.npt import NPT
from meshkit.models.presets import corenet3d, npt, xdualnet

__all__ = ["load_released_checkpoint"]

# (name in the released code, name here) as regular expressions; spectral norm is dealt with first.
_STACK = [
    (r"fc\.(.*)", r"transfer.lift.\1"),
    (r"conv1\.(.*)", r"transfer.mix.\1"),
    (r"conv([234])\.(.*)", r"transfer.narrow.{\1-2}.\2"),
    (r"elain_block(\d)\.(conv_.*)", r"transfer.blocks.{\1-1}.\2"),
    (r"elain_block(\d)\.(norm_.)\.mlp_same\.(.*)", r"transfer.blocks.{\1-1}.\2.shared.\3"),
    (r"elain_block(\d)\.(norm_.)\.mlp_(gamma|beta|weight)\.(.*)", r"transfer.blocks.{\1-1}.\2.\3.\4"),
]
_SETCONV = [
    (r"feat_conv(\d)\.fc(\d)\.weight", r"extractor.convs.{\1-1}.linears.{\2-1}.weight"),
    (r"feat_conv(\d)\.bn(\d)\.weight", r"extractor.convs.{\1-1}.scales.{\2-1}"),
    (r"feat_conv(\d)\.bn(\d)\.bias", r"extractor.convs.{\1-1}.shifts.{\2-1}"),
]
_POINTWISE = [
    (r"adaptive_feature\.layer(\d)\.(.*)", r"extractor.linears.{\1-1}.\2"),
    (r"layer\.(\d)\.conv(\d)\.(.*)", r"extractor.blocks.\1.conv_{\2-1}.\3"),
    (r"layer\.(\d)\.prelu\.weight", r"extractor.blocks.\1.prelu.weight"),
    (r"(theta|phi)\.(.*)", r"\1.\2"),
]
_NPT = [
    (r"encoder\.conv(\d)\.(.*)", r"encoder.linears.{\1-1}.\2"),
    (r"decoder\.conv1\.(.*)", r"decoder.mix.\1"),
    (r"decoder\.conv([234])\.(.*)", r"decoder.narrow.{\1-2}.\2"),
    (r"decoder\.spadain_block(\d)\.spadain(\d)\.(.*)", r"decoder.blocks.{\1-1}.norm_{\2-1}.\3"),
    (r"decoder\.spadain_block(\d)\.spadain_res\.(.*)", r"decoder.blocks.{\1-1}.norm_s.\2"),
    (r"decoder\.spadain_block(\d)\.conv(\d)\.(.*)", r"decoder.blocks.{\1-1}.conv_{\2-1}.\3"),
    (r"decoder\.spadain_block(\d)\.conv_res\.weight", r"decoder.blocks.{\1-1}.conv_s.weight"),
    (r"decoder\.spadain_block(\d)\.conv_res\.bias", r"decoder.blocks.{\1-1}.shortcut_bias"),
    (r"(.*)\.conv_weight\.(.*)", r"\1.gamma.\2"),
    (r"(.*)\.conv_bias\.(.*)", r"\1.beta.\2"),
]
_SPECTRAL = [
    (r"(.*)\.weight_orig", r"\1.parametrizations.weight.original"),
    (r"(.*)\.weight_(u|v)", r"\1.parametrizations.weight.0._\2"),
]
_RULES = {
    "xdualnet": {"net_G": _SPECTRAL + _STACK, "net_Corr": _SETCONV},
    "corenet3d": {"net_G": _SPECTRAL + _STACK, "net_Corr": _POINTWISE},
    "npt": {"": _NPT},
}


def load_released_checkpoint(
    path: str | Path, model: str = "xdualnet", *, variant: str = "original"
) -> PoseTransferGenerator | NPT:
    """Read a checkpoint of the authors' code into the same model here.

    Args:
        path: X-DualNet and 3D-CoreNet: either of the two files ``*_net_G.pth`` and ``*_net_Corr.pth``, which stand
            side by side, or the folder that holds one such pair. NPT: the ``.model`` file.
        model: ``"xdualnet"``, ``"corenet3d"`` or ``"npt"``.
        variant: of NPT, ``"original"`` or ``"maxpool"``: their checkpoints have the same names and shapes.

    Returns:
        The generator in evaluation mode, in the checkpoint's precision. X-DualNet and 3D-CoreNet come in the released
        layout, whose first convolution runs along the vertex order; it takes meshes in metres whose bounding box is
        centred at the origin.

    Raises:
        ValueError: a file is missing, cannot be read, or holds something else than tensors; names or shapes are not
            those of the model.

    Deviations:
        None: the outputs are those of the released code in evaluation mode, up to rounding.
    """
    if model not in _RULES:
        raise ValueError(f"model must be one of {list(_RULES)}, got {model!r}")
    path = Path(path)
    rules = _RULES[model]
    files = {"": _existing(path)} if model == "npt" else _pair(path)
    net: PoseTransferGenerator | NPT
    if model == "npt":
        net = npt(variant)
    else:
        net = xdualnet(released=True) if model == "xdualnet" else corenet3d(released=True)
    expected, state = net.state_dict(), {}
    problems: list[str] = []
    for part, file in files.items():
        for name, value in _read(file).items():
            target = _rename(name.removeprefix("module."), rules[part])
            if target not in expected:
                problems.append(f"unexpected {name} in {file.name}")
                continue
            state[target] = _linear(value)
            if state[target].shape != expected[target].shape:
                shape = tuple(expected[target].shape)
                problems.append(f"{name} in {file.name} has shape {tuple(value.shape)}, not {shape}")
    # Statistics of descriptors, which these models do not take, are not in the checkpoints.
    own = {name for name, value in expected.items() if value.numel() == 0}
    problems += [f"nothing for {name}" for name in expected if name not in state and name not in own]
    if problems:
        shown = "; ".join(problems[:8]) + (f"; and {len(problems) - 8} more" if len(problems) > 8 else "")
        raise ValueError(f"{path} is not a checkpoint of {model}: {shown}")
    dtype = next(iter(state.values())).dtype
    net.to(dtype).load_state_dict(state | {name: expected[name] for name in own})
    return net.eval()


def _pair(path: Path) -> dict[str, Path]:
    """The two files of a generator, from either of them or their folder."""
    if path.is_dir():
        found = sorted(path.glob("*net_G.pth"))
        if len(found) != 1:
            names = [f.name for f in found]
            raise ValueError(
                f"{path} must hold one *_net_G.pth beside its *_net_Corr.pth, found {names}: name the file"
            )
        path = found[0]
    match = re.fullmatch(r"(.*)net_(G|Corr)(\.\w+)", path.name)
    if match is None:
        raise ValueError(f"the file's name must end in net_G.pth or net_Corr.pth, got {path.name}")
    return {part: _existing(path.with_name(f"{match[1]}{part}{match[3]}")) for part in ("net_G", "net_Corr")}


def _existing(file: Path) -> Path:
    if not file.is_file():
        raise ValueError(f"there is no file {file}")
    return file


def _read(file: Path) -> dict[str, Tensor]:
    try:
        state: Any = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds: pickle, zip, key and runtime errors
        reason = (str(error).splitlines() or [repr(error)])[0]
        raise ValueError(f"{file} cannot be read as a dict of tensors: {reason}") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(f"{file} must hold a dict of tensors, as torch.save(net.state_dict()) writes it")
    return state


def _rename(name: str, rules: list[tuple[str, str]]) -> str:
    """Apply every rule that fits, in order; ``{a-b}`` in the result is worked out."""
    for pattern, result in rules:
        match = re.fullmatch(pattern, name)
        if match is not None:
            filled = match.expand(result)
            name = re.sub(r"\{(\d)-(\d)\}", lambda m: str(int(m[1]) - int(m[2])), filled)
    return name


def _linear(value: Tensor) -> Tensor:
    """A convolution's weight as that of a linear map: taps side by side, in the order of the vertices."""
    if value.dim() == 3:
        return value.movedim(2, 1).flatten(1)
    return value.flatten(1) if value.dim() > 2 else value
