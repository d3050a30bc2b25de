"""An opened mesh made ready for the weights, and the way back."""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from meshkit.io import CleanMesh, MeshReport, SimpleMesh
from meshkit.models import PretrainedTransfer
from meshkit.transfer._frames import axis_name, rotations
from meshkit.transfer._kinds import Likeness, rest_body, surface_area
from meshkit.transfer._open import OpenedMesh, named
from meshkit.transfer._openings import Openings, find_openings
from meshkit.transfer._orient import RestBody, agrees, find_rotation
from meshkit.transfer._units import UNITS, Scale, find_scale, scale_to
from meshkit.transfer.confidence import roughness

__all__ = ["Prepared", "prepare"]

_GIVEN = "given"
_ONE_BODY = 0.75  # share of the area that one surface of a whole body has: eyes and teeth are far less than the rest


@dataclass(frozen=True)
class Prepared:
    """One mesh on its way to the weights.

    Attributes:
        opened: the mesh as it came.
        clean: the one clean surface of it, scaled.
        simple: that with fewer vertices.
        descriptors: (N, D) what the weights take of the simple mesh; ``None`` if they take none.
        scale: how its lengths became metres.
        rotation: (3, 3) takes the file's axes to those of the weights.
        how: what ``rotation`` rests on.
        clear: whether ``rotation`` is beyond doubt.
        likeness: the kind of body that it is like; ``None`` if the weights do not say what they are for.
        openings: holes of the clean surface; in a sequence, of the first mesh with these faces.
        notes: what was done or should be known.
    """

    opened: OpenedMesh
    clean: CleanMesh
    simple: SimpleMesh
    descriptors: Tensor | None
    scale: Scale
    rotation: Tensor
    how: str
    clear: bool
    likeness: Likeness | None
    openings: Openings
    notes: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of the file, or what the mesh is for."""
        return self.opened.name

    @property
    def faces(self) -> Tensor:
        """(F, 3) as they came."""
        return self.opened.faces

    @property
    def verts(self) -> Tensor:
        """(N, 3) simple vertices in the frame of the weights."""
        return self.simple.verts @ self.rotation.T

    @cached_property
    def roughness(self) -> float:
        """:func:`~meshkit.transfer.confidence.roughness` of the simple mesh."""
        return roughness(self.simple.verts, self.simple.faces)

    @property
    def up(self) -> Tensor:
        """(3,) the body's up axis in the file."""
        return self.rotation[2]

    @property
    def found(self) -> str:
        """How ``rotation`` came about, and whether that is in doubt."""
        return self.how if self.clear or self.how == _GIVEN else f"{self.how}, in doubt"

    @property
    def loss(self) -> str:
        """What is to be said of a mesh of which much was left out as another part; empty if that is not so."""
        share = self.clean.kept_area
        if share >= _ONE_BODY:
            return ""
        return (
            f"in parts, and the largest, which alone is used, has {share:.0%} of the area: join those of the body into "
            "one surface, and take clothes and props away"
        )

    @property
    def doubts(self) -> tuple[str, ...]:
        """What may be wrong with its size and axes, in words that do not name it."""
        found = (self.scale.doubt,) if self.scale.doubt else ()
        if self.clear:
            return found
        axes = f"up {axis_name(self.up)}, facing {axis_name(-self.rotation[1])}"
        if self.how == _GIVEN:
            return (*found, f"the axes given ({axes}) seem wrong: leave them out to have them found")
        return (*found, f"axes in doubt ({axes}): give them, up and facing, if they are wrong")

    def is_same(self, other: "Prepared") -> bool:
        """Whether both come from the same vertices and faces, at one scale."""
        same_faces = torch.equal(self.faces.cpu(), other.faces.cpu())
        return same_faces and torch.equal(self.clean.original, other.clean.original)

    def carry(self, deformed: Tensor) -> Tensor:
        """(V, 3) all vertices of the file, from the simple ones (N, 3) deformed; in the frame of the weights."""
        return self.clean.carry(self.simple.carry(deformed))

    def __str__(self) -> str:
        facing = axis_name(-self.rotation[1])
        lines = [line for line in str(self.opened.report).splitlines() if not line.startswith("frame")]
        # The report guesses unit and frame from the extent alone; what was taken follows.
        lines = [line.partition(", if this")[0].partition(", the size of")[0] for line in lines]
        lines.append(f"frame    up {axis_name(self.up)}, facing {facing} ({self.found}); unit {self.scale}")
        return "\n".join(lines + [f"done     {note}" for note in self.notes])


