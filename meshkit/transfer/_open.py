"""A mesh of unknown origin read, reported on and cleaned: what does not depend on the weights."""

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from torch import Tensor

from meshkit.io import CleanMesh, MeshFileError, MeshReport, SimpleMesh, clean_mesh, load_mesh, mesh_report, simplify
from meshkit.transfer._kinds import Likeness, guess_kind

__all__ = ["Mesh", "OpenedMesh", "clean_body", "examine", "named", "open_mesh", "read"]

T = TypeVar("T")
Mesh = str | os.PathLike[str] | tuple[Tensor, Tensor]
"""A mesh file, or vertices (V, 3) and faces (F, 3)."""

_FEWEST = 64  # the signatures rest on 64 eigenpairs
_LOOKED_AT = 1000  # vertices that tell people from animals


@dataclass(frozen=True)
class OpenedMesh:
    """One mesh as it came, and its clean surface: what does not depend on the weights.

    Attributes:
        name: of the file, or what the mesh is for.
        faces: (F, 3) as they came.
        report: on the mesh as it came.
        clean: the one clean surface of it, in the file's axes and unit.
        notes: what was done or should be known.
    """

    name: str
    faces: Tensor
    report: MeshReport
    clean: CleanMesh
    notes: tuple[str, ...]

    def simplified(self, num_verts: int) -> SimpleMesh:
        """The clean surface with ``num_verts`` vertices, as far as it has more."""
        return self._looked_at if num_verts == _LOOKED_AT else self._simplify(num_verts)

    @cached_property
    def likeness(self) -> Likeness:
        """What :func:`guess_kind` says of it."""
        small = self._looked_at
        return named(self.name, lambda: guess_kind(small.verts, small.faces))

    @cached_property
    def _looked_at(self) -> SimpleMesh:
        return self._simplify(_LOOKED_AT)

    def _simplify(self, num_verts: int) -> SimpleMesh:
        return named(self.name, lambda: simplify(self.clean.verts, self.clean.faces, num_verts))


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
        parts = ", ".join(type(part).__name__ for part in mesh) if isinstance(mesh, tuple) else None
        raise ValueError(
            f"{role} must be a path or a tuple (verts, faces) of two tensors, got "
            f"{type(mesh).__name__ if parts is None else f'({parts})'}; torch.as_tensor makes tensors of arrays"
        )
    return role, mesh[0].detach(), mesh[1], ()


def open_mesh(mesh: Mesh, role: str) -> OpenedMesh:
    """Read a mesh, report on it and clean it.

    Args:
        mesh: file or tensors.
        role: what it is for, for messages.

    Raises:
        MeshFileError: the file is missing, damaged or no mesh.
        ValueError: the mesh cannot be used; the message says why.
    """
    return examine(*read(mesh, role))


def examine(name: str, verts: Tensor, faces: Tensor, notes: tuple[str, ...]) -> OpenedMesh:
    """As :func:`open_mesh`, of a mesh that was read."""
    report = named(name, lambda: mesh_report(verts, faces))
    clean = clean_body(name, verts, faces)
    if clean.changes:
        notes += (f"cleaned: {clean}",)
    return OpenedMesh(name, faces, report, clean, notes)


def clean_body(name: str, verts: Tensor, faces: Tensor) -> CleanMesh:
    """The clean surface of a mesh that was read.

    Raises:
        ValueError: it cannot be used; the message says why.
    """
    clean = named(name, lambda: clean_mesh(verts, faces))
    if len(clean.verts) < _FEWEST:
        raise ValueError(
            f"{name}: {len(clean.verts)} vertices in its largest part; a body needs {_FEWEST} or more to be recognised"
        )
    return clean


def named(name: str, make: Callable[[], T]) -> T:
    """Run ``make`` and put the mesh's name before what it complains about."""
    try:
        return make()
    except ValueError as error:
        # Other kinds of ValueError, such as UnicodeDecodeError, cannot be made from a text.
        kind = MeshFileError if isinstance(error, MeshFileError) else ValueError
        raise kind(f"{name}: {error}") from error
