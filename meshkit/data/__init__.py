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
from meshkit.data.batch import PairBatch
from meshkit.data.pairs import PosePairs
from meshkit.data.pool import MeshPool
from meshkit.data.rigged import RiggedModel, rotation_matrices
from meshkit.data.sampler import PairSampler, pair_loader

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