def prepare(
    opened: OpenedMesh,
    *,
    net: PretrainedTransfer,
    kind: str | None,
    num_verts: int,
    unit: str | None = None,
    up: str | None = None,
    facing: str | None = None,
    rest: RestBody | None = None,
) -> Prepared:
    """Scale, simplify and orient a mesh.

    Args:
        opened: the mesh.
        net: the weights, which find the orientation.
        kind: ``"humans"`` or ``"animals"``, whose mean body gives size and frame; ``None`` if the weights know neither:
            then unit, up and facing must be given or clear from the mesh.
        num_verts: vertices that the weights are used to.
        unit: of the file; guessed if ``None``.
        up: signed axis to the body's head (or back, for an animal); found if ``None``.
        facing: signed axis that the body looks along; found if ``None``.
        rest: ``RestBody(net, kind)``, if it is at hand.

    Raises:
        ValueError: the mesh cannot be used; the message says why.
    """
    name, report, clean, notes = opened.name, opened.report, opened.clean, opened.notes
    net_device = next(net.parameters()).device
    likeness = None if kind is None else opened.likeness  # it costs a spectrum
    scale = named(name, lambda: _scale(opened, kind, likeness, unit))

    def scaled(verts: Tensor) -> Tensor:
        return (verts * scale.factor).float().to(net_device)

    metric = dataclasses.replace(
        clean, verts=scaled(clean.verts), faces=clean.faces.to(net_device), original=scaled(clean.original)
    )
    simple = opened.simplified(num_verts)
    simple = dataclasses.replace(
        simple,
        verts=scaled(simple.verts),
        faces=simple.faces.to(net_device),
        original=metric.verts,
        original_faces=metric.faces,
    )
    if simple.method != "none":
        notes += (f"simplified to {len(simple.verts)} vertices",)
    elif len(simple.verts) < 0.8 * num_verts:
        notes += (f"only {len(simple.verts)} vertices; the weights are used to {num_verts}",)
    openings = named(name, lambda: find_openings(clean.verts, clean.faces))  # not of the seams that were welded
    if openings.loops:
        notes += (f"the surface is open ({openings}), which the weights have not seen",)
    descriptors = named(name, lambda: net.describe(simple.verts, simple.faces))
    rest = rest or (None if kind is None else RestBody(net, kind))
    rotation, how, clear = named(name, lambda: _rotation(report, simple, descriptors, rest, up, facing))
    rotation = rotation.to(metric.verts)
    return Prepared(opened, metric, simple, descriptors, scale, rotation, how, clear, likeness, openings, notes)


def _scale(opened: OpenedMesh, kind: str | None, likeness: Likeness | None, unit: str | None) -> Scale:
    area = float(surface_area(opened.clean.verts, opened.clean.faces))
    usual_area = float(surface_area(*rest_body(kind or "humans")))
    if unit is None and likeness is not None and not (likeness.clear and likeness.kind == kind):
        return scale_to(area, usual_area)  # the size says nothing about the unit
    among = ("m", "cm", "mm") if kind == "animals" else tuple(UNITS)
    return dataclasses.replace(find_scale(area, usual_area, unit, among=among), metric=kind != "animals")


def _rotation(
    report: MeshReport,
    simple: SimpleMesh,
    descriptors: Tensor | None,
    rest: RestBody | None,
    up: str | None,
    facing: str | None,
) -> tuple[Tensor, str, bool]:
    """The rotation, how it came about, and whether it is clear."""
    if up is not None and facing is not None:
        rotation = rotations(up, facing)[0]
        clear = rest is None or agrees(rest, simple.verts, simple.faces, descriptors=descriptors, rotation=rotation)
        return rotation, _GIVEN, clear
    if rest is None:
        up, facing = up or report.up, facing or report.facing
        if up is None or facing is None:
            raise ValueError("up and facing are not clear, and these weights do not say what they know: give both")
        return rotations(up, facing)[0], "guessed from symmetry and feet", True
    candidates = rotations(up, facing)
    rotation, clear = find_rotation(rest, simple.verts, simple.faces, descriptors=descriptors, candidates=candidates)
    return rotation, "found by matching to a rest body" if up is None and facing is None else "partly given", clear
