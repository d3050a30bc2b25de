"""Pose transfer between any two meshes."""

from meshkit.transfer.confidence import Confidence, confidence, usual_range

__all__ = ["Confidence", "confidence", "usual_range"]
