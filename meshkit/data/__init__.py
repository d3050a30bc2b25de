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
from meshkit.data.frames import Y_UP_TO_Z_UP, turn_axes
from meshkit.data.licensed import SMAL_FAMILIES, load_smal, load_smpl
from meshkit.data.pairs import PosePairs
from meshkit.data.pool import MeshPool
from meshkit.data.rigged import RiggedModel, rotation_matrices
from meshkit.data.sampler import PairSampler, pair_loader

__all__ = [
    "SMAL_FAMILIES",
    "Y_UP_TO_Z_UP",
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
    "load_smal",
    "load_smpl",
    "pair_loader",
    "rotation_matrices",
    "turn_axes",
]
