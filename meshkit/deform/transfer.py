"""Deformation transfer: repeat on one mesh what another one did between two poses."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshkit._compile import uncompiled
from meshkit.deform.correspondence import Correspondence, check_points, face_gradients, mapped, recombined
from meshkit.topology import check_faces, connected_components, cotangent_laplacian, cotangent_weights

__all__ = ["deformation_transfer"]


@uncompiled
def deformation_transfer(
    source_rest: Tensor,
    source_posed: Tensor,
    target_rest: Tensor,
    *,
    faces: Tensor,
    target_faces: Tensor | None = None,
    correspondence: Correspondence | None = None,
) -> Tensor:
    r"""Give a target mesh the deformation that takes a source mesh from its rest shape to a pose.

    .. math:: \min_x \sum_f A_f \lVert \nabla x_f - J_f \rVert_F^2, \qquad
              J_f = [p_1 - p_0,\; p_2 - p_0,\; \nu(p)]\,[s_1 - s_0,\; s_2 - s_0,\; \nu(s)]^{-1}

    with s, p the corners of a source face at rest and posed, :math:`\nu` its normal over the square root of its length,
    and A the areas of the target. The minimum solves one Poisson equation with the cotangent Laplacian of the target,
    factored once for all poses; it is that of Sumner and Popovic's least squares with a fourth vertex per face.

    Gradients do not fix places: the vertex mean of every connected component of the target moves by as much as the
    mean of the source vertices it corresponds to. Source and target should be at rest in the same pose, since it is the
    change from that pose that is repeated; a target that starts with bent arms bends them further. Where the source is
    a single posed mesh without a rest shape, there is no deformation to transfer: take as `source_rest` a mesh of the
    same connectivity in the pose of the target (a template, or the mean of the subject's meshes), and expect the
    difference in body shape between the two to be transferred along with the pose.

    Across connectivities, the deformation of a source vertex is the area-weighted mean over the faces around it; a
    target vertex takes the mean over its row of the correspondence, a target face that over its corners. Means are of
    rotations (projected back) and stretches apart, :math:`J = R U`, so that a blurred correspondence does not shrink
    the target. The transfer then looks no further than `correspondence`; see
    :func:`~meshkit.deform.key_point_correspondence` to make one of given key points.

    Args:
        source_rest: (V, 3) source at rest.
        source_posed: (V, 3), or (P, V, 3) for P poses. Differentiable.
        target_rest: (N, 3) target at rest.
        faces: (F, 3) of the source, and of the target where `target_faces` is None; rows of -1 are padding.
        target_faces: (G, 3) of the target if it has a connectivity of its own; needs `correspondence`.
        correspondence: what each target vertex corresponds to on the source: (N,) int64 vertex indices; an (N, V)
            matrix, dense or sparse, whose rows are weights (normalised here); or a
            :class:`~meshkit.ot.TransportPlan` of shape (1, N, V).

    Returns:
        (N, 3) or (P, N, 3) target in the poses of the source, dtype and device of `source_posed`. `source_rest`,
        `target_rest` and the correspondence are constants to the gradient; the solve is in float64 on the CPU.

    Raises:
        ValueError: shapes, indices or connectivities that do not fit; NaN or infinity; a face of area zero at rest; a
            vertex of no face; a row of the correspondence without weight.

    Reference:
        Sumner and Popovic, "Deformation transfer for triangle meshes", 2004; as a Poisson equation: Botsch, Sumner,
        Pauly and Gross, "Deformation transfer for detail-preserving surface editing", 2006.

    Deviations:
        Sumner and Popovic find triangle correspondences by their own registration; here the correspondence is given,
        and each target face has one (averaged) source deformation instead of several to fit at once.

    Example:
        >>> rest = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        >>> moved = deformation_transfer(rest, rest @ turn.T, 2 * rest, faces=torch.tensor([[0, 1, 2]]))
        >>> edges = 2 * (rest[1:] - rest[:1]) @ turn.T
        >>> torch.allclose(moved[1:] - moved[:1], edges, atol=1e-6)
        True
    """
    check_points(source_rest, "source_rest")
    check_points(target_rest, "target_rest")
    check_points(source_posed, "source_posed", batched=True)
    if source_posed.shape[-2] != len(source_rest):
        raise ValueError(
            f"source_posed {tuple(source_posed.shape)} must have the {len(source_rest)} vertices of source_rest"
        )
    check_faces(faces, len(source_rest))
    same = target_faces is None and correspondence is None
    if same and len(target_rest) != len(source_rest):
        raise ValueError(
            f"target_rest has {len(target_rest)} vertices and source_rest {len(source_rest)}: meshes of different "
            "connectivity need target_faces and correspondence"
        )
    if not same and (target_faces is None or correspondence is None):
        missing = "target_faces" if target_faces is None else "correspondence"
        raise ValueError(f"target_faces and correspondence belong together; {missing} is missing")
    own = _real(faces)
    source, posed = source_rest.detach().cpu().double(), source_posed.cpu().double()
    lead, posed = posed.shape[:-2], posed.reshape(-1, *posed.shape[-2:])
    target = target_rest.detach().cpu().double()
    gradients = face_gradients(source, posed, own)
    moved = posed - source
    if target_faces is not None and correspondence is not None:
        check_faces(target_faces, len(target))
        parts, moved = mapped(gradients, moved, source, own, correspondence, len(target))
        own = _real(target_faces)
        gradients = recombined(parts[:, own].mean(2))
    x = _integrate(target, own, gradients, moved)
    return x.view(*lead, *target.shape).to(source_posed.device, source_posed.dtype)


def _real(faces: Tensor) -> Tensor:
    faces = faces.detach().cpu().long()
    return faces[faces[:, 0] >= 0]


def _integrate(rest: Tensor, faces: Tensor, gradients: Tensor, moved: Tensor) -> Tensor:
    """Positions (P, N, 3) whose gradients are nearest to the wanted ones, and whose components moved as given."""
    weights = cotangent_weights(rest, faces)
    flat = int((weights == 0).all(-1).sum())
    if flat:
        raise ValueError(f"{flat} faces of the target have area zero at rest; repair the mesh")
    labels = connected_components(faces, len(rest))
    sizes = torch.bincount(labels)
    bare = len(rest) - len(faces.unique())
    if bare:
        raise ValueError(f"{bare} vertices of the target are in no face, so nothing moves them; remove them")
    corners = rest[faces]
    edges = corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]  # opposite each corner
    pull = (gradients[:, :, None] @ edges[..., None]).squeeze(-1) * weights[..., None]
    at_corners = pull[:, :, [2, 0, 1]] - pull[:, :, [1, 2, 0]]
    right = rest.new_zeros(len(gradients), len(rest), 3)
    right = right.index_add(1, faces.flatten(), at_corners.flatten(1, 2))
    x = _Poisson.apply(right, _solver(cotangent_laplacian(rest, faces), labels))
    # The places of the components
    shift = rest + moved - x
    means = shift.new_zeros(len(x), len(sizes), 3).index_add(1, labels, shift) / sizes[:, None]
    return x + means[:, labels]


def _solver(laplacian: Tensor, labels: Tensor) -> Any:
    """Solve with the first vertex of every component at the origin; self-adjoint."""
    import numpy as np
    from scipy import sparse
    from scipy.sparse.linalg import splu

    rows, cols = laplacian.indices().numpy()
    matrix = sparse.csc_array((laplacian.values().numpy(), (rows, cols)), shape=tuple(laplacian.shape))
    pins = np.unique(labels.numpy(), return_index=True)[1]
    free = np.setdiff1d(np.arange(len(labels)), pins)
    factor = splu(
        matrix[free][:, free], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )

    def solve(right: Tensor) -> Tensor:
        columns = right[:, free].detach().permute(1, 0, 2).reshape(len(free), -1).numpy()
        result = torch.zeros_like(right)
        result[:, free] = torch.from_numpy(factor.solve(columns)).view(len(free), -1, 3).permute(1, 0, 2)
        return result

    return solve


class _Poisson(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, right: Tensor, solve: Any) -> Tensor:
        ctx.solve = solve
        return solve(right)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return ctx.solve(grad), None
