"""Evaluation metrics: functions with one value per sample, ``(B,)``, and classes that average over a data set."""

from meshkit.metrics.accumulate import (
    PMD,
    ChamferDistance,
    CorrespondenceError,
    EarthMoversDistance,
    EdgeRatio,
    MeanMetric,
    SelfIntersectionRate,
    VolumeChange,
)
from meshkit.metrics.chamfer import ChamferDetails, chamfer_distance
from meshkit.metrics.correspondence import correspondence_auc, correspondence_curve, correspondence_error
from meshkit.metrics.earth_movers import EarthMoversBounds, earth_movers_bounds, earth_movers_distance
from meshkit.metrics.edge_ratio import edge_ratio
from meshkit.metrics.pmd import pmd
from meshkit.metrics.self_intersection import self_intersection_rate
from meshkit.metrics.volume import volume_change

__all__ = [
    "PMD",
    "ChamferDetails",
    "ChamferDistance",
    "CorrespondenceError",
    "EarthMoversBounds",
    "EarthMoversDistance",
    "EdgeRatio",
    "MeanMetric",
    "SelfIntersectionRate",
    "VolumeChange",
    "chamfer_distance",
    "correspondence_auc",
    "correspondence_curve",
    "correspondence_error",
    "earth_movers_bounds",
    "earth_movers_distance",
    "edge_ratio",
    "pmd",
    "self_intersection_rate",
    "volume_change",
]
