"""Reads arrays out of pickles that nobody vouches for.

A pickle is a program: loading one with :mod:`pickle` runs whatever functions it names. Here every name it may use is
listed, and each stands for something inert of our own; nothing of NumPy, SciPy or chumpy is called while reading. Any
other name ends the reading, before it is looked up.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from meshkit.io import MeshFileError

__all__: list[str] = []

_KINDS = "biuf"  # booleans, integers and floats; no objects, no records


class Record:
    """An object of a class we know but do not run: its state, as stored."""

    state: dict[str, Any]

    def __new__(cls, *_: Any) -> Record:  # pickles make objects without __init__
        self = super().__new__(cls)
        self.state = {}
        return self

    def __setstate__(self, state: Any) -> None:
        self.state = state if isinstance(state, dict) else {"state": state}


class _DType:
    """A simple numeric dtype in the making: ``dtype('f8', 0, 1)`` and then a state that gives the byte order."""

    def __init__(self, code: Any = "", *_: Any) -> None:
        self.dtype = np.dtype(_text(code)) if len(_text(code)) <= 4 else np.dtype("O")
        if self.dtype.kind not in _KINDS:
            raise pickle.UnpicklingError(f"arrays of {_text(code)!r} are not read, only of numbers")

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder("<" if _text(state[1]) == "<" else ">" if _text(state[1]) == ">" else "=")


class Array:
    """A pickled NumPy array in the making; its buffer is in the file, so its size is bounded by the file's."""

    value: np.ndarray

    def __new__(cls, *_: Any) -> Array:
        self = super().__new__(cls)
        self.value = np.empty(0)
        return self

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, raw = state
        if not isinstance(dtype, _DType) or not isinstance(raw, bytes | str):
            raise pickle.UnpicklingError("an array is not a plain buffer of numbers")
        data = np.frombuffer(raw.encode("latin1") if isinstance(raw, str) else raw, dtype.dtype)
        self.value = data.reshape(tuple(int(n) for n in shape), order="F" if fortran else "C")


class _Call:
    """One of our functions, as an object of its own for each name in each file, so that no file can alter it."""

    __slots__ = ("function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


class _Restricted(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        package = module.split(".")[0]
        if package == "numpy" and name in ("ndarray", "dtype"):
            return Array if name == "ndarray" else _DType
        if package == "numpy" and name in ("_reconstruct", "_frombuffer", "scalar"):
            functions: dict[str, Callable[..., Any]]
            functions = {"_reconstruct": Array, "_frombuffer": _frombuffer, "scalar": _scalar}
            return _Call(functions[name])
        if package == "scipy" and name in ("csc_matrix", "csr_matrix", "csc_array", "csr_array"):
            return Record
        if package == "chumpy":
            return Record
        if module in ("copy_reg", "copyreg") and name == "_reconstructor":
            return _Call(_reconstructor)
        if module in ("__builtin__", "builtins") and name in ("object", "set"):
            return Record if name == "object" else set
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("_codecs", "encode"):  # how Python 3 writes bytes into old protocols
            return _Call(_encode)
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which a body model has no need of")


def read_pickle(path: Path, *, max_bytes: int) -> dict[str, Any]:
    """The dictionary in a pickle: numbers, strings, containers, arrays, and :class:`Record` for what was an object.

    Raises:
        MeshFileError: not a pickle of a dictionary, truncated, larger than ``max_bytes``, or with a name not allowed.
    """
    size = path.stat().st_size
    if size > max_bytes:
        raise MeshFileError(f"{path}: {size:,} bytes, more than the {max_bytes:,} allowed (max_bytes)")
    try:
        with path.open("rb") as stream:
            content = _Restricted(stream, encoding="latin1").load()
        content = _plain(content)
    except Exception as error:  # a damaged pickle can raise anything
        raise MeshFileError(f"{path}: not a readable pickle of arrays ({type(error).__name__}: {error})") from error
    if not isinstance(content, dict):
        raise MeshFileError(f"{path}: a pickled dictionary was expected, this is a {type(content).__name__}")
    return content


def _plain(value: Any, depth: int = 2) -> Any:
    """Arrays instead of stand-ins: in the dictionary, in the lists in it, and in the states of its records.

    No deeper: a pickle may hold one container many times over, and copies of copies would grow without bound.
    """
    if isinstance(value, Array):
        return value.value
    if depth and isinstance(value, dict):
        return {key: _plain(entry, depth - 1) for key, entry in value.items()}
    if depth and isinstance(value, list | tuple):
        return [_plain(entry, depth - 1) for entry in value]
    if depth and isinstance(value, Record):
        value.state = _plain(value.state, 1)
    return value


def _text(value: Any) -> str:
    return value.decode("latin1") if isinstance(value, bytes) else str(value)


def _scalar(dtype: Any, raw: Any) -> Any:
    if not isinstance(dtype, _DType):
        raise pickle.UnpicklingError("a scalar is not a number")
    return np.frombuffer(_encode(raw) if isinstance(raw, str) else raw, dtype.dtype)[0]


def _frombuffer(raw: Any, dtype: Any, shape: Any, order: Any) -> Array:
    array = Array()
    array.__setstate__((1, shape, dtype, order == "F", bytes(raw)))
    return array


def _encode(text: Any, encoding: str = "latin1") -> bytes:
    if encoding != "latin1" or not isinstance(text, str):
        raise pickle.UnpicklingError(f"bytes are encoded in latin1, not {encoding!r}")
    return text.encode("latin1")


def _reconstructor(cls: Any, *_: Any) -> Any:
    if cls not in (Record, Array):
        raise pickle.UnpicklingError("an object of a class that is not known")
    return cls()
