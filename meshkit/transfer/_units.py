"""Units: what is known of the size of a mesh."""

import math
from dataclasses import dataclass

__all__ = ["UNITS", "Scale", "find_scale", "scale_to"]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres in each unit."""

_NO_AREA = "the mesh has no surface area"
_RARE = 0.7  # handicap, in log length, of inches and feet: a tall body in metres is more likely than a dwarf in feet
_NEAR = math.log(1.6)  # sizes within this factor of the mean body are left as they are


@dataclass(frozen=True)
class Scale:
    """How a file's lengths become metres, and how much more they are scaled for the weights.

    Attributes:
        unit: of the file; ``"unknown"`` if the mesh is no body whose size is known.
        metres: per unit.
        fit: further factor that brings a body of unheard-of size to that of the training bodies; else 1.
        given: whether the unit was given, or guessed from the surface.
        metric: whether the bodies that the weights know are in metres; the shipped animals are in a unit of their own.
    """

    unit: str
    metres: float
    fit: float
    given: bool
    metric: bool = True

    @property
    def factor(self) -> float:
        """What coordinates are multiplied with for the weights."""
        return self.metres * self.fit

    @property
    def doubt(self) -> str:
        """What is odd about the size, in words; empty if nothing is."""
        if self.fit == 1 or not (self.metric or self.given):
            return ""
        unit = f"the unit given, {self.unit}" if self.given else "any unit"
        return f"far from the size of the training bodies in {unit}: scaled by {self.fit:.3g}"

    def __str__(self) -> str:
        if not self.metric and not self.given:
            text, scaled = "unknown", self.factor
        else:
            text, scaled = f"{self.unit} ({'given' if self.given else 'guessed from the surface area'})", self.fit
        return text if scaled == 1 else f"{text}, scaled by {scaled:.3g} to the size that the weights know"


def find_scale(area: float, reference_area: float, unit: str | None, *, among: tuple[str, ...] = tuple(UNITS)) -> Scale:
    """Unit and scale of a body from its surface, which hardly changes with the pose.

    The unit is the one in which the body comes nearest to the reference; inches and feet must be clearly nearer. A
    body further than a factor of 1.6 (in length) from the reference is scaled to it.

    Args:
        area: of the surface, in the file's unit squared.
        reference_area: of the mean training body, in square metres.
        unit: of the file, if it is known.
        among: units to guess among. Bodies that differ as much in size as a mouse and a horse say little about theirs.

    Raises:
        ValueError: no area, or an unknown unit.
    """
    if not area > 0:
        raise ValueError(_NO_AREA)
    if unit is not None and unit not in UNITS:
        raise ValueError(f"the unit must be one of {', '.join(UNITS)}, got {unit!r}")
    excess = math.log(area / reference_area) / 2

    def distance(name: str) -> float:
        return abs(excess + math.log(UNITS[name])) + (_RARE if name in ("in", "ft") else 0.0)

    chosen = unit or min(among, key=distance)
    left = excess + math.log(UNITS[chosen])
    return Scale(chosen, UNITS[chosen], 1.0 if abs(left) <= _NEAR else math.exp(-left), unit is not None)


def scale_to(area: float, reference_area: float) -> Scale:
    """The scale of a mesh of which nothing is known: to the size of the mean training body, in no unit.

    Raises:
        ValueError: no area.
    """
    if not area > 0:
        raise ValueError(_NO_AREA)
    return Scale("unknown", math.sqrt(reference_area / area), 1.0, given=False, metric=False)
