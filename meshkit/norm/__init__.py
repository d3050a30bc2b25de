"""Conditional normalisation layers."""

from meshkit.norm.adain import AdaIN, SoftAdaIN, adain, soft_adain
from meshkit.norm.base import ConditionalNorm
from meshkit.norm.elain import ElaIN, elain
from meshkit.norm.modulation import Modulation, modulate
from meshkit.norm.spadain import SPAdaIN, spadain
from meshkit.norm.spade import SPADE, spade
from meshkit.norm.statistics import instance_norm, instance_statistics

__all__ = [
    "SPADE",
    "AdaIN",
    "ConditionalNorm",
    "ElaIN",
    "Modulation",
    "SPAdaIN",
    "SoftAdaIN",
    "adain",
    "elain",
    "instance_norm",
    "instance_statistics",
    "modulate",
    "soft_adain",
    "spadain",
    "spade",
]
