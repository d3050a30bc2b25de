"""Reads arrays out of pickles that nobody vouches for.

A pickle is a program: loading one with :mod:`pickle` runs whatever functions it names. Here every name it may use is
listed, and each stands for something inert of our own; nothing of NumPy, SciPy or chumpy is called while reading. Any
other name ends the reading, before it is looked up. What is read stays in proportion to the file: the opcodes are
looked over before any is carried out, and what copies has a budget.
"""

from __future__ import annotations

import mmap
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from meshkit.io import MeshFileError

__all__: list[str] = []

_KINDS = "biuf"  # booleans, integers and floats; no objects, no records
_DEEPEST = 100  # tuples within tuples: hashing them recurses


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
        text = _text(code)
        self.dtype = np.dtype(text)
        if self.dtype.kind not in _KINDS:
            raise pickle.UnpicklingError(f"arrays of {text!r} are not read, only of numbers")

    def __setstate__(self, state: Any) -> None:
        order = _text(state[1])
        self.dtype = self.dtype.newbyteorder("<" if order == "<" else ">" if order == ">" else "=")


class Array:
    """A pickled NumPy array in the making; its buffer is in the file, so its size is bounded by the file's."""

    parts: tuple[Any, np.dtype, bool, bytes | bytearray | str]

    def __new__(cls, *_: Any) -> Array:
        self = super().__new__(cls)
        self.parts = ((0,), np.dtype(float), False, b"")
        return self

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, raw = state
        if not isinstance(dtype, _DType) or not isinstance(raw, bytes | bytearray | str):
            raise pickle.UnpicklingError("an array is not a plain buffer of numbers")
        if not isinstance(shape, tuple) or not all(isinstance(n, int) for n in shape):
            raise pickle.UnpicklingError("the shape of an array is not a tuple of integers")
        self.parts = (shape, dtype.dtype, bool(fortran), raw)

    def value(self, done: dict[tuple[int, int], tuple[Any, Any]]) -> np.ndarray:
        """The array; text that several arrays share is encoded once."""
        shape, dtype, fortran, raw = self.parts
        if isinstance(raw, str):
            key = (id(raw), 0)
            if key not in done:
                done[key] = (raw, _latin1(raw))
            raw = done[key][1]
        return np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")


class _Call:
    """One of our functions, as an object of its own for each name in each file, so that no file can alter it."""

    __slots__ = ("function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


class _Restricted(pickle.Unpickler):
    def __init__(self, stream: Any, budget: int) -> None:
        super().__init__(stream, encoding="latin1")
        self._budget = budget  # entries and bytes that may be copied: the file holds each at least once

    def _spend(self, value: Any) -> None:
        self._budget -= len(value)
        if self._budget < 0:
            raise pickle.UnpicklingError("it copies more than there is in the file")

    def _gather(self, kind: Callable[..., Any]) -> Callable[..., Any]:
        def gather(entries: Any = ()) -> Any:
            self._spend(entries)
            return kind(entries)

        return gather

    def _encode(self, text: Any, encoding: str = "latin1") -> bytes:
        if encoding != "latin1" or not isinstance(text, str):
            raise pickle.UnpicklingError("only text is encoded, in latin1")
        self._spend(text)
        return _latin1(text)

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
            return Record if name == "object" else _Call(self._gather(set))
        if (module, name) == ("collections", "OrderedDict"):
            return _Call(self._gather(dict))
        if (module, name) == ("_codecs", "encode"):  # how Python 3 writes bytes into old protocols
            return _Call(self._encode)
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
        # Reading a file makes room for as many bytes as the pickle asks for; a mapping has those there are.
        with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
            _check(mapped)
            mapped.seek(0)
            content = _Restricted(mapped, size).load()
        content = _plain(content, {})
    except OSError as error:
        raise MeshFileError(f"{path}: it cannot be read ({error.strerror or error})") from error
    except Exception as error:  # a damaged pickle can raise anything
        raise MeshFileError(f"{path}: not a readable pickle of arrays ({type(error).__name__}: {error})") from error
    if not isinstance(content, dict):
        raise MeshFileError(f"{path}: a pickled dictionary was expected, this is a {type(content).__name__}")
    return content


def _check(stream: Any) -> None:
    """Look over the opcodes: no memo slot beyond their number, as room is made up to it, and no deep tuples."""
    stack: list[int | None] = []  # how deep the tuples on the stack are, and None for a mark
    memo: dict[int, int] = {}
    for number, (opcode, argument, _) in enumerate(pickletools.genops(stream), 1):
        name = opcode.name
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            slot = len(memo) if name == "MEMOIZE" else int(str(argument))
            if slot > number:
                raise pickle.UnpicklingError(f"memo slot {slot} in opcode {number}")
            memo[slot] = (stack[-1] if stack else 0) or 0
            continue
        before, after = opcode.stack_before, opcode.stack_after
        taken: list[int] = []
        if pickletools.markobject in before:
            while stack and (top := stack.pop()) is not None:
                taken.append(top)
            before = before[: before.index(pickletools.markobject)]
        for _ in before:
            taken.append((stack.pop() if stack else 0) or 0)
        if name == "MARK":
            stack.append(None)
            continue
        depth = 0
        if name in ("GET", "BINGET", "LONG_BINGET"):
            depth = memo.get(int(str(argument)), 0)
        elif name == "DUP":
            depth = max(taken)
        elif name in ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"):
            depth = 1 + max(taken, default=0)
            if depth > _DEEPEST:
                raise pickle.UnpicklingError(f"tuples within tuples, more than {_DEEPEST} deep")
        stack += [depth] * len(after)


def _plain(value: Any, done: dict[tuple[int, int], tuple[Any, Any]], depth: int = 2) -> Any:
    """Arrays instead of stand-ins: in the dictionary, in the lists in it, and in the states of its records.

    No deeper, and each but once: a pickle may hold one container many times over, and copies would grow without bound.
    ``done`` has the results by identity and depth, with what they were made of, so that no identity is used again.
    """
    if isinstance(value, Array):
        return value.value(done)
    if not depth or not isinstance(value, dict | list | tuple | Record):
        return value
    key = (id(value), depth)
    if key not in done:
        plain: Any = value
        if isinstance(value, dict):
            plain = {name: _plain(entry, done, depth - 1) for name, entry in value.items()}
        elif isinstance(value, list | tuple):
            plain = [_plain(entry, done, depth - 1) for entry in value]
        done[key] = (value, plain)
        if isinstance(value, Record):
            value.state = _plain(value.state, done, 1)
    return done[key][1]


def _text(value: Any) -> str:
    """The short text of a type or byte order."""
    if not isinstance(value, str | bytes) or len(value) > 4:
        raise pickle.UnpicklingError("the type of an array is not a short text: only numbers are read")
    return value.decode("latin1") if isinstance(value, bytes) else value


def _latin1(text: str) -> bytes:
    return text.encode("latin1")


def _scalar(dtype: Any, raw: Any) -> Any:
    if not isinstance(dtype, _DType) or not isinstance(raw, bytes | str) or len(raw) > 64:
        raise pickle.UnpicklingError("a scalar is not a number")
    return np.frombuffer(_latin1(raw) if isinstance(raw, str) else raw, dtype.dtype)[0]


def _frombuffer(raw: Any, dtype: Any, shape: Any, order: Any) -> Array:
    array = Array()
    array.__setstate__((1, shape, dtype, order == "F", raw))
    return array


def _reconstructor(cls: Any, *_: Any) -> Any:
    if cls not in (Record, Array):
        raise pickle.UnpicklingError("an object of a class that is not known")
    return cls()
