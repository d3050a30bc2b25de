"""A mesh of unknown origin made ready for the weights, and the way back."""

import dataclasses
import os
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from meshkit.io import CleanMesh, MeshFileError, MeshReport, SimpleMesh, clean_mesh, load_mesh, mesh_report, simplify
from meshkit.models import PretrainedTransfer
from meshkit.transfer._frames import DOUBT, UNITS, Scale, axis_name, find_rotation, find_scale, rotations
from meshkit.transfer._kinds import rest_body

__all__ = ["Mesh", "Prepared", "prepare", "read"]

Mesh = str | os.PathLike[str] | tuple[Tensor, Tensor]
"""A mesh file, or vertices (V, 3) and faces (F, 3)."""

_FEWEST = 64  # the signatures rest on 64 eigenpairs


@dataclass(frozen=True)
class Prepared:
    """One mesh on its way to the weights.

    Attributes:
        name: of the file, or what the mesh is for.
        faces: (F, 3) as they came.
        report: on the mesh as it came.
        clean: the one clean surface of it, scaled.
        simple: that with fewer vertices.
        scale: how its lengths became metres.
        rotation: (3, 3) takes the file's axes to those of the weights.
        found: how ``rotation`` came about.
        notes: what was done or should be known.
    """

    name: str
    faces: Tensor
    report: MeshReport
    clean: CleanMesh
    simple: SimpleMesh
    scale: Scale
    rotation: Tensor
    found: str
    notes: tuple[str, ...]

    @property
    def verts(self) -> Tensor:
        """(N, 3) simple vertices in the frame of the weights."""
        return self.simple.verts @ self.rotation.T

    @property
    def up(self) -> Tensor:
        """(3,) the body's up axis in the file."""
        return self.rotation[2]

    def carry(self, deformed: Tensor) -> Tensor:
        """(V, 3) all vertices of the file, from the simple ones (N, 3) deformed; in the frame of the weights."""
        return self.clean.carry(self.simple.carry(deformed))

    def __str__(self) -> str:
        facing = axis_name(-self.rotation[1])
        lines = [f"{line}" for line in str(self.report).splitlines() if not line.startswith("frame")]
        lines.append(f"frame    up {axis_name(self.up)}, facing {facing} ({self.found}); unit {self.scale}")
        return "\n".join(lines + [f"done     {note}" for note in self.notes])


def read(mesh: Mesh, role: str) -> tuple[str, Tensor, Tensor, tuple[str, ...]]:
    """Name, vertices and faces of a mesh, and what the reader warned about.

    Raises:
        MeshFileError: the file is missing, damaged or no mesh.
        ValueError: something else than a path or two tensors.
    """
    if isinstance(mesh, str | os.PathLike):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            verts, faces = load_mesh(mesh)
        return os.fspath(mesh), verts, faces, tuple(str(w.message) for w in caught)
    if not (isinstance(mesh, tuple) and len(mesh) == 2 and all(isinstance(part, Tensor) for part in mesh)):
        raise ValueError(f"{role} must be a path or a tuple (verts, faces) of tensors, got {type(mesh).__name__}")
    return role, mesh[0].detach(), mesh[1], ()


def prepare(
    mesh: Mesh,
    role: str,
    *,
    net: PretrainedTransfer,
    kind: str | None,
    num_verts: int,
    unit: str | None = None,
    up: str | None = None,
    facing: str | None = None,
) -> Prepared:
    """Report on a mesh, clean, scale, simplify and orient it.

    Args:
        mesh: file or tensors.
        role: what it is for, for messages.
        net: the weights, which find the orientation.
        kind: ``"humans"`` or ``"animals"``, whose mean body gives size and frame; ``None`` if the weights know neither:
            then unit, up and facing must be given or clear from the mesh.
        num_verts: vertices that the weights are used to.
        unit: of the file; guessed if ``None``.
        up: signed axis to the body's head (or back, for an animal); found if ``None``.
        facing: signed axis that the body looks along; found if ``None``.

    Raises:
        MeshFileError: the file is missing, damaged or no mesh.
        ValueError: the mesh cannot be used; the message says why.
    """
    name, verts, faces, notes = read(mesh, role)
    report = named(name, lambda: mesh_report(verts, faces))
    clean = named(name, lambda: clean_mesh(verts, faces))
    if len(clean.verts) < _FEWEST:
        raise ValueError(
            f"{name}: {len(clean.verts)} vertices in its largest part; a body needs {_FEWEST} or more to be recognised"
        )
    if clean.changes:
        notes += (f"cleaned: {clean}",)
    net_device = next(net.parameters()).device
    among = ("m", "cm", "mm") if kind == "animals" else tuple(UNITS)
    area = _area(clean.verts, clean.faces)
    scale = named(name, lambda: find_scale(area, _reference_area(kind), unit, among=among))
    scale = dataclasses.replace(scale, metric=kind != "animals")
    metric = dataclasses.replace(
        clean,
        verts=(clean.verts * scale.factor).float().to(net_device),
        faces=clean.faces.to(net_device),
        original=(clean.original * scale.factor).float().to(net_device),
    )
    simple = named(name, lambda: simplify(metric.verts, metric.faces, num_verts))
    if simple.method != "none":
        notes += (f"simplified to {len(simple.verts)} vertices",)
    elif len(simple.verts) < 0.8 * num_verts:
        notes += (f"only {len(simple.verts)} vertices; the weights are used to {num_verts}",)
    if report.boundary_edges:
        notes += (f"the surface is open ({report.boundary_loops} holes), which the weights have not seen",)
    rotation, found = named(name, lambda: _rotation(report, simple, net, kind, up, facing))
    return Prepared(name, faces, report, metric, simple, scale, rotation.to(metric.verts), found, notes)


def _rotation(
    report: MeshReport,
    simple: SimpleMesh,
    net: PretrainedTransfer,
    kind: str | None,
    up: str | None,
    facing: str | None,
) -> tuple[Tensor, str]:
    if up is not None and facing is not None:
        return rotations(up, facing)[0], "given"
    if kind is None:
        up, facing = up or report.up, facing or report.facing
        if up is None or facing is None:
            raise ValueError("up and facing are not clear, and these weights do not say what they know: give both")
        return rotations(up, facing)[0], "guessed from symmetry and feet"
    rotation, lead = find_rotation(
        net, simple.verts, simple.faces, reference=rest_body(kind), candidates=rotations(up, facing)
    )
    found = "found by matching to a rest body" if up is None and facing is None else "partly given"
    return rotation, found if lead > DOUBT else f"{found}, in doubt: give it if it is wrong"


def named(name, make):  # type: ignore[no-untyped-def]
    """Run ``make`` and put the mesh's name before what it complains about."""
    try:
        return make()
    except ValueError as error:
        # Other kinds of ValueError, such as UnicodeDecodeError, cannot be made from a text.
        kind = MeshFileError if isinstance(error, MeshFileError) else ValueError
        raise kind(f"{name}: {error}") from error


def _reference_area(kind: str | None) -> float:
    return _area(*rest_body(kind or "humans"))


def _area(verts: Tensor, faces: Tensor) -> float:
    a, b, c = (verts.double()[faces[:, k]] for k in range(3))
    return float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2)
