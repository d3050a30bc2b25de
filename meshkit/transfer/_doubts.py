"""Doubts about a transfer, and how they are told."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from meshkit.io.report import counted

if TYPE_CHECKING:
    from meshkit.transfer.report import Doubt

__all__ = ["following", "said_once"]

_ROLES = ("identity", "pose")


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
