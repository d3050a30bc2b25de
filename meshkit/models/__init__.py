"""Pose-transfer networks."""

from meshkit.models.card import ModelCard, model_card
from meshkit.models.export import export_onnx
from meshkit.models.generator import PoseTransferGenerator
from meshkit.models.npt import NPT
from meshkit.models.ordered import OrderedPoseTransferStack
from meshkit.models.output import GeneratorOutput
from meshkit.models.pointwise import PointwiseExtractor
from meshkit.models.presets import GeneratorConfig, corenet3d, load_generator, npt, xdualnet
from meshkit.models.pretrained import PretrainedTransfer, load_pretrained, pretrained_names
from meshkit.models.released import load_released_checkpoint
from meshkit.models.stack import PoseTransferStack
from meshkit.models.symmetry import mirror_labels

__all__ = [
    "NPT",
    "GeneratorConfig",
    "GeneratorOutput",
    "ModelCard",
    "OrderedPoseTransferStack",
    "PointwiseExtractor",
    "PoseTransferGenerator",
    "PoseTransferStack",
    "PretrainedTransfer",
    "corenet3d",
    "export_onnx",
    "load_generator",
    "load_pretrained",
    "load_released_checkpoint",
    "mirror_labels",
    "model_card",
    "npt",
    "pretrained_names",
    "xdualnet",
]
