"""Files that appear whole or not at all: written beside their place, moved there when complete."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazyem.errors import UsageError

TEMPORARY_PREFIX = ".crazyem-"  # of the name of a file that is not complete; a process that is killed leaves one behind


@contextlib.contextmanager
def new_file(path: Path, *, force: bool = False) -> Iterator[Path]:
    """A temporary file that becomes `path` when the block ends well, and vanishes when it does not.

    Raises: UsageError if `path` exists and not `force`, or it cannot be written.
    """
    try:
        if path.is_dir():
            raise UsageError(f"{path} is a directory.")
        if not force and path.exists():
            raise UsageError(f"{path} exists already (--force replaces it).")
        handle, name = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, suffix=path.suffix, dir=path.parent)
        os.close(handle)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}.") from None
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())  # on the disk before it takes the place of another file
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror or error}.") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: str | Path, content: str | bytes) -> None:
    """A whole file in place of one that may exist. Raises UsageError if it cannot be written."""
    with new_file(Path(path), force=True) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
