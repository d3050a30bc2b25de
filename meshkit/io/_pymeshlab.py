"""The one door to pymeshlab, which needs system libraries and says nothing when they are missing."""

import ctypes
import sys
from functools import cache
from typing import Any

from meshkit.io._mesh import Indices, Points

_LIBRARIES = {"libGL.so.1": "libgl1", "libEGL.so.1": "libegl1", "libOpenGL.so.0": "libopengl0"}
_NEEDED = "meshing_decimation_quadric_edge_collapse"


def decimate(points: Points, triangles: Indices, num_faces: int) -> tuple[Points, Indices]:
    """Quadric edge collapse to ``num_faces`` faces, with the topology and the boundary kept."""
    pymeshlab = load_pymeshlab()
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(points, triangles.astype("int32")))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=num_faces,
        preservetopology=True,
        preserveboundary=True,
        preservenormal=True,
        optimalplacement=True,
        autoclean=False,
    )
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix().astype("int64")


@cache
def load_pymeshlab() -> Any:
    """Import pymeshlab and make sure that its plugins came with it.

    Raises:
        ImportError: it is not installed, or its plugins are missing because the system lacks OpenGL libraries.
    """
    try:
        import pymeshlab
    except ImportError as error:
        missing = missing_libraries()
        reason = f"pymeshlab cannot be loaded ({error})"
        if "No module named" in str(error):
            reason = 'pymeshlab is not installed: pip install "meshkit-torch[remesh]"'
        raise ImportError(reason + _advice(missing)) from error
    if not hasattr(pymeshlab.MeshSet, _NEEDED):
        raise ImportError(f"pymeshlab was loaded without its filters ({_NEEDED} is not there)" + _advice())
    return pymeshlab


def missing_libraries() -> list[str]:
    """Debian packages of the OpenGL libraries that cannot be loaded here."""
    missing = []
    for library, package in _LIBRARIES.items() if sys.platform == "linux" else ():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


def _advice(missing: list[str] | None = None) -> str:
    packages = missing_libraries() if missing is None else missing
    if not packages:
        return ""
    return f"; it needs system libraries that are missing here: apt-get install {' '.join(packages)}"
