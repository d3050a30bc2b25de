"""Lowest eigenpairs of a sparse positive semi-definite matrix: to machine precision, or in half of the time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    import numpy as np

# A Laplacian of unit area has its first eigenvalues near 10. A shift well below orders the spectrum from its low end
# and still keeps the factorised matrix definite and far from singular.
_SHIFT = 1e-2
# The block method keeps all powers of the inverse in one basis: with the constants no more than some 50 times above the
# rest, rounding stays small enough for one reorthogonalisation per step.
_BLOCK_SHIFT = 10.0
_BLOCK = 12


def lanczos(matrix: Any, k: int, tol: float) -> tuple[np.ndarray, np.ndarray]:
    """Shift-invert Lanczos with restarts (ARPACK), converged to ``tol``: eigenvalues ascending, orthonormal vectors."""
    import numpy as np
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    num = matrix.shape[0]
    inverse = LinearOperator((num, num), _inverse(matrix, _SHIFT), dtype=float)
    # A fixed start makes the result reproducible; it overlaps every eigenvector, unlike a constant one.
    start = np.random.default_rng(0).standard_normal(num)
    try:
        eigenvalues, vectors = eigsh(matrix, k, sigma=-_SHIFT, OPinv=inverse, tol=tol, v0=start)
    except ArpackNoConvergence:
        raise ValueError(
            f"the {k} eigenpairs of this mesh did not converge: look for slivers and stray faces"
        ) from None
    order = np.argsort(eigenvalues)
    return eigenvalues[order], vectors[:, order]


def block_krylov(matrix: Any, k: int, positions: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Ritz pairs of :math:`(A + \sigma)^{-1}` in a block Krylov space of dimension 9 k / 4, without restarts.

    The first block holds 12 plane waves of fixed random directions. As functions of the position they follow the
    vertices, so that the result does not depend on their order; they are smooth, so that the space soon holds the low
    end of the spectrum; and they share no symmetry, so that on a symmetric surface no family of eigenvectors is out of
    their reach. (Constants would be a bad choice: an eigenvector in the first block adds nothing to the later ones.)
    """
    from scipy.sparse.csgraph import connected_components

    if connected_components(matrix, directed=False)[0] > 1:
        # Each eigenvalue may then have as many copies as there are components, more than a short space holds.
        return lanczos(matrix, k, 0.0)
    num = matrix.shape[0]
    size = max(9 * k // 4, k + 2 * _BLOCK)
    if 2 * size > num:
        values, vectors = torch.linalg.eigh(torch.from_numpy(matrix.toarray()))
        return values[:k].numpy(), vectors[:, :k].numpy()
    # Dense algebra is left to torch, on one thread: NumPy's own threads spin, and where several processes share the
    # cores, blocks as small as these take fifty times as long.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        pairs = _ritz_pairs(_inverse(matrix, _BLOCK_SHIFT), k, size, _waves(positions, scale) / scale[:, None])
    finally:
        torch.set_num_threads(threads)
    # The space may be exhausted, as on sheets that coincide, which functions of the position cannot tell apart.
    return lanczos(matrix, k, 0.0) if pairs is None else pairs


def _ritz_pairs(solve: Any, k: int, size: int, start: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    basis = torch.empty(size, len(start), dtype=torch.float64, device="cpu").T
    projected = torch.zeros(size, size, dtype=torch.float64, device="cpu")
    basis[:, :_BLOCK] = torch.linalg.qr(torch.from_numpy(start))[0]
    before, low, high = 0, 0, _BLOCK
    while True:
        image = torch.from_numpy(solve(basis[:, low:high].numpy()))
        # Three-term recurrence: in exact arithmetic the image has parts along the last two blocks only.
        last = basis[:, before:high]
        parts = last.T @ image
        projected[before:high, low:high] = parts
        if high == size:
            break
        image -= last @ parts
        image -= basis[:, :high] @ (basis[:, :high].T @ image)
        following, triangle = torch.linalg.qr(image)
        if triangle.diagonal().abs().min() < 1e-12:
            return None
        before, low, high = low, high, min(size, high + _BLOCK)
        basis[:, low:high] = following[:, : high - low]
        projected[low:high, before:low] = triangle[: high - low]
    inverted, mixing = torch.linalg.eigh((projected + projected.T) / 2)
    lowest = torch.arange(size - 1, size - 1 - k, -1, device="cpu")
    return (1 / inverted[lowest] - _BLOCK_SHIFT).numpy(), (basis @ mixing[:, lowest]).numpy()


def _inverse(matrix: Any, shift: float) -> Any:
    """Solver of ``matrix + shift``, positive definite, so that its diagonal can serve as pivots."""
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    shifted = (matrix + shift * sp.eye_array(matrix.shape[0])).tocsc()
    return splu(shifted, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve


def _waves(positions: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Plane waves of fixed random directions, about a third of a period per root-mean-square radius."""
    import numpy as np

    mass = scale**-2  # sums to 1
    centred = positions - mass @ positions
    centred /= np.sqrt(mass @ np.square(centred).sum(1))
    generator = np.random.default_rng(0)
    frequencies, phases = 2 * generator.standard_normal((3, _BLOCK)), 2 * np.pi * generator.random(_BLOCK)
    waves: np.ndarray = np.cos(centred @ frequencies + phases)
    return waves
