"""Intrinsic descriptors of a mesh from the spectrum of its Laplacian."""

from __future__ import annotations

import torch
from torch import Tensor

from meshkit.topology import cotangent_laplacian, mass_matrix

__all__ = ["intrinsic_descriptors", "laplacian_eigenpairs", "wave_kernel_signature"]

# A Laplacian scaled to unit area has its first eigenvalues near 10. A shift well below that keeps the factorised
# matrix definite and far from singular, and still orders the spectrum from its low end.
_SHIFT = -1e-2


def laplacian_eigenpairs(verts: Tensor, faces: Tensor, k: int = 64, *, tol: float = 0.0) -> tuple[Tensor, Tensor]:
    r"""Smallest eigenpairs of the cotangent Laplacian: :math:`L \phi = \lambda M \phi`, :math:`\phi^\top M \phi = 1`.

    Masses are normalised to a total of 1, so eigenvalues do not depend on the size of the mesh. Solved as the
    symmetric problem :math:`M^{-1/2} L M^{-1/2}` by shift-invert Lanczos (SciPy).

    Args:
        verts: ``(V, 3)``.
        faces: ``(F, 3)`` int64.
        k: number of pairs, at most V - 1.
        tol: relative accuracy asked of the eigenvalues, 0 for machine precision. A looser one saves a fifth of the
            time, and may miss copies of repeated eigenvalues, which symmetric shapes have.

    Returns:
        ``eigenvalues (k,)`` ascending, and ``eigenvectors (V, k)``, in the dtype of ``verts``.

    Raises:
        ValueError: shapes do not fit, ``k`` is out of range, a vertex is not finite, belongs to no face or has no area.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> bool(laplacian_eigenpairs(verts, faces, 2)[0][0].abs() < 1e-6)
        True
    """
    import numpy as np
    import scipy.sparse as sp
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, splu

    num = len(verts)
    if verts.dim() != 2 or verts.shape[1] != 3:
        raise ValueError(f"verts must have shape (V, 3), got {tuple(verts.shape)}")
    if not 1 <= k < num:
        raise ValueError(f"k must lie in [1, V - 1] = [1, {num - 1}], got {k}")
    if not bool(torch.isfinite(verts).all()):
        bad = int((~torch.isfinite(verts)).any(1).sum())
        raise ValueError(f"{bad} of {num} vertices are NaN or infinite")
    points = verts.detach().cpu().double()
    laplacian = cotangent_laplacian(points, faces.cpu()).coalesce()
    mass = mass_matrix(points, faces.cpu()).numpy()
    if (mass <= 0).any():
        raise ValueError(
            f"{int((mass <= 0).sum())} of {num} vertices belong to no face of positive area, the first is vertex "
            f"{int((mass <= 0).argmax())} (counting from 0): remove them first"
        )
    scale = np.sqrt(mass.sum() / mass)
    row, column = laplacian.indices().numpy()
    values = laplacian.values().numpy() * scale[row] * scale[column]
    matrix = sp.csc_matrix((values, (row, column)), (num, num))
    factor = splu(
        (matrix - _SHIFT * sp.eye_array(num)).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )
    inverse = LinearOperator((num, num), factor.solve, dtype=float)
    # A fixed start makes the result reproducible; it overlaps every eigenvector, unlike a constant one.
    start = np.random.default_rng(0).standard_normal(num)
    try:
        eigenvalues, vectors = eigsh(matrix, k, sigma=_SHIFT, OPinv=inverse, tol=tol, v0=start)
    except ArpackNoConvergence:
        raise ValueError(
            f"the {k} eigenpairs of this mesh did not converge: look for slivers and stray faces"
        ) from None
    order = np.argsort(eigenvalues)
    vectors = vectors[:, order] * scale[:, None]
    return (
        torch.from_numpy(eigenvalues[order].clip(min=0.0)).to(verts),
        torch.from_numpy(np.ascontiguousarray(vectors)).to(verts),
    )


def intrinsic_descriptors(
    verts: Tensor, faces: Tensor, *, num_signatures: int = 16, num_eigenpairs: int = 64, mask: Tensor | None = None
) -> Tensor:
    r"""Wave-kernel signatures, and the size of the mesh, which they leave out: :math:`\log \sqrt{\mathrm{area}}`.

    Nothing in them depends on the pose, as far as posing keeps lengths. So they say where on a body a vertex is and
    what body it is, and cannot say how the body stands.

    Args:
        verts: ``(V, 3)``, or a batch ``(B, V, 3)``.
        faces: ``(F, 3)`` int64, or per mesh ``(B, F, 3)`` padded with -1.
        num_signatures: see :func:`wave_kernel_signature`.
        num_eigenpairs: likewise.
        mask: ``(B, V)`` bool, True = real vertex; padded rows come out as 0.

    Returns:
        ``(V, num_signatures + 1)`` or ``(B, V, num_signatures + 1)``, without gradient, not standardised.

    Raises:
        ValueError: as :func:`wave_kernel_signature`.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> intrinsic_descriptors(verts, faces, num_signatures=3).shape
        torch.Size([4, 4])
    """
    signature = wave_kernel_signature(
        verts, faces, num_signatures=num_signatures, num_eigenpairs=num_eigenpairs, mask=mask
    )
    area = mass_matrix(verts.detach(), faces, kind="barycentric").sum(-1, keepdim=True)[..., None]
    size = area.sqrt().log().expand(*signature.shape[:-1], 1)
    if mask is not None:
        size = size.masked_fill(~mask[..., None], 0.0)
    return torch.cat([signature, size], -1)


