"""Optimal-transport layers: Sinkhorn plans between feature sets."""

from meshkit.ot.plan import TransportPlan
from meshkit.ot.sinkhorn import sinkhorn

__all__ = ["TransportPlan", "sinkhorn"]
