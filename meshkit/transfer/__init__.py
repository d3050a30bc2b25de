"""Pose transfer between any two meshes."""

from meshkit.transfer.confidence import Confidence, measure_confidence, usual_range
from meshkit.transfer.output import save_page, save_picture
from meshkit.transfer.report import Doubt, TransferReport, TransferResult
from meshkit.transfer.sequence import UnusablePosesError, read_sequence, transfer_sequence
from meshkit.transfer.transfer import PoseTransfer, transfer_pose

__all__ = [
    "Confidence",
    "Doubt",
    "PoseTransfer",
    "TransferReport",
    "TransferResult",
    "UnusablePosesError",
    "measure_confidence",
    "read_sequence",
    "save_page",
    "save_picture",
    "transfer_pose",
    "transfer_sequence",
    "usual_range",
]
