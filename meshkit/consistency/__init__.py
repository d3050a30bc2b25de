"""Self-supervision wrappers around any generator."""

from meshkit.consistency.dual import DualOutput, DualReconstruction

__all__ = ["DualOutput", "DualReconstruction"]
