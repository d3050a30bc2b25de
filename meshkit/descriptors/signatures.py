"""Heat- and wave-kernel signatures: what the spectrum says about each vertex."""

from __future__ import annotations

from torch import Tensor

from meshkit.descriptors._signatures import heat_bands, signatures_of_each, wave_bands
from meshkit.descriptors._spectrum import Cache

__all__ = ["heat_kernel_signature", "wave_kernel_signature"]


def heat_kernel_signature(
    verts: Tensor,
    faces: Tensor | None,
    *,
    num_signatures: int = 16,
    num_eigenpairs: int = 64,
    mask: Tensor | None = None,
    method: str = "exact",
    robust: bool = False,
    cache: Cache = None,
) -> Tensor:
    r"""Heat-kernel signature of each vertex: how much of a unit of heat is still there after a time.

    .. math:: \mathrm{HKS}(v, t) = \sum_k e^{-\lambda_k t}\, \phi_k(v)^2

    at times t in geometric progression from :math:`4 \ln 10 / \lambda_{K-1}` to :math:`4 \ln 10 / \lambda_1`, with
    :math:`\lambda_1` the first eigenvalue above 0. Masses are normalised to total area 1, so t is in units of the area
    and the signature does not change under rotation, translation, scaling, vertex order, or any bending that keeps
    lengths. Its mean over the surface is the heat trace :math:`\sum_k e^{-\lambda_k t}`; on a sphere it is constant.
    It falls with t, over orders of magnitude: feed a network, and compare vertices, with its logarithm.

    Short times are the more complete the more pairs there are. As for all signatures, the basis inside the eigenspace
    of a repeated eigenvalue does not matter, unless the last pair kept cuts such a space in two: on a symmetric shape
    choose ``num_eigenpairs`` at its end.

    Args:
        verts: ``(V, 3)``, or a batch ``(B, V, 3)``.
        faces: ``(F, 3)`` int64, or per mesh ``(B, F, 3)``, padding rows -1; ``None`` for point clouds.
        num_signatures: number of times.
        num_eigenpairs: pairs of the Laplacian used, at most V - 1 (fewer are taken on smaller meshes).
        mask: ``(B, V)`` bool, True = real vertex; padded rows come out as 0.
        method: of :func:`laplacian_eigenpairs`.
        robust: likewise.
        cache: likewise.

    Returns:
        ``(V, num_signatures)`` or ``(B, V, num_signatures)``, a constant without gradient, not standardised.

    Raises:
        ValueError: as :func:`laplacian_eigenpairs`; the mesh has fewer than 4 vertices or a mask without a batch; a
            face refers to a padded vertex.
        ImportError: as :func:`laplacian_eigenpairs`.

    Reference:
        Sun, Ovsjanikov and Guibas, "A Concise and Provably Informative Multi-Scale Signature Based on Heat Diffusion",
        2009. Not part of the X-DualNet paper, whose network sees coordinates alone.

    Example:
        >>> import torch
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> heat_kernel_signature(verts, faces, num_signatures=3).log().shape
        torch.Size([4, 3])
    """
    bands = heat_bands(num_signatures)
    return signatures_of_each(verts, faces, mask, bands, num_eigenpairs, method, robust, cache)[0]


def wave_kernel_signature(
    verts: Tensor,
    faces: Tensor | None,
    *,
    num_signatures: int = 16,
    num_eigenpairs: int = 64,
    width: float = 1.0,
    mask: Tensor | None = None,
    method: str = "exact",
    robust: bool = False,
    cache: Cache = None,
) -> Tensor:
    r"""Wave-kernel signature of each vertex: how strongly each frequency band of the surface lives there.

    .. math:: \mathrm{WKS}(v, e) = \frac{\sum_k \phi_k(v)^2\, g_e(\lambda_k)}{\sum_k g_e(\lambda_k)}, \qquad
              g_e(\lambda) = \exp\!\left(-\frac{(e - \log\lambda)^2}{2 \sigma^2}\right)

    with energies e evenly spaced from :math:`\log\lambda_1` to :math:`0.98 \log\lambda_{K-1}` and
    :math:`\sigma` equal to ``width`` spacings; constant eigenvectors (one per component) are left out. Masses are
    normalised to total area 1, so the signature does not change under rotation, translation, scaling, vertex order, or
    any bending that keeps lengths. Skinned bodies stretch at the joints: there signatures move with the pose, by a
    fraction of their deviation.
    The mean over the surface is near 1. Left and right of a symmetric body look the same. What
    :func:`heat_kernel_signature` says of repeated eigenvalues holds here.

    Args:
        verts: ``(V, 3)``, or a batch ``(B, V, 3)``.
        faces: ``(F, 3)`` int64, or per mesh ``(B, F, 3)``, padding rows -1; ``None`` for point clouds.
        num_signatures: number of energies. 16 suit a network's input.
        num_eigenpairs: pairs of the Laplacian used, at most V - 1 (fewer are taken on smaller meshes).
        width: of the bands, in spacings between energies. The reference has 7 at 100 energies, about as wide as 1 at
            16; wider bands at few energies blur, and match surfaces by themselves far worse.
        mask: ``(B, V)`` bool, True = real vertex; padded rows come out as 0.
        method: of :func:`laplacian_eigenpairs`. On bodies ``"fast"`` differs from ``"exact"`` by less than a
            tenth of a standard deviation, in half of the time, and matches surfaces as well.
        robust: of :func:`laplacian_eigenpairs`.
        cache: likewise.

    Returns:
        ``(V, num_signatures)`` or ``(B, V, num_signatures)``, a constant without gradient. Not standardised: models
        hold mean and deviation of their training set.

    Raises:
        ValueError: as :func:`heat_kernel_signature`.
        ImportError: as :func:`laplacian_eigenpairs`.

    Reference:
        Aubry, Schlickewei and Cremers, "The wave kernel signature", 2011. Not part of the X-DualNet paper, whose
        network sees coordinates alone.

    Example:
        >>> import torch
        >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> wave_kernel_signature(verts, faces, num_signatures=3).shape
        torch.Size([4, 3])
    """
    bands = wave_bands(num_signatures, width)
    return signatures_of_each(verts, faces, mask, bands, num_eigenpairs, method, robust, cache)[0]
