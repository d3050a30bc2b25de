"""The orientation of a mesh, found by matching it to a rest body."""

import math
from functools import cached_property

import torch
from torch import Tensor

from meshkit.batching import center
from meshkit.models import PoseTransferGenerator, PretrainedTransfer
from meshkit.models._released_matching import DensePlan
from meshkit.ot import TransportPlan
from meshkit.topology import vertex_normals
from meshkit.transfer._frames import among, rotations
from meshkit.transfer._kinds import rest_body
from meshkit.transfer.confidence import row_entropies

__all__ = ["RestBody", "agreements", "agrees", "choose", "find_rotation"]

DOUBT = {"humans": 0.05, "animals": 0.1}
"""Lead in score below which an orientation that was found is in doubt, for each kind of body."""

AGREEMENT = {"humans": 0.4, "animals": 0.35}
"""Correlation of normals below which an orientation that was given is in doubt, for each kind of body."""

_CLEAR = 0.05  # score by which another orientation must beat the usual ones


class RestBody:
    """The mean body of a kind as one network sees it: described and encoded once, when first needed.

    Args:
        net: weights.
        kind: ``"humans"`` or ``"animals"``.
    """

    def __init__(self, net: PretrainedTransfer, kind: str) -> None:
        self.net, self.kind = net, kind

    @property
    def can_match(self) -> bool:
        """Whether the weights have a matching."""
        return isinstance(self.net.generator, PoseTransferGenerator)

    def match(self, verts: Tensor, descriptors: Tensor | None) -> TransportPlan | DensePlan:
        """The matching of a mesh (V, 3), about its middle, to the body; in the dtype of the weights."""
        return self._generator.match(self._encode(verts, descriptors), self._encoded)

    @cached_property
    def surface(self) -> Tensor:
        """(1, N, 6) positions and normals."""
        verts, faces = self._mesh
        return torch.cat([center(verts[None])[0], vertex_normals(verts, faces)], 1)[None]

    @cached_property
    def _mesh(self) -> tuple[Tensor, Tensor]:
        device = next(self.net.parameters()).device
        verts, faces = rest_body(self.kind)
        return verts.to(device), faces.to(device)

    @cached_property
    def _encoded(self) -> Tensor:
        verts, faces = self._mesh
        return self._encode(center(verts[None])[0], self.net.describe(verts, faces))

    def _encode(self, verts: Tensor, descriptors: Tensor | None) -> Tensor:
        # Meshes are described in float32, whatever the weights compute in: an eigenproblem does not bear bfloat16.
        dtype = next(self.net.parameters()).dtype
        return self._generator.encode(
            verts[None].to(dtype), descriptors=None if descriptors is None else descriptors[None].to(dtype)
        )

    @property
    def _generator(self) -> PoseTransferGenerator:
        generator = self.net.generator
        if not isinstance(generator, PoseTransferGenerator):
            raise ValueError("these weights have no matching to find the orientation with: give up and facing")
        return generator


def find_rotation(
    rest: RestBody,
    verts: Tensor,
    faces: Tensor,
    *,
    descriptors: Tensor | None,
    candidates: Tensor,
    usual: Tensor | None = None,
) -> tuple[Tensor, bool]:
    r"""The rotation after which a mesh, as the weights match it, lies most like a rest body.

    The mesh, turned by each candidate, is matched to the rest body by the weights. Chest, back, toes and nose are told
    apart by the matching, and their normals by the direction they look in: so the normals n of the mesh and those n' of
    the matched places must agree, and, which counts less, so must the positions x and x' about their means, and the
    matching must be sharp. The score is

    .. math:: \mathrm{corr}(n, n') + \tfrac18 \left( \mathrm{corr}(x, x') - H \right), \qquad
              \mathrm{corr}(a, b) = \frac{\sum_i a_i \cdot b_i}{\lVert a \rVert \, \lVert b \rVert}

    with the mean entropy H, in nats, of the rows of the matching. This works in any pose, where symmetry and the
    longest axis do not. Of two nearly equal scores the usual orientation's counts more.

    Args:
        rest: the body to match it to, by weights with a matching.
        verts: (V, 3), scaled to metres.
        faces: (F, 3).
        descriptors: (V, D) what the weights say of the mesh; ``None`` if they take none.
        candidates: (R, 3, 3) rotations.
        usual: (K, 3, 3) those of them that another must beat by 0.05, as most files have them; if ``None``, up +z,
            facing -y, and up +y, facing +z.

    Returns:
        The rotation (3, 3), and whether it is clear: its score leads that of the next best by more than ``DOUBT``.
    """
    rows = agreements(rest, verts, faces, descriptors=descriptors, candidates=candidates)
    usual = torch.cat([rotations("+z", "-y"), rotations("+y", "+z")]) if usual is None else usual
    best, clear = choose(rows, among(candidates, usual).cpu(), doubt=DOUBT[rest.kind])
    return candidates[best], clear


def choose(rows: Tensor, favoured: Tensor, *, doubt: float) -> tuple[int, bool]:
    """The number of the best of :func:`agreements` (R, 2), and whether it leads by more than ``doubt``.

    ``favoured`` (R,) are the usual ones.
    """
    score = rows[:, 0] + rows[:, 1] / 8
    best = int((score + _CLEAR * favoured).argmax())
    others = score[torch.arange(len(score), device=score.device) != best]
    return best, bool(score[best] - others.max() > doubt)


def agrees(rest: RestBody, verts: Tensor, faces: Tensor, *, descriptors: Tensor | None, rotation: Tensor) -> bool:
    """Whether an orientation that was given may be right: as :func:`find_rotation` sees it, the normals correlate.

    True where the weights have no matching to tell by.
    """
    if not rest.can_match:
        return True
    row = agreements(rest, verts, faces, descriptors=descriptors, candidates=rotation[None])
    return float(row[0, 0]) >= AGREEMENT[rest.kind]


@torch.no_grad()
def agreements(
    rest: RestBody, verts: Tensor, faces: Tensor, *, descriptors: Tensor | None, candidates: Tensor
) -> Tensor:
    """(R, 2) for each candidate: correlation of normals with the matched ones; that of positions, less the entropy."""
    normals = vertex_normals(verts, faces)
    rows = []
    for rotation in candidates.to(verts):
        turned = center((verts @ rotation.T)[None])[0]
        plan = rest.match(turned, descriptors)
        there = plan.barycentric(rest.surface)[0].to(turned)
        like = _correlation(turned - turned.mean(0), there[:, :3] - there[:, :3].mean(0))
        rows.append((_correlation(normals @ rotation.T, there[:, 3:]), like - _mean_row_entropy(plan)))
    return torch.tensor(rows, device="cpu")


def _mean_row_entropy(plan: TransportPlan | DensePlan) -> float:
    if isinstance(plan, TransportPlan):  # its rows sum to 1 / N each; far cheaper than to write out the matrix
        return float(plan.entropy()[0]) - math.log(plan.shape[1])
    return float(row_entropies(plan.dense()[0].float()).mean())


def _correlation(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum() / (a.norm() * b.norm()).clamp_min(1e-12))
