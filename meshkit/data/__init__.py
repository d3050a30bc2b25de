"""Rigged bodies, shipped assets and pair sampling."""

from meshkit.data.assets import (
    Split,
    animal_families,
    animal_split,
    human_split,
    load_animals,
    load_humans,
    load_shipped,
)
from meshkit.data.pairs import PairBatch, PairSampler, PosePairs, pair_loader
from meshkit.data.pool import MeshPool
from meshkit.data.rigged import RiggedModel, rotation_matrices

__all__ = [
    "MeshPool",
    "PairBatch",
    "PairSampler",
    "PosePairs",
    "RiggedModel",
    "Split",
    "animal_families",
    "animal_split",
    "human_split",
    "load_animals",
    "load_humans",
    "load_shipped",
    "pair_loader",
    "rotation_matrices",
]
