"""Rigged bodies, shipped and licensed; mesh folders; and pairs of either."""

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
from meshkit.data.layouts import (
    RELEASED_SPLITS,
    MeshEntry,
    PairSplit,
    read_test_list,
    scan_faust,
    scan_mgn,
    scan_pose_transfer,
)
from meshkit.data.licensed import SMAL_FAMILIES, load_smal, load_smpl
from meshkit.data.mesh_pairs import MeshPairs
from meshkit.data.pairs import PosePairs
from meshkit.data.pool import MeshPool
from meshkit.data.rigged import RiggedModel, rotation_matrices
from meshkit.data.sampler import PairSampler, pair_loader
from meshkit.data.sampling import sample_bone_factors, sample_identities, sample_poses, scale_bones
from meshkit.data.store import MeshStore

__all__ = [
    "RELEASED_SPLITS",
    "SMAL_FAMILIES",
    "Y_UP_TO_Z_UP",
    "MeshEntry",
    "MeshPairs",
    "MeshPool",
    "MeshStore",
    "PairBatch",
    "PairSampler",
    "PairSplit",
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
    "read_test_list",
    "rotation_matrices",
    "sample_bone_factors",
    "sample_identities",
    "sample_poses",
    "scale_bones",
    "scan_faust",
    "scan_mgn",
    "scan_pose_transfer",
    "turn_axes",
]
