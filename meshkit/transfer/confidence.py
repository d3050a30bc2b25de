"""How far a transfer is from what the weights know: seven numbers of it, against those of ordinary pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from meshkit.metrics import edge_ratio
from meshkit.models import GeneratorOutput, PretrainedTransfer
from meshkit.topology import vertex_normals

__all__ = ["Confidence", "bounds", "measure_confidence", "roughness", "row_entropies", "usual_range"]

_CHECK = "see that both are bodies of the kind that the weights know, and that their axes are right"
_UNLIKE = "clothes, props, holes and limbs welded together do that; leave them away, or train weights on such meshes"
_SMOOTH = "noise of a scan, or too few vertices (fewer than the weights want): smooth the scan, or take a finer mesh"

# Field, whether large values are the unusual ones, how they are written, what an unusual one says, and what to do.
_MEANINGS = (
    (
        "match_spread",
        True,
        ".1%",
        "the network is unsure which places of the two meshes correspond, so limbs may go astray; on average it "
        "matches a vertex with this share of the pose mesh",
        _CHECK,
    ),
    ("mutual_share", False, ".1%", "few vertices of the two meshes are each other's best match", _CHECK),
    (
        "edge_change",
        True,
        ".1%",
        "the network changes the identity's edges much in length",
        "look at the result; a smaller weight of the refinement (refine) keeps more of the identity's shape",
    ),
    ("identity_distance", True, ".3f", "the identity mesh's surface is unlike that of the training meshes", _UNLIKE),
    ("pose_distance", True, ".3f", "the pose mesh's surface is unlike that of the training meshes", _UNLIKE),
    ("identity_roughness", True, ".3f", "the identity mesh's surface is rough", _SMOOTH),
    ("pose_roughness", True, ".3f", "the pose mesh's surface is rough", _SMOOTH),
)


@dataclass(frozen=True)
class Confidence:
    """Numbers that tell a transfer the weights can do from one they cannot; ``None`` where weights have no such thing.

    Attributes:
        match_spread: mean over identity vertices of the perplexity (exponential of the entropy) of their row of the
            matching, over the number of pose vertices: 0 is a sharp match, 1 no match at all.
        mutual_share: share of identity vertices whose best match prefers them too.
        edge_change: mean relative change of edge length from the identity mesh to the network's result.
        identity_distance: distance of the identity mesh's mean descriptors from those of the training meshes, root mean
            square over the signatures, in standard deviations of the single training vertices.
        pose_distance: likewise for the pose mesh.
        identity_roughness: :func:`roughness` of the identity mesh, as the network was given it.
        pose_roughness: likewise for the pose mesh.
    """

    match_spread: float | None
    mutual_share: float | None
    edge_change: float
    identity_distance: float | None
    pose_distance: float | None
    identity_roughness: float | None = None
    pose_roughness: float | None = None

    def warnings(self, usual: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
        """What is unusual, and what to do, in words; ``usual`` is :func:`usual_range` of ordinary pairs.

        Model cards hold it.
        """
        found, unusual = [], self.unusual(usual)
        for name, high_is_odd, form, text, advice in _MEANINGS:
            if name in unusual:
                value, median, limit = getattr(self, name), usual[name]["median"], usual[name]["limit"]
                side = "below" if high_is_odd else "above"
                bounds = f"median {median:{form}}, 99 of 100 {side} {limit:{form}}"
                found.append(f"{text}: {value:{form}} ({bounds}); {advice}")
        return tuple(found)

    def unusual(self, usual: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
        """Names of the numbers beyond their limit."""
        found = []
        for name, high_is_odd, *_ in _MEANINGS:
            value, known = getattr(self, name), usual.get(name)
            if value is not None and known is not None:
                odd = value > known["limit"] if high_is_odd else value < known["limit"]
                found += [name] if odd else []
        return tuple(found)


@torch.no_grad()
def measure_confidence(
    net: PretrainedTransfer,
    identity: Tensor,
    pose: Tensor,
    *,
    identity_faces: Tensor,
    pose_faces: Tensor,
    output: Any,
    identity_descriptors: Tensor | None = None,
    pose_descriptors: Tensor | None = None,
    identity_roughness: float | None = None,
    pose_roughness: float | None = None,
) -> Confidence:
    """Measure one transfer.

    Args:
        net: the weights.
        identity: (V, 3) identity mesh, as the network was given it.
        pose: (W, 3) pose mesh, likewise.
        identity_faces: (F, 3).
        pose_faces: (G, 3).
        output: what ``net.output`` made of them, for one pair.
        identity_descriptors: (V, D) what ``net.describe`` says of the identity mesh, if it was asked already.
        pose_descriptors: (W, D) likewise.
        identity_roughness: :func:`roughness` of the identity mesh, if it was measured already.
        pose_roughness: likewise.
    """
    result: GeneratorOutput = output
    spread = mutual = None
    if result.plan is not None:
        mass = result.plan.dense()[0].float()
        spread = float(row_entropies(mass).exp().mean()) / len(pose)
        forward, backward = mass.argmax(1), mass.argmax(0)
        mutual = float((backward[forward] == torch.arange(len(forward), device=forward.device)).float().mean())
    vertices = result.vertices if result.vertices.dim() == 3 else result.vertices[None]
    return Confidence(
        match_spread=spread,
        mutual_share=mutual,
        edge_change=float(edge_ratio(vertices, identity[None], identity_faces)[0]),
        identity_distance=_distance(net, identity, identity_faces, identity_descriptors),
        pose_distance=_distance(net, pose, pose_faces, pose_descriptors),
        identity_roughness=roughness(identity, identity_faces) if identity_roughness is None else identity_roughness,
        pose_roughness=roughness(pose, pose_faces) if pose_roughness is None else pose_roughness,
    )


def row_entropies(plan: Tensor) -> Tensor:
    """Entropy (N,), in nats, of each row of a plan (N, M), taken as a distribution; 0 for a row without mass."""
    share = plan / plan.sum(1, keepdim=True).clamp_min(torch.finfo(plan.dtype).tiny)
    return -torch.special.xlogy(share, share).sum(1)


def roughness(verts: Tensor, faces: Tensor) -> float:
    r"""Mean of :math:`1 - \cos` of the angle between the normal of a face and those of its vertices.

    0 on a plane; it grows with noise, and where a curved surface has few vertices. Faces without area do not count.

    Args:
        verts: (V, 3).
        faces: (F, 3), turned alike.
    """
    points = verts.double()
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = torch.linalg.cross(b - a, c - a)
    sound = normals.norm(dim=1) > 0
    cosine = (torch.nn.functional.normalize(normals, dim=1)[:, None] * vertex_normals(points, faces)[faces]).sum(-1)
    return float((1 - cosine[sound]).mean())


def _distance(net: PretrainedTransfer, verts: Tensor, faces: Tensor, descriptors: Tensor | None) -> float | None:
    descriptors = net.describe(verts, faces) if descriptors is None else descriptors
    if descriptors is None:
        return None
    mean, std = (getattr(net.generator, f"descriptor_{name}").to(descriptors) for name in ("mean", "std"))
    return float(((descriptors - mean) / std).mean(0)[:-1].square().mean().sqrt())  # the last channel is the size


def usual_range(measured: Sequence[Confidence], *, quantile: float = 0.99) -> dict[str, dict[str, float]]:
    """Median and limit of each number over ordinary pairs; a transfer beyond a limit is unusual.

    Args:
        measured: at least one :class:`Confidence` each of an ordinary pair.
        quantile: share of the ordinary pairs within each limit.

    Raises:
        ValueError: nothing measured.

    Example:
        >>> usual_range([Confidence(0.01, 0.5, 0.1 * i, None, None) for i in range(3)])["edge_change"]["median"]
        0.1
    """
    if not measured:
        raise ValueError("the usual range needs measured pairs, got none")
    usual = {}
    for name, *_ in _MEANINGS:
        values = [value for value in (asdict(one)[name] for one in measured) if value is not None]
        if values:
            usual[name] = bounds(name, values, quantile=quantile)
    return usual


def bounds(name: str, values: Sequence[float], *, quantile: float = 0.99) -> dict[str, float]:
    """Median and limit of one number, a field of :class:`Confidence`, over ordinary pairs."""
    high_is_odd = {field: high for field, high, *_ in _MEANINGS}[name]
    numbers = torch.tensor(values, dtype=torch.float64, device="cpu")
    limit = numbers.quantile(quantile if high_is_odd else 1 - quantile)
    return {"median": round(float(numbers.median()), 5), "limit": round(float(limit), 5)}
