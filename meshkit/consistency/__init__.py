"""Self-supervision wrappers around any generator."""

from meshkit.consistency.adapter import AdaptedOutput, GeneratorAdapter
from meshkit.consistency.cycle import CycleOutput, CycleReconstruction
from meshkit.consistency.dual import DualOutput, DualReconstruction
from meshkit.consistency.self_reconstruction import SelfOutput, SelfReconstruction

__all__ = [
    "AdaptedOutput",
    "CycleOutput",
    "CycleReconstruction",
    "DualOutput",
    "DualReconstruction",
    "GeneratorAdapter",
    "SelfOutput",
    "SelfReconstruction",
]
