"""Guesses of the unit and the orientation of a body from its vertices alone."""

import numpy as np

from meshkit.io._mesh import Points

_ASYMMETRIC = 0.015  # mean distance to the mirror image, over the diagonal, above which a body is not symmetric
_SLENDER = 2.2  # height over depth above which the longer axis is taken for the height
_CLEAR = 0.015  # differences below this fraction of the height leave doubt
_SAMPLES = 4000

# Unit, and the range of the largest extent of a body in it. The first match counts: adults before children and animals.
_UNITS = (
    ("m", 1.2, 2.4),
    ("cm", 120.0, 240.0),
    ("mm", 1200.0, 2400.0),
    ("in", 48.0, 95.0),
    ("ft", 4.0, 8.0),
    ("m", 0.3, 4.0),
    ("cm", 25.0, 400.0),
    ("mm", 400.0, 4000.0),
)


def guess_unit(extent: float) -> str | None:
    """Unit in which a body's largest extent could be ``extent``."""
    return next((unit for unit, low, high in _UNITS if low <= extent <= high), None)


def guess_frame(points: Points) -> tuple[str | None, str | None]:
    """Signed up axis and signed facing axis of a standing body along the coordinate axes, ``None`` where in doubt.

    The mirror plane tells left-right from the rest. Of the two other axes the height must be clearly the longer one.
    Feet stand apart, the head is in the middle: that tells up from down. Toes stand before the ankles.
    """
    from scipy.spatial import cKDTree

    low, high = points.min(0), points.max(0)
    extent, diagonal = high - low, float(np.linalg.norm(high - low))
    if diagonal == 0:
        return None, None
    centered = points - (low + high) / 2
    tree = cKDTree(centered)
    sample = centered[:: max(1, len(centered) // _SAMPLES)]
    asymmetry = [tree.query(sample * np.where(np.arange(3) == axis, -1, 1))[0].mean() / diagonal for axis in range(3)]
    side = int(np.argmin(asymmetry))
    other = [axis for axis in range(3) if axis != side]
    height, depth = sorted(other, key=lambda axis: -extent[axis])
    if asymmetry[side] > _ASYMMETRIC or extent[height] < _SLENDER * extent[depth]:
        return None, None

    level = centered[:, height] / extent[height]  # -0.5 to 0.5
    apart = [float(np.abs(centered[ends, side]).mean()) for ends in (level < -0.44, level > 0.44)]
    if abs(apart[0] - apart[1]) < _CLEAR * extent[height]:
        return None, None
    sign = 1 if apart[0] > apart[1] else -1
    up = f"{'+' if sign > 0 else '-'}{'xyz'[height]}"

    rise = sign * level + 0.5  # 0 at the soles
    foot, ankle = centered[rise < 0.03, depth], centered[(rise > 0.05) & (rise < 0.10), depth]
    if not len(foot) or not len(ankle):
        return up, None
    middle = float((ankle.min() + ankle.max()) / 2)
    ahead, behind = float(foot.max()) - middle, middle - float(foot.min())
    if abs(ahead - behind) < _CLEAR * extent[height]:
        return up, None
    return up, f"{'+' if ahead > behind else '-'}{'xyz'[depth]}"
