"""Axes and units: from any file's to those that the weights were trained in, and back."""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from meshkit.batching import center
from meshkit.models import PoseTransferGenerator, PretrainedTransfer
from meshkit.models._released_matching import DensePlan
from meshkit.ot import TransportPlan
from meshkit.topology import vertex_normals
from meshkit.transfer.confidence import row_entropies

__all__ = [
    "DOUBT",
    "UNITS",
    "axis_name",
    "axis_vector",
    "find_rotation",
    "find_scale",
    "rotations",
    "turn_up",
    "turns_about",
]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres in each unit."""

DOUBT = 0.03
"""Lead in score below which an orientation is in doubt."""

_RARE = 0.7  # handicap, in log length, of inches and feet: a tall body in metres is more likely than a dwarf in feet
_NEAR = math.log(1.6)  # sizes within this factor of the mean body are left as they are
_CLEAR = 0.05  # score by which another orientation must beat the usual ones


def axis_vector(axis: str) -> Tensor:
    """Unit vector (3,) of a signed axis such as ``"+z"`` or ``"-y"``.

    Raises:
        ValueError: no such axis.
    """
    sign, letter = (axis[0], axis[1:]) if axis[:1] in "+-" else ("+", axis)
    if letter not in ("x", "y", "z"):
        raise ValueError(f"an axis is +x, -x, +y, -y, +z or -z, got {axis!r}")
    vector = torch.zeros(3)
    vector["xyz".index(letter)] = -1.0 if sign == "-" else 1.0
    return vector


def axis_name(vector: Tensor) -> str:
    """Signed axis nearest to a vector."""
    index = int(vector.abs().argmax())
    return f"{'-' if vector[index] < 0 else '+'}{'xyz'[index]}"


def rotations(up: str | None = None, facing: str | None = None) -> Tensor:
    """The rotations (R, 3, 3) along the axes that bring ``up`` to +z and ``facing`` to -y; the identity first.

    ``verts @ rotation.T`` turns. Without ``up`` and ``facing`` there are 24, with one of them 4, with both 1.

    Raises:
        ValueError: no such axis, or two parallel ones.
    """
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = torch.zeros(3, 3)
            matrix[range(3), order] = torch.tensor(signs)
            fits = torch.linalg.det(matrix) > 0
            fits &= up is None or bool((matrix[2] == axis_vector(up)).all())
            fits &= facing is None or bool((matrix[1] == -axis_vector(facing)).all())
            found += [matrix] if fits else []
    if not found:
        raise ValueError(f"up and facing must be at right angles, got {up} and {facing}")
    return torch.stack(sorted(found, key=lambda matrix: -float(matrix.trace())))


def turns_about(rotation: Tensor) -> Tensor:
    """A rotation (3, 3) and the six that are a quarter turn away: (7, 3, 3), itself first."""
    quarters = [torch.eye(3), *(turn for turn in rotations() if abs(float(turn.trace()) - 1) < 0.5)]
    return torch.stack(quarters).to(rotation) @ rotation


def turn_up(source: Tensor, target: Tensor) -> Tensor:
    """The least rotation (3, 3) along the axes that takes one up axis to another."""
    if bool((source == target).all()):
        return torch.eye(3)
    axis = torch.linalg.cross(source, target)
    if not bool(axis.any()):  # opposite: a half turn about x, or about y if x is up
        return torch.diag(torch.tensor([1.0, -1, -1] if source[0] == 0 else [-1.0, 1, -1]))
    return torch.outer(axis, axis) + torch.outer(target, source) - torch.outer(source, target)


@dataclass(frozen=True)
class Scale:
    """How a file's lengths become metres, and how much more they are scaled for the weights.

    Attributes:
        unit: of the file.
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
        text = f"{self.unit} ({'given' if self.given else 'guessed from the surface area'})"
        if not self.metric and not self.given:
            text = (
                "unknown, near that of the weights" if self.metres == 1 else f"unknown, {self.metres:g} of the weights'"
            )
        return text if self.fit == 1 else f"{text}, scaled by {self.fit:.3g} to the size that the weights know"


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
        raise ValueError("the mesh has no surface area")
    if unit is not None and unit not in UNITS:
        raise ValueError(f"the unit must be one of {', '.join(UNITS)}, got {unit!r}")
    excess = math.log(area / reference_area) / 2

    def distance(name: str) -> float:
        return abs(excess + math.log(UNITS[name])) + (_RARE if name in ("in", "ft") else 0.0)

    chosen = unit or min(among, key=distance)
    left = excess + math.log(UNITS[chosen])
    return Scale(chosen, UNITS[chosen], 1.0 if abs(left) <= _NEAR else math.exp(-left), unit is not None)


