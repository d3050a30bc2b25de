"""Arrays of an ``.npz`` file, with what their headers claim held against the bytes that are there."""

import io
import math
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from meshkit.io._lines import COPY_AGAIN


def read_arrays(
    path: Path, names: Iterable[str], max_bytes: int, *, limit: str = " (max_bytes)"
) -> dict[str, np.ndarray]:
    """Those of the arrays that are in the file; objects are refused, and so is more than ``max_bytes`` in all.

    Args:
        path: the file.
        names: of the arrays, without ``.npy``.
        max_bytes: of all of them, unpacked.
        limit: how a caller can raise ``max_bytes``, for the message.

    Raises:
        ValueError: what is wrong with the file, without its name.
        OSError: it cannot be opened.
    """
    found: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {info.filename: info for info in archive.infolist()}
            wanted = {name: entries[f"{name}.npy"] for name in names if f"{name}.npy" in entries}
            # The sizes of the arrays, not of the compressed file: a small file can unpack to anything.
            if (size := sum(info.file_size for info in wanted.values())) > max_bytes:
                raise ValueError(f"{size:,} bytes, more than the {max_bytes:,} allowed{limit}")
            for name, info in wanted.items():
                with archive.open(info) as stream:
                    found[name] = _read(name, stream.read(info.file_size))
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"damaged or cut short: {str(error) or 'it ends too early'}; {COPY_AGAIN}") from error
    return found


def _read(name: str, data: bytes) -> np.ndarray:
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = header(stream)
    except Exception as error:  # a header is Python text, with as many ways to be wrong
        raise ValueError(f"the header of {name!r} is damaged ({error}); {COPY_AGAIN}") from error
    if dtype.hasobject:
        raise ValueError(f"{name!r} holds objects, not numbers, which are not read: they can run code")
    size, left = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if min(shape, default=0) < 0 or size != left:
        raise ValueError(f"{name!r} of shape {shape} takes {size:,} bytes, {left:,} are there; {COPY_AGAIN}")
    flat = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy()
