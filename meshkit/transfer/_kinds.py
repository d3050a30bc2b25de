"""Whether a mesh is a person or a four-legged animal, from its shape alone: in any pose, orientation and unit."""

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from meshkit.data import load_shipped
from meshkit.descriptors import laplacian_eigenpairs

__all__ = ["KINDS", "Likeness", "guess_kind", "kind_distances", "rest_body", "shape_numbers", "surface_area"]

KINDS = ("humans", "animals")

# Means of the shape numbers of the training bodies of each kind, and a matrix that makes their common spread the unit
# matrix; tools/fit_kinds.py finds them.
_MEANS = (
    (-2.400, 1.584, 1.727, 2.317, 2.655, 2.900, 3.530, 3.653),
    (-2.130, 2.060, 2.795, 2.985, 3.137, 3.281, 3.590, 3.948),
)
_WHITENING = (
    (10.390, 0.000, 0.000, 0.000, -0.000, 0.000, 0.000, 0.000),
    (-16.431, 9.359, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000),
    (-9.984, -3.778, 7.066, -0.000, 0.000, -0.000, -0.000, -0.000),
    (-1.396, -2.491, -7.710, 10.024, -0.000, -0.000, -0.000, -0.000),
    (-1.714, -2.095, -2.394, -9.836, 14.257, -0.000, -0.000, -0.000),
    (-3.252, -2.549, -1.132, -1.965, -6.326, 14.744, 0.000, 0.000),
    (-3.111, -5.908, -0.307, 2.175, -0.743, -3.653, 10.363, 0.000),
    (1.060, -0.992, 2.033, -1.723, -2.086, 1.067, -6.427, 12.624),
)
_CLEAR = 0.2  # score, of either sign, from which on it is one kind and not the other
_FAR = 7.2  # distance from which on a mesh is of neither kind: that of the oddest training body, 6.0, and a fifth more


class Likeness(NamedTuple):
    """Which kind of body a mesh is like.

    Attributes:
        kind: ``"humans"`` or ``"animals"``, whichever is meant if one has to be: humans, if it is between the two.
        score: difference of its squared distances from the mean person and the mean animal, over the squared distance
            of these two: -1 for the mean person, 1 for the mean animal.
        distance: Mahalanobis distance from the mean body of the nearer kind.
    """

    kind: str
    score: float
    distance: float

    @property
    def neither(self) -> bool:
        """Whether it is far from both kinds."""
        return self.distance > _FAR

    @property
    def clear(self) -> bool:
        """Whether it is of one kind, and not of the other."""
        return abs(self.score) >= _CLEAR and not self.neither

    @property
    def doubt(self) -> str:
        """What is to be said of a mesh that is not clearly of a kind; empty if it is."""
        if self.neither:
            return (
                f"the shape of neither a person nor a four-legged animal (distance {self.distance:.1f} from the nearer "
                f"kind, where bodies have less than {_FAR:g}): expect no sensible result; use one whole body as one "
                "surface, smoothed if it is a noisy scan, without clothes or props"
            )
        text = "a shape between a person's and an animal's: name the weights of its kind if these are not"
        return "" if self.clear else text


@cache
def rest_body(kind: str) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) and faces (F, 3) of the mean shipped body in its rest pose; ``kind`` is humans or animals."""
    body, _ = load_shipped(kind)
    return body.template, body.faces


def guess_kind(verts: Tensor, faces: Tensor) -> Likeness:
    """Whether a mesh is more like a person or an animal, how much more, and how far it is from both.

    Decided by the nearer mean in Mahalanobis distance; where that is not clear the kind is ``"humans"``. The largest
    distance over the 756 training meshes that the numbers were fitted to (``python tools/fit_kinds.py``) was 6.0 for
    animals and 3.2 for people; a sphere, a box and a sheet have 14 and more. ``--check`` measures other meshes.

    Args:
        verts: (V, 3) one surface, closed or nearly so, of a thousand vertices or so.
        faces: (F, 3), turned outward.
    """
    people, animals = kind_distances(shape_numbers(verts, faces))
    means = torch.tensor(_MEANS, dtype=torch.float64, device="cpu")
    apart = kind_distances(means[0])[1] ** 2
    score = (people**2 - animals**2) / apart
    return Likeness("animals" if score >= _CLEAR else "humans", score, min(people, animals))


def kind_distances(numbers: Tensor) -> tuple[float, float]:
    """Mahalanobis distances of shape numbers (8,) from those of the mean person and of the mean animal."""
    whitening = numbers.new_tensor(_WHITENING)
    people, animals = ((whitening @ (numbers - numbers.new_tensor(mean))).norm() for mean in _MEANS)
    return float(people), float(animals)


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
