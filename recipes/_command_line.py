"""The command line of a recipe: a dataclass of settings read from it, and mistakes told in one line."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from itertools import takewhile
from operator import attrgetter
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import tyro
from _run import UserError

from meshkit._names import did_you_mean

T = TypeVar("T")
KINDS: dict[Any, str] = {int: "a whole number", float: "a number", str: "a word", Path: "a path", NoneType: "None"}


def read(kind: type[T], description: str | None, default: T | None = None) -> T:
    """The settings of the command line, of type ``kind``.

    Raises:
        UserError: in place of the box that tyro draws: what came, what is accepted, and where to look.
    """
    options: dict[str, Any] = {} if default is None else {"default": default}
    said, words = io.StringIO(), sys.argv[1:]
    try:
        with redirect_stderr(said):
            settings = tyro.cli(kind, description=description, **options)
    except SystemExit as end:
        if end.code != 2:  # --help
            raise
        raise UserError(f"{mistake(kind, words, said.getvalue())}; --help lists the options") from None
    known = accepted(kind)
    for name in typed(kind, words):
        if attrgetter(name)(settings) == ():
            flag = f"--{name}".replace("_", "-")
            raise UserError(f"{flag} takes {meaning(known[name]).rstrip(',')}, got nothing; --help lists the options")
    return settings


def typed(kind: type, words: Sequence[str]) -> list[str]:
    """The settings that a command line names, ``model.`` before those of the generator.

    As tyro reads them: ``--lr=1``, ``--eval_pairs 1``, ``--no-arap``, ``--model.no-residual``.
    """
    known = accepted(kind)
    found = (setting(word, known) for word in words)
    return list(dict.fromkeys(name for name in found if name is not None))


def accepted(kind: type, before: str = "") -> dict[str, Any]:
    """Settings and their types; those of a dataclass within come with its name and a dot before theirs."""
    hints, known = get_type_hints(kind, include_extras=True), dict[str, Any]()
    for field in fields(kind):  # type: ignore[arg-type]
        hint = hints[field.name]
        known |= (
            accepted(hint, f"{field.name}.")
            if isinstance(hint, type) and is_dataclass(hint)
            else {before + field.name: hint}
        )
    return known


def setting(word: str, known: dict[str, Any]) -> str | None:
    """Which of the known settings a word of the command line names."""
    if not word.startswith("--"):
        return None
    name = word[2:].partition("=")[0].replace("-", "_")
    if name in known:
        return name
    positive = re.sub(r"^(\w+\.)?no_", r"\1", name)
    return positive if known.get(positive) is bool else None


def mistake(kind: type, words: Sequence[str], said: str) -> str:
    """What is wrong with a command line, in one line, of which tyro ``said`` in its box what it could not take."""
    known = accepted(kind)
    for place, word in enumerate(words):
        if not word.startswith("--") or word == "--help":
            continue
        flag, given, value = word.partition("=")
        name = setting(word, known)
        if name is None:
            return f"there is no option {flag}{did_you_mean(flag, flags(known))}"
        if known[name] is bool:
            values_given = [value] if given else list(takewhile(lambda w: not w.startswith("--"), words[place + 1 :]))
            if values_given:
                return f"{flag} takes no value, got {', '.join(map(repr, values_given))}; {off(name)} turns it off"
    inside = " ".join(re.sub(r"[\u2500-\u257f]+", "\n", said).split("\n")[2:])
    text = " ".join(re.sub(r"\[/?bold\]", "", inside).split("For full helptext")[0].split())
    unread = re.match(r"Unrecognized options: (\S+)", text)
    if unread:
        return f"{unread[1].rstrip(',')!r} belongs to no option"
    blamed = re.search(r"--[\w.-]*\w", text)
    name = setting(blamed[0], known) if blamed else None
    if blamed is None or name is None:
        return text
    came = values(blamed[0], words)
    allowed = choices(known[name])
    wrong = next((value for value in came if value not in allowed), "")
    got = ", ".join(map(repr, came)) or "nothing"
    return f"{blamed[0]} takes {meaning(known[name]).rstrip(',')}, got {got}{did_you_mean(wrong, allowed)}"


def flags(known: dict[str, Any]) -> Iterator[str]:
    """The options as they are typed."""
    for name, hint in known.items():
        yield f"--{name}".replace("_", "-")
        if hint is bool:
            yield off(name)


def off(name: str) -> str:
    """The option that turns a setting off."""
    before, dot, own = name.rpartition(".")
    return f"--{before}{dot}no-{own}".replace("_", "-")


def values(flag: str, words: Sequence[str]) -> list[str]:
    """The words that follow an option, where it comes last."""
    found: list[str] = []
    for place, word in enumerate(words):
        if word.partition("=")[0].replace("_", "-") == flag.replace("_", "-"):
            rest = [*words[place + 1 :], "--"]
            upto = next(i for i, w in enumerate(rest) if w.startswith("--"))
            found = [word.partition("=")[2]] if "=" in word else rest[:upto]
    return found


def choices(hint: Any) -> list[str]:
    """The words that a setting of this type takes, if they are all known."""
    if get_origin(hint) is Literal:
        return list(map(str, get_args(hint)))
    return [word for inner in get_args(hint) for word in choices(inner)]


def meaning(hint: Any) -> str:
    """A type in words: ``a whole number or None``, ``2 values, each a path``."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return meaning(inner[0])
    if origin is Literal:
        return " or ".join(", ".join(map(str, inner)).rsplit(", ", 1))
    if origin is tuple and inner[-1] is ...:
        return f"one or more values, each {meaning(inner[0])},"
    if origin is tuple and len(set(inner)) == 1:
        return f"{len(inner)} values, each {meaning(inner[0])},"
    if inner:  # a union
        return " or ".join(map(meaning, inner))
    return KINDS.get(hint, getattr(hint, "__name__", str(hint)))
