"""Eigenpairs of the Laplacian of a surface."""

from __future__ import annotations

from torch import Tensor

from meshkit.descriptors._spectrum import Cache, spectrum

__all__ = ["laplacian_eigenpairs"]


def laplacian_eigenpairs(
    verts: Tensor,
    faces: Tensor | None,
    k: int = 64,
    *,
    tol: float = 0.0,
    method: str = "exact",
    robust: bool = False,
    cache: Cache = None,
) -> tuple[Tensor, Tensor]:
    r"""Smallest eigenpairs of a surface's Laplacian: :math:`L \phi = \lambda M \phi`, :math:`\phi^\top M \phi = 1`.

    Masses are normalised to a total of 1, so eigenvalues do not depend on the size of the mesh: on the sphere they are
    :math:`4 \pi\, l (l + 1)`, each :math:`2 l + 1` times. Solved as the symmetric problem
    :math:`M^{-1/2} L M^{-1/2}`, by one sparse factorisation and either

    - ``"exact"``: Lanczos (ARPACK) until every pair is accurate to ``tol``; or
    - ``"fast"``: Ritz pairs of a block Krylov space of dimension 9 k / 4, without iteration to convergence. Eigenvalues
      are never too small; the lower half of them is accurate to many digits, the last few to a few per cent. It starts
      from functions of the position, and so may miss what differs between sheets that coincide in space, and copies of
      an eigenvalue repeated more than 12 times. Small meshes and meshes of several components are solved exactly.

    Inside the eigenspace of a repeated eigenvalue any orthonormal basis is a solution, and signs are arbitrary.
    Compare functions of whole eigenspaces, such as the signatures below, never single vectors.

    Args:
        verts: ``(V, 3)``.
        faces: ``(F, 3)`` int64, padding rows -1; ``None`` for a point cloud (needs the package robust-laplacian).
        k: number of pairs, at most V - 1.
        tol: relative accuracy asked of the exact eigenvalues, 0 for machine precision. A looser one saves a fifth of
            the time, and may miss copies of repeated eigenvalues, which symmetric shapes have.
        method: ``"exact"`` or ``"fast"``.
        robust: build the Laplacian with robust-laplacian (intrinsic Delaunay triangulation of a double cover), for
            meshes with slivers, faces without area or edges of more than two faces. The cotangent Laplacian accepts
            the last too, it is only less accurate there.
        cache: where to look the result up and keep it: a folder (one file per result, created if missing) or a
            mapping such as a ``dict``. Keys are hashes of the vertices, the faces and the options, so a changed mesh
            is never mistaken for the cached one. Nothing is kept unless asked for, and nothing is ever evicted.

    Returns:
        ``eigenvalues (k,)`` ascending, and ``eigenvectors (V, k)``, in the dtype of ``verts``, without gradient.

    Raises:
        ValueError: shapes do not fit, ``k`` is out of range, unknown ``method``, a vertex is not finite, belongs to no
            face or has no area.
        ImportError: robust-laplacian is needed and not installed.

    Reference:
        Sharp and Crane, "A Laplacian for Nonmanifold Triangle Meshes", 2020 (``robust=True`` and point clouds).

    Example:
        >>> import torch
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> kept = {}
        >>> bool(laplacian_eigenpairs(verts, faces, 2, cache=kept)[0][0].abs() < 1e-6), len(kept)
        (True, 1)
    """
    eigenvalues, vectors, _ = spectrum(verts, faces, k, tol=tol, method=method, robust=robust, cache=cache)
    return eigenvalues.to(verts, copy=True), vectors.to(verts, copy=True)
