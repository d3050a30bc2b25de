"""Pose transfer between any two meshes."""

import time
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from meshkit.deform import arap_deform
from meshkit.models import GeneratorOutput, PretrainedTransfer
from meshkit.transfer._choose import Weights, choose_weights
from meshkit.transfer._doubts import said_once
from meshkit.transfer._frames import axis_name, turn_up
from meshkit.transfer._open import Mesh, OpenedMesh, named, open_mesh
from meshkit.transfer._orient import RestBody
from meshkit.transfer._prepare import Prepared, prepare
from meshkit.transfer.confidence import Confidence, measure_confidence
from meshkit.transfer.report import Doubt, TransferReport, TransferResult

__all__ = ["PoseTransfer", "transfer_pose"]

_VERTICES = {"humans": 1000, "animals": 1962}
REFINE = 0.1
"""Default weight of the network's result in the refinement, against the stiffness of the identity's surface."""


class PoseTransfer:
    """Pose transfer to one identity: what concerns the identity mesh is done once.

    Args:
        identity: the mesh that gives the body; file, or vertices (V, 3) and faces (F, 3).
        weights: ``"auto"`` (people's or animals', by the shape of the identity mesh), a name of
            :func:`meshkit.models.pretrained_names`, the folder of a training run, or a
            :class:`meshkit.models.PretrainedTransfer`.
        refine: ``True``: let the identity mesh deform as rigidly as possible towards the network's result, which keeps
            its local shape; a positive number: the same, with this weight of the network's result (default 0.1; more
            follows the network more closely); ``False``: the network's result as it is.
        frame: the axes, unit and place of the result. ``"pose"``: the pose file's, so that the result stands where the
            pose mesh stands. ``"identity"``: the identity file's up axis and unit; the body is upright in that file
            where it is upright in the pose file, and keeps its heading and place as far as the two files' axes agree.
        identity_up, identity_facing, identity_unit: signed axis to the head, signed axis of the gaze, and unit
            (m, cm, mm, in, ft) of the identity file; found from the mesh where ``None``.
        device: where to compute; that of the network, or the CPU, if ``None``.

    Raises:
        MeshFileError: a file is missing, damaged or no mesh.
        ValueError: unknown weights or options, or a mesh that cannot be used.

    Example:
        >>> from meshkit.data import load_humans
        >>> from meshkit.models import GeneratorConfig, PretrainedTransfer
        >>> config = GeneratorConfig(extractor_widths=(8, 16), k=4, widths=(32, 16))
        >>> net = PretrainedTransfer(config.build(), config)  # untrained: in use, leave weights to "auto"
        >>> body = load_humans()
        >>> axes = {"identity_up": "+z", "identity_facing": "-y"}
        >>> transfer = PoseTransfer((body.template, body.faces), weights=net, refine=False, **axes)
        >>> pose = body(torch.tensor([3]), torch.tensor([10]))[0]
        >>> transfer((pose, body.faces), pose_up="+z", pose_facing="-y").verts.shape
        torch.Size([1000, 3])
    """

    def __init__(
        self,
        identity: Mesh,
        *,
        weights: Weights = "auto",
        refine: bool | float = True,
        frame: Literal["pose", "identity"] = "pose",
        identity_up: str | None = None,
        identity_facing: str | None = None,
        identity_unit: str | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        if frame not in ("pose", "identity"):
            raise ValueError(f"frame must be 'pose' or 'identity', got {frame!r}")
        if refine is not True and refine is not False and not refine > 0:
            raise ValueError(f"refine must be True, False or a positive weight, got {refine!r}")
        self.frame = frame
        self.refine = REFINE if refine is True else None if refine is False else float(refine)
        opened = cache(lambda: open_mesh(identity, "identity"))
        self.net, self.weights = choose_weights(weights, opened, device=device)
        self.kind: str | None = self.net.card.get("data")
        self.rest = None if self.kind is None else RestBody(self.net, self.kind)
        self.identity = self.prepare(opened(), unit=identity_unit, up=identity_up, facing=identity_facing)

    def prepare(self, opened: OpenedMesh, *, unit: str | None, up: str | None, facing: str | None) -> Prepared:
        """Make a mesh ready for the weights: an identity mesh, or a pose mesh for :meth:`apply`."""
        num_verts = self.net.card.get("vertices") or _VERTICES.get(self.kind or "", 1000)
        options = {"unit": unit, "up": up, "facing": facing}
        return prepare(opened, net=self.net, kind=self.kind, num_verts=num_verts, rest=self.rest, **options)

    @torch.no_grad()
    def __call__(
        self, pose: Mesh, *, pose_up: str | None = None, pose_facing: str | None = None, pose_unit: str | None = None
    ) -> TransferResult:
        """Give the identity the pose of a mesh; its axes and unit are found where they are ``None``.

        Raises:
            MeshFileError: the file is missing, damaged or no mesh.
            ValueError: an unknown option, or a mesh that cannot be used.
        """
        start = time.perf_counter()
        opened = open_mesh(pose, "pose")
        return self.apply(self.prepare(opened, unit=pose_unit, up=pose_up, facing=pose_facing), start)

    @torch.no_grad()
    def apply(self, other: Prepared, start: float, *, up: Tensor | None = None) -> TransferResult:
        """The transfer from a prepared pose mesh.

        Args:
            other: the pose mesh.
            start: when the work on it began, by ``time.perf_counter()``.
            up: up axis of the pose file; that of the body if ``None``.
        """
        own, net = self.identity, self.net
        output, numbers = named(f"{own.name}, {other.name}", lambda: run_network(net, own, other))
        small = output.vertices.to(own.verts)  # of weights in another dtype
        if not bool(torch.isfinite(small).all()):
            raise ValueError(f"{other.name}: the network's result is not finite; the weights cannot do this pair")
        if self.refine is not None:
            small = _refined(own.verts, own.simple.faces, small, self.refine)
        posed = own.carry(small)
        doubts = self._doubts(other, numbers)
        report = TransferReport(
            own,
            other,
            self.weights,
            numbers,
            tuple(doubts),
            bool(net.card.get("usual")),
            self.refine,
            time.perf_counter() - start,
            self._frame_in_words(other, other.up if up is None else up),
            _quality(net.card),
        )
        faces = own.faces
        views = (
            (own.clean.verts @ own.rotation.T, own.clean.faces),
            (other.clean.verts @ other.rotation.T, other.clean.faces),
            (posed, faces.to(posed.device)),
        )
        return TransferResult(self._placed(posed, other, other.up if up is None else up).cpu(), faces, report, views)

    def _doubts(self, other: Prepared, numbers: Confidence) -> list[Doubt]:
        """What is unusual about the two meshes and their transfer; of a mesh of another kind all but that follows."""
        meshes = {"identity": self.identity, "pose": other}
        kinds = {role: self._strange(role, mesh) for role, mesh in meshes.items()}
        hopeless = {role for role, mesh in meshes.items() if kinds[role] and not _between(mesh)}
        found = [Doubt(role, text) for role, text in kinds.items() if text]
        for role, mesh in meshes.items():  # these may be why a mesh is of no kind, and so do not follow from that
            found += [Doubt(role, f"the {role} mesh is {text}") for text in (mesh.loss, mesh.openings.doubt) if text]
        for role, mesh in meshes.items():
            found += [Doubt(role, text, role in hopeless) for text in mesh.doubts]
        usual = self.net.card.get("usual", {})
        for field, text in zip(numbers.unusual(usual), numbers.warnings(usual), strict=True):
            role = field.partition("_")[0]
            about = {role} if role in meshes else set(meshes)
            found.append(Doubt(role if role in meshes else "", text, bool(about & hopeless)))
        return said_once(found) if self.identity.is_same(other) else found

    def _strange(self, role: str, mesh: Prepared) -> str:
        """Why a mesh may not be of the weights' kind; empty if it is."""
        like = mesh.likeness
        if like is None or (like.clear and like.kind == self.kind):
            return ""
        if not like.clear:
            return f"the {role} mesh has {like.doubt}"
        shape = f"the {role} mesh has the shape of {like.kind}"
        return f"these weights are for {self.kind}, but {shape}: use weights of its kind"

    def _frame_in_words(self, other: Prepared, up: Tensor) -> str:
        own = other if self.frame == "pose" else self.identity
        axis = axis_name(up if self.frame == "pose" else own.up)
        unit = f" ({own.scale.unit})" if own.scale.metric or own.scale.given else ""
        return f"in the axes and unit{unit} of the {self.frame} mesh, up {axis}"

    def _placed(self, posed: Tensor, other: Prepared, up: Tensor) -> Tensor:
        """From the frame of the weights to that of a file: on the ground, and over the place, of the pose mesh."""
        own = self.identity
        metric, rotation = own.scale.fit, other.rotation
        stand = _standing_point(other.clean.verts @ rotation.T) / other.scale.fit
        kept = own.clean.target.to(posed.device) >= 0  # loose parts do not decide where the body stands
        posed = posed / metric
        posed = posed - _standing_point(posed[kept]) + stand
        in_pose_axes = posed @ rotation
        if self.frame == "pose":
            return in_pose_axes / other.scale.metres
        turn = turn_up(up.cpu(), own.up.cpu()).to(posed)
        return in_pose_axes @ turn.T / own.scale.metres


def run_network(net: PretrainedTransfer, identity: Prepared, pose: Prepared) -> tuple[GeneratorOutput, Confidence]:
    """What the weights make of two prepared meshes, and the numbers of it."""
    pair = identity.verts, pose.verts
    faces: dict[str, Any] = {"identity_faces": identity.simple.faces, "pose_faces": pose.simple.faces}
    one, two = identity.descriptors, pose.descriptors
    dtype = next(net.parameters()).dtype
    first, second = (None if described is None else described.to(dtype) for described in (one, two))
    output = net.output(*pair, **faces, identity_descriptors=first, pose_descriptors=second)
    numbers = measure_confidence(
        net,
        *pair,
        **faces,
        output=output,
        identity_descriptors=one,
        pose_descriptors=two,
        identity_roughness=identity.roughness,
        pose_roughness=pose.roughness,
    )
    return output, numbers


def _between(mesh: Prepared) -> bool:
    """Whether a mesh is like people and animals both, so that the weights may well know it."""
    return mesh.likeness is not None and not mesh.likeness.clear and not mesh.likeness.neither


def _quality(card: dict[str, Any]) -> str:
    """What a card says of the mean error on unseen pairs, beside that of doing nothing."""
    figures = card.get("figures", {})
    if not {"pmd", "pmd_copy_identity"} <= figures.keys():
        return ""
    error, idle = figures["pmd"], figures["pmd_copy_identity"]
    poor = "; they are poor" if error > idle / 4 else ""
    return (
        f"their PMD on unseen test pairs is {error:.1f}e-3, where leaving the identity as it is has {idle:.1f}e-3{poor}"
    )


def _standing_point(verts: Tensor) -> Tensor:
    """Middle of the bounding box, at its lowest height."""
    low, high = verts.amin(0), verts.amax(0)
    middle = (low + high) / 2
    return torch.stack([middle[0], middle[1], low[2]])


def _refined(rest: Tensor, faces: Tensor, target: Tensor, weight: float) -> Tensor:
    none = torch.empty(0, dtype=torch.long, device=rest.device)
    weights = torch.full((len(rest),), weight, dtype=rest.dtype, device=rest.device)
    deformed, _ = arap_deform(
        rest,
        faces,
        none,
        rest.new_empty(0, 3),
        soft_targets=target,
        soft_weights=weights,
        init=target,
        max_iter=60,
        grad="none",
        degenerate="ignore",
    )
    return deformed


def transfer_pose(
    identity: Mesh,
    pose: Mesh,
    *,
    weights: Weights = "auto",
    refine: bool | float = True,
    frame: Literal["pose", "identity"] = "pose",
    identity_up: str | None = None,
    identity_facing: str | None = None,
    identity_unit: str | None = None,
    pose_up: str | None = None,
    pose_facing: str | None = None,
    pose_unit: str | None = None,
    device: torch.device | str | None = None,
) -> TransferResult:
    """Give one mesh the pose of another.

    The two may differ in vertex count, topology, axes and unit, and may be unclean. Both are reported on, cleaned
    (the largest connected part counts; the rest of the identity mesh follows it), scaled to metres, simplified to the
    size that the weights were trained at, and turned to their frame; the network's result is refined and carried to
    all vertices of the identity file. For many poses of one identity use :class:`PoseTransfer` or
    :func:`transfer_sequence`.

    Args:
        identity: the mesh that gives the body; file, or vertices (V, 3) and faces (F, 3).
        pose: the mesh that gives the pose, likewise.
        weights: see :class:`PoseTransfer`, as all that follows.
        refine: keep the identity's local shape.
        frame: axes, unit and place of the result: the ``"pose"`` file's or the ``"identity"`` file's.
        identity_up: signed axis such as ``"+y"`` to the head; ``None`` to find it.
        identity_facing: signed axis of the gaze; ``None`` to find it.
        identity_unit: m, cm, mm, in or ft; ``None`` to guess it.
        pose_up: likewise for the pose file.
        pose_facing: likewise.
        pose_unit: likewise.
        device: where to compute.

    Returns:
        The posed mesh, in the vertex order of the identity file, and the report.

    Raises:
        MeshFileError: a file is missing, damaged or no mesh.
        ValueError: unknown weights or options, or a mesh that cannot be used.

    Example:
        >>> from meshkit.data import load_humans
        >>> from meshkit.models import pretrained_names
        >>> body = load_humans()
        >>> identity, pose = body(torch.tensor([3, 50]), torch.tensor([10, 500]))
        >>> if "xdualnet-humans" in pretrained_names():
        ...     result = transfer_pose((identity, body.faces), (100 * pose, body.faces), weights="xdualnet-humans")
        ...     assert result.report.pose.scale.unit == "cm"
    """
    transfer = PoseTransfer(
        identity,
        weights=weights,
        refine=refine,
        frame=frame,
        identity_up=identity_up,
        identity_facing=identity_facing,
        identity_unit=identity_unit,
        device=device,
    )
    return transfer(pose, pose_up=pose_up, pose_facing=pose_facing, pose_unit=pose_unit)
