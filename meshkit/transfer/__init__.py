"""Pose transfer between any two meshes."""

from meshkit.transfer.confidence import Confidence, confidence, usual_range
from meshkit.transfer.transfer import PoseTransfer, TransferReport, TransferResult, transfer_pose

__all__ = [
    "Confidence",
    "PoseTransfer",
    "TransferReport",
    "TransferResult",
    "confidence",
    "transfer_pose",
    "usual_range",
]
