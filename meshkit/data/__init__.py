"""Rigged bodies, shipped assets and pair sampling."""

from meshkit.data.assets import Split, human_split, load_humans
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
    "human_split",
    "load_humans",
    "pair_loader",
    "rotation_matrices",
]
