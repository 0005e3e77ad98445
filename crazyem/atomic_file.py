"""Atomic writing of files: write a temporary file in the same folder, rename it when complete."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazyem.errors import UsageError


@contextlib.contextmanager
def new_file(path: Path, *, force: bool = False) -> Iterator[Path]:
    """A temporary file that is renamed to `path` at the end of the block, or deleted if the block raises.

    Raises: UsageError if `path` exists and not `force`, or `path` cannot be written.
    """
    try:
        if path.is_dir():
            raise UsageError(f"{path} is a directory.")
        if not force and path.exists():
            raise UsageError(f"{path} exists already (--force replaces it).")
        handle, name = tempfile.mkstemp(prefix=".crazyem-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}.") from None
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())  # on the disk before it replaces another file
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror or error}.") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: str | Path, content: str | bytes) -> None:
    """Write a file atomically; an existing file is replaced. Raises UsageError if it cannot be written."""
    with new_file(Path(path), force=True) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
