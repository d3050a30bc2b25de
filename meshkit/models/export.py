"""Export to ONNX."""

from __future__ import annotations

import copy
from importlib.util import find_spec
from pathlib import Path
from typing import cast

import torch
from torch import nn
from torch.nn.utils.parametrize import is_parametrized

from meshkit.models.stack import PoseTransferStack
from meshkit.nn import ConditionalResBlock
from meshkit.norm import ConditionalNorm

__all__ = ["export_onnx"]


def export_onnx(stack: PoseTransferStack, path: str | Path) -> None:
    """Write a pose-transfer stack as an ONNX file.

    The graph has inputs ``warped (B, N, 3)`` and ``features (B, N, D)`` and output ``vertices (B, N, 3)``, with B and
    N free. It is the stack in evaluation mode without mask; spectral normalisation is worked into the weights. The
    stack itself is left as it is.

    Args:
        stack: the module to export, ``generator.transfer`` of a :class:`~meshkit.models.PoseTransferGenerator`.
        path: where to write; weights are inside the file.

    Raises:
        ImportError: the packages of the extra ``onnx`` are missing.
    """
    if find_spec("onnxscript") is None or find_spec("onnx") is None:
        raise ImportError('exporting needs onnx and onnxscript: pip install "meshkit-torch[onnx]"')
    stack = copy.deepcopy(stack).eval()
    for name, module in list(stack.named_modules()):
        if is_parametrized(module, "weight"):
            # Not by remove_parametrizations: a copy shares its class, and removal would strip the original as well.
            stack.set_submodule(name, _plain(cast(nn.Linear, module)))
    weight = stack.lift.weight
    features = cast(ConditionalNorm, cast(ConditionalResBlock, stack.blocks[0]).norm_0).cond_features
    example = (weight.new_zeros(2, 8, 3), weight.new_zeros(2, 8, features))
    free = {0: torch.export.Dim.DYNAMIC, 1: torch.export.Dim.DYNAMIC}
    with torch.no_grad():
        program = torch.onnx.export(
            stack,
            example,
            dynamo=True,
            input_names=["warped", "features"],
            output_names=["vertices"],
            dynamic_shapes={"warped": free, "features": free},
            verbose=False,
        )
    assert program is not None
    program.save(path, external_data=False)


def _plain(layer: nn.Linear) -> nn.Linear:
    """The linear map that ``layer`` evaluates to."""
    weight, bias = layer.weight.detach(), layer.bias
    plain = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None, device=weight.device, dtype=weight.dtype)
    plain.load_state_dict({"weight": weight} if bias is None else {"weight": weight, "bias": bias})
    return plain
