"""What a transfer returns: the mesh, what was done, and how far to trust it."""

import re
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from torch import Tensor

from meshkit.transfer._doubts import following
from meshkit.transfer._frames import axis_name
from meshkit.transfer._prepare import Prepared
from meshkit.transfer.confidence import Confidence

__all__ = ["Doubt", "TransferReport", "TransferResult"]


class Doubt(NamedTuple):
    """Something unusual or in doubt.

    Attributes:
        role: ``"identity"`` or ``"pose"``, whichever mesh it is about; empty if it is about the two together.
        text: what it is, and what to do; it holds no name of a file.
        follows: whether it is only to be expected, as a mesh that it is about is not of the weights' kind, which is a
            doubt of its own. The printed report counts such doubts.
    """

    role: str
    text: str
    follows: bool = False

    @property
    def tells_role(self) -> bool:
        """Whether the text says itself which mesh it is about, if it is about one."""
        return not self.role or f"the {self.role} mesh" in self.text

    @property
    def headline(self) -> str:
        """What it is and of which mesh, without numbers and advice: the same for every pose that has it."""
        clause = re.split(r" \(|[:;]", self.text, maxsplit=1)[0]
        return clause if self.tells_role else f"{self.role}: {clause}"


@dataclass(frozen=True)
class TransferReport:
    """What was done and how far to trust it; ``print`` it to read it.

    Attributes:
        identity: the identity mesh and what was made of it.
        pose: the pose mesh likewise.
        weights: which, and why.
        confidence: numbers that tell an ordinary transfer from an unusual one.
        doubts: what is unusual or in doubt; empty if nothing is. Where identity and pose are the same mesh, what is
            said of both is there once.
        calibrated: whether the weights' card says what is usual; otherwise there are no warnings from the numbers.
        refined: weight of the network's result in the refinement; ``None`` if there was none.
        seconds: time taken.
        frame: axes and unit of the result, in words.
        quality: mean error of the weights on unseen test pairs, in words; empty if their card does not say. That a
            transfer is usual says no more than that it is as good as these.
    """

    identity: Prepared
    pose: Prepared
    weights: str
    confidence: Confidence
    doubts: tuple[Doubt, ...]
    calibrated: bool
    refined: float | None
    seconds: float
    frame: str = ""
    quality: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """The doubts in words, with the name of the mesh where the words do not say which."""
        return tuple(map(self._in_words, self.doubts))

    def _in_words(self, doubt: Doubt) -> str:
        return doubt.text if doubt.tells_role else f"{self.blamed(doubt)}: {doubt.text}"

    def blamed(self, doubt: Doubt) -> str:
        """Name of the mesh that a doubt is about; the pose mesh's if it is about the two together."""
        return self.identity.name if doubt.role == "identity" else self.pose.name

    def as_dict(self) -> dict[str, Any]:
        """Numbers, doubts and what was done, in types that JSON knows."""
        return {
            "identity": _facts(self.identity),
            "pose": _facts(self.pose),
            "weights": self.weights,
            "frame": self.frame,
            "refined": self.refined,
            "seconds": self.seconds,
            "numbers": asdict(self.confidence),
            "doubts": [doubt._asdict() for doubt in self.doubts],
        }

    def __str__(self) -> str:
        numbers = self.confidence
        facts = [f"edges change by {numbers.edge_change:.1%}"]
        if numbers.match_spread is not None and numbers.mutual_share is not None:
            facts.append(f"matches spread over {numbers.match_spread:.2%} of the pose mesh")
            facts.append(f"{numbers.mutual_share:.0%} of them mutual")
        lines = [f"identity {self.identity.name}", _indented(str(self.identity))]
        lines += [f"pose     {self.pose.name}", _indented(str(self.pose)), f"weights  {self.weights}"]
        lines += [f"         {self.quality}"] if self.quality else []
        lines.append(f"result   {', '.join(facts)}; {self.seconds:.1f} s")
        if self.frame:
            lines.append(f"         {self.frame}")
        if self.doubts:
            lines += [f"UNUSUAL  {self._in_words(doubt)}" for doubt in self.doubts if not doubt.follows]
            if more := following(self.doubts):
                lines.append(f"         {more}")
        if not self.calibrated:
            lines.append("         these weights do not say what is usual")
        elif not self.doubts:
            lines.append("         all within what is usual for the weights' own test pairs")
        return "\n".join(lines)


@dataclass(frozen=True)
class TransferResult:
    """The identity mesh in the pose of the pose mesh.

    Attributes:
        verts: (V, 3) float32 vertices, in number and order of the identity file.
        faces: (F, 3) the identity file's faces.
        report: what was done and how far to trust it.
        views: vertices and faces of identity, pose and result, upright and to scale, for pictures.
    """

    verts: Tensor
    faces: Tensor
    report: TransferReport
    views: tuple[tuple[Tensor, Tensor], ...]


def _facts(mesh: Prepared) -> dict[str, Any]:
    return {
        "name": mesh.name,
        "vertices": mesh.opened.report.num_verts,
        "faces": mesh.opened.report.num_faces,
        "unit": mesh.scale.unit,
        "scaled_by": mesh.scale.factor,
        "up": axis_name(mesh.up),
        "facing": axis_name(-mesh.rotation[1]),
        "axes": mesh.found,
        "openings": mesh.openings._asdict(),
        "kept_area": mesh.clean.kept_area,
        "done": list(mesh.notes),
    }


def _indented(text: str) -> str:
    return "\n".join(f"  {line}" for line in text.splitlines())
