"""Read users' TOML files with a size limit, and write TOML. Each error is one sentence that names the file."""

import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

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
    """The text of a small file of the user.

    Args:
        what: kind of the file, for messages: "vehicle file".
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


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value of a file is a number other than NaN; true and false are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def toml_text(table: Mapping[str, Any], *, name: str = "") -> str:
    """The text of a table; reading it back gives the same. Entries that are None are left out.

    Args:
        table: text, numbers, true and false, lists of them, and further tables.
        name: of the table, for its header.
    """
    lines = [
        f"{toml_key(key)} = {toml_value(value)}"
        for key, value in table.items()
        if value is not None and not isinstance(value, Mapping)
    ]
    if name and (lines or not table):
        lines = ["", f"[{name}]", *lines]
    text = "".join(f"{line}\n" for line in lines)
    for key, value in table.items():
        if isinstance(value, Mapping):
            text += toml_text(value, name=f"{name}.{toml_key(key)}" if name else toml_key(key))
    return text


def toml_key(key: str) -> str:
    """A key, in quotes where it needs them."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: Any) -> str:
    """A value as TOML; a list of lists has a line for each."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if ord(c) >= 32 and ord(c) != 127 else f"\\u{ord(c):04x}" for c in escaped) + '"'
    if isinstance(value, list | tuple):
        if value and isinstance(value[0], list | tuple):
            return "[\n" + "".join(f"  {toml_value(row)},\n" for row in value) + "]"
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return repr(value)
