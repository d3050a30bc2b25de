"""Conditional normalisation layers."""

from meshkit.norm.elain import ElaIN
from meshkit.norm.statistics import instance_statistics

__all__ = ["ElaIN", "instance_statistics"]
