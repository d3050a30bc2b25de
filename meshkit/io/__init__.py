"""Mesh files in and out, and what a mesh of unknown origin needs before use: a report, repair, decimation."""

from meshkit.io.atomic import atomic_write
from meshkit.io.binding import SurfaceBinding
from meshkit.io.clean import CleanMesh, clean_mesh
from meshkit.io.files import MeshFileError, MeshFileWarning, load_mesh, save_mesh
from meshkit.io.report import MeshReport, mesh_report
from meshkit.io.simplify import SimpleMesh, simplify

__all__ = [
    "CleanMesh",
    "MeshFileError",
    "MeshFileWarning",
    "MeshReport",
    "SimpleMesh",
    "SurfaceBinding",
    "atomic_write",
    "clean_mesh",
    "load_mesh",
    "mesh_report",
    "save_mesh",
    "simplify",
]
