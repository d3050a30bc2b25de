"""Training losses on batches of meshes."""

from meshkit.deform import arap_energy
from meshkit.losses.backward_correspondence import (
    BackwardCorrespondenceLoss,
    PlanLike,
    backward_correspondence_loss,
)
from meshkit.losses.chamfer import ChamferLoss, chamfer_loss
from meshkit.losses.edge_length import EdgeLengthLoss, edge_length_loss
from meshkit.losses.edge_ratio import EdgeRatioLoss, edge_ratio_loss
from meshkit.losses.laplacian import LaplacianLoss, laplacian_loss
from meshkit.losses.matching import MatchingLoss, matching_loss
from meshkit.losses.normal_consistency import NormalConsistencyLoss, normal_consistency_loss
from meshkit.losses.per_sample import ARAPEnergyLoss, SinkhornDivergenceLoss
from meshkit.losses.reconstruction import ReconstructionLoss, reconstruction_loss
from meshkit.ot import sinkhorn_divergence

__all__ = [
    "ARAPEnergyLoss",
    "BackwardCorrespondenceLoss",
    "ChamferLoss",
    "EdgeLengthLoss",
    "EdgeRatioLoss",
    "LaplacianLoss",
    "MatchingLoss",
    "NormalConsistencyLoss",
    "PlanLike",
    "ReconstructionLoss",
    "SinkhornDivergenceLoss",
    "arap_energy",
    "backward_correspondence_loss",
    "chamfer_loss",
    "edge_length_loss",
    "edge_ratio_loss",
    "laplacian_loss",
    "matching_loss",
    "normal_consistency_loss",
    "reconstruction_loss",
    "sinkhorn_divergence",
]