def wave_kernel_signature(
    verts: Tensor,
    faces: Tensor,
    *,
    num_signatures: int = 16,
    num_eigenpairs: int = 64,
    width: float = 7.0,
    mask: Tensor | None = None,
) -> Tensor:
    r"""Wave-kernel signature of each vertex: how strongly each frequency band of the surface lives there.

    .. math:: \mathrm{WKS}(v, e) = \frac{\sum_k \phi_k(v)^2\, g_e(\lambda_k)}{\sum_k g_e(\lambda_k)}, \qquad
              g_e(\lambda) = \exp\!\left(-\frac{(e - \log\lambda)^2}{2 \sigma^2}\right)

    with energies e evenly spaced from :math:`\log\lambda_1` to :math:`0.98 \log\lambda_{K-1}` and
    :math:`\sigma` equal to ``width`` spacings; constant eigenvectors (one per component) are left out. Masses are
    normalised to total area 1, so the signature does not change under rotation, translation, scaling, vertex order, or
    any bending that keeps lengths. Skinned bodies stretch at the joints: there signatures move with the pose, by a
    fraction of their deviation.
    The mean over the surface is near 1. Left and right of a symmetric body look the same.

    Args:
        verts: ``(V, 3)``, or a batch ``(B, V, 3)``.
        faces: ``(F, 3)`` int64, or per mesh ``(B, F, 3)`` padded with -1.
        num_signatures: number of energies. 16 suit a network's input; to match surfaces by them alone take 64.
        num_eigenpairs: pairs of the Laplacian used, at most V - 1 (fewer are taken on smaller meshes).
        width: of the bands, in spacings between energies.
        mask: ``(B, V)`` bool, True = real vertex; padded rows come out as 0.

    Returns:
        ``(V, num_signatures)`` or ``(B, V, num_signatures)``, without gradient. Not standardised: models hold mean and
        deviation of their training set.

    Raises:
        ValueError: as :func:`laplacian_eigenpairs`, or the mesh has fewer than 4 vertices.

    Reference:
        Aubry, Schlickewei and Cremers, "The wave kernel signature", 2011. Not part of the X-DualNet paper, whose
        network sees coordinates alone.

    Example:
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> wave_kernel_signature(verts, faces, num_signatures=3).shape
        torch.Size([4, 3])
    """
    if verts.dim() == 2:
        return _signature(verts, faces, num_signatures, num_eigenpairs, width)
    if verts.dim() != 3:
        raise ValueError(f"verts must have shape (V, 3) or (B, V, 3), got {tuple(verts.shape)}")
    out = verts.new_zeros(*verts.shape[:2], num_signatures)
    for b in range(len(verts)):
        real = slice(None) if mask is None else mask[b]
        triangles = faces if faces.dim() == 2 else faces[b][faces[b][:, 0] >= 0]
        points = verts[b][real]
        if mask is not None:
            # Faces count padded vertices too when the padding is not at the end.
            triangles = (mask[b].cumsum(0) - 1)[triangles]
        out[b, real] = _signature(points, triangles, num_signatures, num_eigenpairs, width)
    return out


def _signature(verts: Tensor, faces: Tensor, num_signatures: int, num_eigenpairs: int, width: float) -> Tensor:
    if len(verts) < 4:
        raise ValueError(f"a signature needs a surface of at least 4 vertices, got {len(verts)}")
    if num_signatures < 2:
        raise ValueError(f"num_signatures must be at least 2, got {num_signatures}")
    if num_eigenpairs < 3:
        raise ValueError(f"num_eigenpairs must be at least 3, got {num_eigenpairs}")
    eigenvalues, vectors = laplacian_eigenpairs(verts.double(), faces, min(num_eigenpairs, len(verts) - 1))
    # Each connected component has one constant eigenvector of eigenvalue 0, which says nothing about the shape.
    varying = eigenvalues > 1e-6
    if int(varying.sum()) < 2:
        raise ValueError(
            f"only {int(varying.sum())} of {len(eigenvalues)} eigenpairs vary over the surface, which has too many "
            "components: keep the largest, or ask for more eigenpairs"
        )
    log_values = eigenvalues[varying].log()
    energies = torch.linspace(float(log_values[0]), 0.98 * float(log_values[-1]), num_signatures).to(log_values)
    spread = width * (energies[1] - energies[0]).abs().clamp_min(1e-9)
    bands = torch.exp(-(energies[:, None] - log_values).square() / (2 * spread**2))
    return (vectors[:, varying].square() @ (bands / bands.sum(1, keepdim=True)).mT).to(verts)
