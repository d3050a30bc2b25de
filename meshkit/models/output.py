"""What every generator returns."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from meshkit.models._released_matching import DensePlan
from meshkit.ot import TransportPlan

__all__ = ["GeneratorOutput"]


class GeneratorOutput(NamedTuple):
    """What a generator returns.

    Args:
        vertices: ``(B, N, 3)`` generated mesh: identity of one input, pose of the other, vertex order of the identity.
        warped: ``(B, N, 3)`` the pose mesh's vertices redistributed to the identity's order; ``None`` from a generator
            without correspondence.
        plan: matching between identity rows and pose columns; ``None`` from a generator without correspondence.
    """

    vertices: Tensor
    warped: Tensor | None
    plan: TransportPlan | DensePlan | None
