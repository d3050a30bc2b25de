"""Training losses on batches of meshes."""

from meshkit.losses.backward_correspondence import (
    BackwardCorrespondenceLoss,
    PlanLike,
    backward_correspondence_loss,
)
from meshkit.losses.edge_length import EdgeLengthLoss, edge_length_loss
from meshkit.losses.edge_ratio import EdgeRatioLoss, edge_ratio_loss
from meshkit.losses.reconstruction import ReconstructionLoss, reconstruction_loss

__all__ = [
    "BackwardCorrespondenceLoss",
    "EdgeLengthLoss",
    "EdgeRatioLoss",
    "PlanLike",
    "ReconstructionLoss",
    "backward_correspondence_loss",
    "edge_length_loss",
    "edge_ratio_loss",
    "reconstruction_loss",
]
