"""Whether a mesh is a person or a four-legged animal, from its shape alone: in any pose, orientation and unit."""

from functools import cache

import torch
from torch import Tensor

from meshkit.data import load_shipped
from meshkit.descriptors import laplacian_eigenpairs

__all__ = ["guess_kind", "kind_score", "rest_body", "shape_numbers", "surface_area"]

# A linear discriminant of the shape numbers; tools/fit_kinds.py finds it.
_WEIGHTS = (0.862, 0.777, 1.837, -0.125, -1.271, -0.365, -1.717, 1.272)
_OFFSET = 2.797
_CLEAR = 0.2  # score, of either sign, from which on the answer is clear


@cache
def rest_body(kind: str) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) and faces (F, 3) of the mean shipped body in its rest pose; ``kind`` is humans or animals."""
    body, _ = load_shipped(kind)
    return body.template, body.faces


def guess_kind(verts: Tensor, faces: Tensor) -> tuple[str, bool]:
    """``"humans"`` or ``"animals"``, whichever the mesh is more like, and whether the answer is clear.

    Decided by :func:`kind_score`; where it is not clear the answer is ``"humans"``. ``python tools/fit_kinds.py
    --check``, over all shipped people given at 1000, 2000, 3445 and 6890 vertices, each in a pose of its own, and all
    shipped animals as they come and with each face cut into four, in six poses each, all simplified to 1000 vertices:
    of 800 and 492 meshes none was wrong and none unclear. The least clear scores were -0.56 and 0.45 for bodies that
    the coefficients were not fitted to, -0.48 and 0.26 for those that they were.

    Args:
        verts: (V, 3) one surface, closed or nearly so, of a thousand vertices or so.
        faces: (F, 3), turned outward.
    """
    score = kind_score(shape_numbers(verts, faces))
    return ("animals" if score >= _CLEAR else "humans"), abs(score) >= _CLEAR


def kind_score(numbers: Tensor) -> float:
    """Linear in the shape numbers (8,): -1 for the mean person of the training set, 1 for the mean animal."""
    return float(numbers @ numbers.new_tensor(_WEIGHTS)) + _OFFSET


def shape_numbers(verts: Tensor, faces: Tensor) -> Tensor:
    """Eight numbers (8,) of a surface that hardly change with the pose, and not with the size.

    The logarithm of the compactness, volume^(2/3) / area, and those of the seven lowest eigenvalues of the Laplacian
    but 0, times the area. The eigenvalues say how far the parts of a body reach and how they hang together: a person
    has arms and legs of like length from two far ends of a trunk, an animal four legs under a trunk, neck and tail.
    """
    points = verts.detach().cpu().double()
    triangles = faces.cpu()
    eigenvalues, _ = laplacian_eigenpairs(points, triangles, 16, method="fast")
    a, b, c = (points[triangles[:, k]] - points.mean(0) for k in range(3))
    area = surface_area(points, triangles)
    volume = (a * torch.linalg.cross(b, c)).sum().abs() / 6
    tiny = torch.finfo(points.dtype).tiny
    return torch.cat([(volume ** (2 / 3) / area)[None], eigenvalues[1:8]]).clamp_min(tiny).log()


def surface_area(verts: Tensor, faces: Tensor) -> Tensor:
    """Area of a surface, in float64."""
    a, b, c = (verts.double()[faces[:, k]] for k in range(3))
    return torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2