@torch.no_grad()
def find_rotation(
    net: PretrainedTransfer,
    verts: Tensor,
    faces: Tensor,
    *,
    descriptors: Tensor | None,
    reference: tuple[Tensor, Tensor],
    candidates: Tensor,
    usual: Tensor | None = None,
) -> tuple[Tensor, float]:
    r"""The rotation after which a mesh, as the weights match it, lies most like a rest body.

    The mesh, turned by each candidate, is matched to the rest body by the weights. Chest, back, toes and nose are told
    apart by the matching, and their normals by the direction they look in: so the normals n of the mesh and those n' of
    the matched places must agree, and, which counts less, so must the positions x and x' about their means, and the
    matching must be sharp. The score is

    .. math:: \mathrm{corr}(n, n') + \tfrac18 \left( \mathrm{corr}(x, x') - H \right), \qquad
              \mathrm{corr}(a, b) = \frac{\sum_i a_i \cdot b_i}{\lVert a \rVert \, \lVert b \rVert}

    with the mean entropy H, in nats, of the rows of the matching. This works in any pose, where symmetry and the
    longest axis do not. Of two nearly equal scores the usual orientation's counts more.

    Args:
        net: weights with a matching.
        verts: (V, 3), scaled to metres.
        faces: (F, 3).
        descriptors: (V, D) what the weights say of the mesh; ``None`` if they take none.
        reference: vertices and faces of a rest body in the frame of the weights.
        candidates: (R, 3, 3) rotations.
        usual: (K, 3, 3) those of them that another must beat by 0.05, as most files have them; if ``None``, up +z,
            facing -y, and up +y, facing +z.

    Returns:
        The rotation (3, 3), and by how much its score is above that of the next best, below 0 if it was favoured.
    """
    generator = net.generator
    if len(candidates) == 1:
        return candidates[0], math.inf
    if not isinstance(generator, PoseTransferGenerator):
        raise ValueError("these weights have no matching to find the orientation with: give up and facing")
    rest, rest_faces = reference[0].to(verts), reference[1].to(faces.device)
    rest_features = generator.encode(center(rest[None]), descriptors=_batched(net.describe(rest, rest_faces)))
    surface = torch.cat([center(rest[None])[0], vertex_normals(rest, rest_faces)], 1)[None]
    normals = vertex_normals(verts, faces)
    scores = []
    for rotation in candidates.to(verts):
        turned = center((verts @ rotation.T)[None])
        plan = generator.match(generator.encode(turned, descriptors=_batched(descriptors)), rest_features)
        there = plan.barycentric(surface)[0]
        like = _correlation(turned[0] - turned[0].mean(0), there[:, :3] - there[:, :3].mean(0))
        like = like - _mean_row_entropy(plan)
        scores.append(_correlation(normals @ rotation.T, there[:, 3:]) + like / 8)
    usual = torch.cat([rotations("+z", "-y"), rotations("+y", "+z")]) if usual is None else usual
    favoured = (candidates[:, None] == usual.to(candidates)).all(-1).all(-1).any(1)
    score = torch.tensor(scores)
    best = int((score + _CLEAR * favoured.cpu()).argmax())
    others = score[torch.arange(len(score)) != best]
    return candidates[best], float(score[best] - others.max())


def _mean_row_entropy(plan: TransportPlan | DensePlan) -> float:
    if isinstance(plan, TransportPlan):  # its rows sum to 1 / N each; far cheaper than to write out the matrix
        return float(plan.entropy()[0]) - math.log(plan.shape[1])
    return float(row_entropies(plan.dense()[0]).mean())


def _correlation(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum() / (a.norm() * b.norm()).clamp_min(1e-12))


def _batched(descriptors: Tensor | None) -> Tensor | None:
    return None if descriptors is None else descriptors[None]
