"""TOML files of users: read within a limit and parsed, each fault one sentence that names the file."""

import tomllib
from pathlib import Path
from typing import Any

from crazyem.errors import FileFormatError, UsageError

LARGEST_TOML_FILE = 1 << 20  # bytes; a vehicle has 1 kB, a swarm of a hundred drones 20


def parse_toml(source: str, *, where: str) -> dict[str, Any]:
    """The tables of a text; `where` names the text in errors.

    Raises:
        FileFormatError: it is not TOML, is nested too deeply, or holds a number with thousands of digits.
    """
    try:
        return tomllib.loads(source)
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError is a ValueError
        raise FileFormatError(f"{where}: not valid TOML: {error}.") from None


def read_text(path: str | Path, *, what: str, largest: int = LARGEST_TOML_FILE) -> str:
    """The text of a small file of the user's.

    Args:
        what: what the file should be, for sentences: "vehicle file".
        largest: bytes.

    Raises:
        UsageError: the file cannot be read. FileFormatError: it is larger than `largest`, or not UTF-8.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(largest + 1)
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise UsageError(f"cannot read the {what} {path}: {why}.") from None
    if len(data) > largest:
        raise FileFormatError(f"{path}: not a {what}: larger than {largest} bytes.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: not a {what}: not UTF-8 at byte {error.start}.") from None


def read_toml(path: str | Path, *, what: str, largest: int = LARGEST_TOML_FILE) -> dict[str, Any]:
    """The tables of a file. Raises as `read_text` and `parse_toml`."""
    return parse_toml(read_text(path, what=what, largest=largest), where=str(path))
