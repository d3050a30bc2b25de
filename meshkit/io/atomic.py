"""Files that are replaced as a whole or not at all."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["atomic_write"]


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Replace ``path`` as a whole or not at all: a reader, or a crash half-way, never sees half a file.

    Write to the path that the context yields. It lies in the same folder (made if missing) and has the same suffix, so
    that writers which look at the suffix work; on leaving the context it is renamed over ``path``. An exception removes
    it and leaves ``path`` as it was.

    Args:
        path: the file to write.

    Yields:
        Temporary path to write to.

    Raises:
        OSError: the path is a folder, its parent is a file, or it cannot be written.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with atomic_write(folder / "runs" / "log.txt") as temporary:
        ...     _ = temporary.write_text("done")
        >>> (folder / "runs" / "log.txt").read_text()
        'done'
    """
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "Is a folder, not a file to write", str(target))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(errno.ENOTDIR, "Not a directory", str(target.parent)) from None
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
