"""Names: the one that was probably meant, and those of the weights that come with meshkit. Imports no PyTorch."""

from collections.abc import Iterable
from difflib import SequenceMatcher
from importlib.resources import files
from typing import Any

__all__ = ["did_you_mean", "nearest", "shipped_weights", "weights_folder"]

_ALIKE = 0.6  # share of letters in common from which on a name may have been meant, as difflib's get_close_matches


def nearest(word: str, names: Iterable[str]) -> str | None:
    """The name most like a word, of equals the first; ``None`` if none is like it. Case and ``_`` for ``-`` are equal.

    Example:
        >>> nearest("Eval_pair", ["eval-every", "eval-pairs"])
        'eval-pairs'
    """
    plain = _plain(word)
    ratios = {name: SequenceMatcher(None, _plain(name), plain).ratio() for name in names}
    best = max(ratios, key=ratios.__getitem__, default=None)
    return best if best is not None and ratios[best] >= _ALIKE else None


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """What to say after a word that is none of the names; empty if none is like it.

    Example:
        >>> "there is no kind 'animal'" + did_you_mean("animal", ["humans", "animals"])
        "there is no kind 'animal': did you mean animals?"
    """
    name = nearest(word, names)
    return "" if name is None else f": did you mean {name}?"


def weights_folder() -> Any:  # a Traversable, whose place in the library depends on the version of Python
    """Where the weights lie that come with this installation."""
    return files("meshkit") / "weights"


def shipped_weights() -> list[str]:
    """Names of the weights that come with this installation, sorted."""
    folder = weights_folder()
    ending = ".safetensors"
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(ending) for entry in folder.iterdir() if entry.name.endswith(ending))


def _plain(name: str) -> str:
    return name.casefold().replace("_", "-")
