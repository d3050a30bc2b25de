"""Optimal-transport layers: Sinkhorn plans between feature sets, exact gradients, no N x M matrix."""

from meshkit.ot.divergence import sinkhorn_divergence
from meshkit.ot.dustbin import log_optimal_transport
from meshkit.ot.layers import CorrespondenceWarp, SinkhornCorrespondence
from meshkit.ot.plan import TransportPlan
from meshkit.ot.sinkhorn import eps_schedule, sinkhorn, sinkhorn_from_cost, sinkhorn_warp
from meshkit.ot.workspace import clear_workspace

__all__ = [
    "CorrespondenceWarp",
    "SinkhornCorrespondence",
    "TransportPlan",
    "clear_workspace",
    "eps_schedule",
    "log_optimal_transport",
    "sinkhorn",
    "sinkhorn_divergence",
    "sinkhorn_from_cost",
    "sinkhorn_warp",
]
