"""Evaluation metrics; each returns one number per sample, ``(B,)``."""

from meshkit.metrics.chamfer import chamfer_distance
from meshkit.metrics.correspondence import correspondence_error
from meshkit.metrics.pmd import pmd

__all__ = ["chamfer_distance", "correspondence_error", "pmd"]
