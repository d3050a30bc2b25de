"""Pose-transfer networks."""

from meshkit.models.generator import GeneratorOutput, PoseTransferGenerator, PoseTransferStack
from meshkit.models.presets import GeneratorConfig, load_generator, xdualnet

__all__ = [
    "GeneratorConfig",
    "GeneratorOutput",
    "PoseTransferGenerator",
    "PoseTransferStack",
    "load_generator",
    "xdualnet",
]
