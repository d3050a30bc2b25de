"""Constructors say what they were given, if it is no number of channels, layers, neighbours or steps."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from meshkit.data import PairSampler, PosePairs, RiggedModel, human_split, load_humans
from meshkit.deform import ARAPDeformer, ARAPFactor, ARAPRest, ARAPTopology
from meshkit.metrics import MeanMetric
from meshkit.models import NPT, OrderedPoseTransferStack, PointwiseExtractor, PoseTransferGenerator, PoseTransferStack
from meshkit.nn import ConditionalResBlock, SetConv, SetConvExtractor
from meshkit.norm import SPADE, AdaIN, ElaIN, SoftAdaIN, SPAdaIN

FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
VERTS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])

WIDTHS: dict[str, Callable[[Any], Any]] = {
    "PoseTransferStack": lambda widths: PoseTransferStack(8, widths),
    "OrderedPoseTransferStack": lambda widths: OrderedPoseTransferStack(8, widths),
    "SetConvExtractor": lambda widths: SetConvExtractor(widths),
    "PointwiseExtractor": lambda widths: PointwiseExtractor(widths),
    "NPT": lambda widths: NPT(encoder_widths=widths),
    "PoseTransferGenerator": lambda widths: PoseTransferGenerator(widths=widths),
    "PoseTransferGenerator extractor": lambda widths: PoseTransferGenerator(extractor_widths=widths, widths=(8,)),
}


@pytest.mark.parametrize("widths", [(), (0,), (8, -2), (2.5,), (math.nan,), 8, None], ids=repr)
@pytest.mark.parametrize("name", WIDTHS)
def test_widths_are_positive_whole_numbers(name: str, widths: Any) -> None:
    with pytest.raises(ValueError, match="widths must be at least one positive whole number") as caught:
        WIDTHS[name](widths)
    assert str(caught.value).endswith(f"got {widths!r}")


COUNTS: dict[str, tuple[int, Callable[[Any], Any]]] = {  # the least that is allowed
    "PoseTransferStack": (1, lambda n: PoseTransferStack(n, (8,))),
    "SetConv in": (1, lambda n: SetConv(n, 8)),
    "SetConv out": (1, lambda n: SetConv(3, n)),
    "SetConvExtractor k": (1, lambda n: SetConvExtractor((8,), k=n)),
    "SetConvExtractor descriptors": (0, lambda n: SetConvExtractor((8,), descriptors=n)),
    "PointwiseExtractor blocks": (0, lambda n: PointwiseExtractor((8,), blocks=n)),
    "PointwiseExtractor descriptors": (0, lambda n: PointwiseExtractor((8,), descriptors=n)),
    "PoseTransferGenerator k": (1, lambda n: PoseTransferGenerator(k=n, widths=(8,))),
    "PoseTransferGenerator descriptors": (0, lambda n: PoseTransferGenerator(descriptors=n, widths=(8,))),
    "ConditionalResBlock": (1, lambda n: ConditionalResBlock(8, n)),
    "SPADE hidden": (1, lambda n: SPADE(8, 8, hidden=n)),
    "ARAPDeformer max_iter": (1, lambda n: ARAPDeformer(max_iter=n)),
    "ARAPTopology num_verts": (4, lambda n: ARAPTopology(FACES, n)),
    "PairSampler length": (4, lambda n: PairSampler(n, 4, stop=4)),
    "PairSampler batch_size": (1, lambda n: PairSampler(8, n, stop=4)),
    "PairSampler start": (0, lambda n: PairSampler(8, 2, start=n, stop=4)),
    "PairSampler stop": (0, lambda n: PairSampler(8, 2, stop=n)),
    "PairSampler world_size": (1, lambda n: PairSampler(8, 2, stop=4, world_size=n)),
} | {norm.__name__: (1, lambda n, norm=norm: norm(n, 8)) for norm in (AdaIN, ElaIN, SoftAdaIN, SPADE, SPAdaIN)}


@pytest.mark.parametrize("name", COUNTS)
def test_counts_are_whole_numbers(name: str) -> None:
    least, make = COUNTS[name]
    make(least)
    for bad in (least - 1, -1, least + 0.5, math.nan):
        with pytest.raises(ValueError, match=str(bad)):
            make(bad)


NUMBERS: dict[str, Callable[[float], Any]] = {
    "ConditionalResBlock slope": lambda x: ConditionalResBlock(8, 8, slope=x),
    "PointwiseExtractor slope": lambda x: PointwiseExtractor((8,), slope=x),
    "SetConv slope": lambda x: SetConv(3, 8, slope=x),
    "SPADE momentum": lambda x: SPADE(8, 8, momentum=x),
    "AdaIN eps": lambda x: AdaIN(8, 8, eps=x),
    "soft weights": lambda x: ARAPFactor(
        ARAPRest(ARAPTopology(FACES, 4), VERTS), torch.tensor([0]), soft_weights=torch.full((4,), x)
    ),
    "PosePairs pose_noise": lambda x: PosePairs(
        load_humans(), human_split().train_identities, human_split().train_poses, pose_noise=x
    ),
}


@pytest.mark.parametrize("value", [-0.5, math.nan])
@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_neither_negative_nor_nan(name: str, value: float) -> None:
    NUMBERS[name](0.0)
    with pytest.raises(ValueError, match=str(value)):
        NUMBERS[name](value)


def test_weights_of_another_length_are_refused() -> None:
    rest = ARAPRest(ARAPTopology(FACES, 4), VERTS)
    with pytest.raises(ValueError, match=r"soft_weights must have shape \(4,\), got \(3,\)"):
        ARAPFactor(rest, torch.tensor([0]), soft_weights=torch.ones(3))


def test_a_body_needs_a_joint() -> None:
    with pytest.raises(ValueError, match=r"joint 0 must be the root .* got \[\]"):
        RiggedModel(
            VERTS,
            FACES,
            torch.zeros(1, 4, 3),
            torch.zeros(0, 3),
            torch.zeros(1, 0, 3),
            torch.zeros(4, 0),
            torch.zeros(0, dtype=torch.int64),
        )


def test_a_mean_is_of_a_function() -> None:
    with pytest.raises(TypeError, match=r"function must be a metric.* got 3"):
        MeanMetric(3)  # type: ignore[arg-type]
