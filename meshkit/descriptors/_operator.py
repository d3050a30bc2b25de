"""The symmetric operator whose spectrum describes a surface, from faces or from points alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from meshkit.topology import cotangent_weights

if TYPE_CHECKING:
    import numpy as np


def normalised_laplacian(points: Tensor, faces: Tensor | None, robust: bool) -> tuple[Any, np.ndarray, float]:
    r"""``(matrix, scale, area)`` with matrix :math:`S L S` (CSC), :math:`S = \operatorname{diag}(s)`,
    :math:`s_i = \sqrt{\textstyle\sum_j m_j / m_i}`: an eigenvector u of it gives :math:`\phi = S u`, and the total
    mass (the area) counts as 1."""
    import numpy as np
    import scipy.sparse as sp

    if faces is None or robust:
        stiffness, mass = _robust(points, faces)
    else:
        stiffness, mass = _cotangent(points, faces)
    used = mass > 0
    if faces is not None:
        # The robust Laplacian gives a vertex of no face a little mass; nothing ties it to the surface all the same.
        used &= np.bincount(faces.numpy().ravel(), minlength=len(mass)) > 0
    if not used.all():
        raise ValueError(
            f"{int((~used).sum())} of {len(mass)} vertices belong to no face of positive area, the first is vertex "
            f"{int(used.argmin())} (counting from 0): remove them first"
        )
    scale = np.sqrt(mass.sum() / mass)
    row, column, values = stiffness
    matrix = sp.csc_matrix((values * scale[row] * scale[column], (row, column)), (len(mass), len(mass)))
    return matrix, scale, float(mass.sum())


def _cotangent(points: Tensor, faces: Tensor) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    # cotangent_laplacian and mass_matrix in a third of their time: nothing is computed twice, and SciPy adds repeated
    # entries up faster than torch coalesces them.
    import numpy as np

    num = len(points)
    weights = cotangent_weights(points, faces).numpy()
    mass = np.bincount(faces.numpy().ravel(), _voronoi_areas(points, faces, weights).ravel(), num)
    weights = weights.ravel()
    head, tail = faces[:, [1, 2, 0]].numpy().ravel(), faces[:, [2, 0, 1]].numpy().ravel()
    diagonal = np.bincount(head, weights, num) + np.bincount(tail, weights, num)
    itself = np.arange(num)
    entries = (
        np.concatenate([head, tail, itself]),
        np.concatenate([tail, head, itself]),
        np.concatenate([-weights, -weights, diagonal]),
    )
    return entries, mass


def _voronoi_areas(points: Tensor, faces: Tensor, weights: np.ndarray) -> np.ndarray:
    r"""``(F, 3)`` parts of :func:`~meshkit.topology.mass_matrix`, whose cotangents are twice the weights w:
    :math:`A_f = \tfrac12 \sum_k w_k \lVert e_k\rVert^2`."""
    import numpy as np

    corners = points.numpy()[faces.numpy()]
    opposite = np.square(corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]).sum(2)
    pieces = weights * opposite / 4
    area, obtuse = 2 * pieces.sum(1, keepdims=True), weights < 0
    parts: np.ndarray = np.where(
        obtuse.any(1, keepdims=True),
        np.where(obtuse, area / 2, area / 4),
        pieces[:, [1, 2, 0]] + pieces[:, [2, 0, 1]],
    )
    return parts


def _robust(points: Tensor, faces: Tensor | None) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    try:
        import robust_laplacian
    except ImportError as error:
        what = "a point cloud (faces=None)" if faces is None else "robust=True"
        raise ImportError(f"{what} needs the package robust-laplacian: pip install 'meshkit-torch[solvers]'") from error
    if faces is None:
        stiffness, mass = robust_laplacian.point_cloud_laplacian(points.numpy())
    else:
        stiffness, mass = robust_laplacian.mesh_laplacian(points.numpy(), faces.numpy())
    stiffness = stiffness.tocoo()
    return (stiffness.row, stiffness.col, stiffness.data), mass.diagonal()
