"""Doubts about a transfer, and how they are told."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from meshkit.io.report import counted

__all__ = ["Doubt", "following", "said_once"]

_ROLES = ("identity", "pose")


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


def said_once(doubts: Sequence[Doubt]) -> list[Doubt]:
    """Doubts of an identity and a pose that are the same mesh: what is said of both becomes one doubt of the two."""
    neutral = [d._replace(role="", text=d.text.replace(f"the {d.role} mesh", "the mesh")) for d in doubts]
    heads = {role: {n.headline for d, n in zip(doubts, neutral, strict=True) if d.role == role} for role in _ROLES}
    both = heads["identity"] & heads["pose"]
    kept = []
    for doubt, common in zip(doubts, neutral, strict=True):
        if not doubt.role or common.headline not in both:
            kept.append(doubt)
        elif doubt.role == "identity":
            kept.append(common)
    return kept


def following(doubts: Iterable[Doubt]) -> str:
    """How many of the doubts are only to be expected after the others, in words; empty if none are."""
    count = sum(doubt.follows for doubt in doubts)
    if not count:
        return ""
    verb = "follows" if count == 1 else "follow"
    return f"{counted(count, 'further doubt')} {verb} from the kind of mesh: see the report's doubts, or --report FILE"
