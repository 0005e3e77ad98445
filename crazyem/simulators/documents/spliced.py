"""A text whose numbers are found by a path and edited in place, and PX4's parameter files as such a document.

PX4 parameters are `param set-default NAME VALUE` of an airframe script, or a ground station's table of parameters.
"""

import re
from typing import Any

from crazyem.errors import FileFormatError

Path = tuple[Any, ...]  # keys and indices, from the top of the file to one number
LARGEST = 10_000_000  # characters of a file of constants


def number_text(value: float) -> str:
    """A number as text with twelve digits: more than any measurement has, and free of rounding errors."""
    return repr(float(f"{value:.12g}"))


def as_number(text: Any) -> float | None:
    """The number that a text holds; None if it is no number."""
    if isinstance(text, bool) or text is None:
        return None
    try:
        return float(text)
    except (TypeError, ValueError):
        return None


class Spliced:
    """A text with pending edits by byte position.

    Attributes:
        where: the file, for errors.
    """

    def __init__(self, text: str, where: str) -> None:
        if len(text) > LARGEST:
            raise FileFormatError(f"{where}: {len(text)} characters are no file of a drone's constants")
        self.where = where
        self._data = text.encode()
        self._edits: dict[tuple[int, int], bytes] = {}

    def _place(self, span: tuple[int, int], text: str) -> None:
        """Replace the bytes from start to end by `text`; an empty span inserts."""
        self._edits[span] = text.encode()

    def _insert(self, at: int, text: str) -> None:
        """Insert `text` before byte `at`, after earlier insertions at the same place."""
        self._place((at, at), self._edits.get((at, at), b"").decode() + text)

    @property
    def text(self) -> str:
        """The text with all edits."""
        data = self._data
        for (start, end), new in sorted(self._edits.items(), reverse=True):
            data = data[:start] + new + data[end:]
        return data.decode()


def said(path: Path) -> str:
    """A path for people: keys with dots, indices in brackets; attributes and texts of XML as keys."""
    text = ""
    for step in path:
        key = str(step).removeprefix("@").removeprefix("#")
        text += f"[{step}]" if isinstance(step, int) else f".{key}" if text and key else key
    return text


_LINE = re.compile(
    r"^(?P<head>\s*param\s+set(?:-default)?\s+|\d+\t\d+\t)(?P<name>[A-Z][A-Z0-9_]*)(?P<gap>[ \t]+)(?P<value>[^\s#]+)",
    re.MULTILINE,
)


class SplicedText(Spliced):
    """A text whose places are given in characters instead of bytes."""

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text, where)
        self._text = text

    def _at(self, character: int) -> int:
        """The byte at which a character begins."""
        return len(self._text[:character].encode())

    def _line_end(self, character: int) -> int:
        """The byte at which the line of a character ends."""
        end = self._text.find("\n", character)
        return self._at(len(self._text) if end < 0 else end)


class ParamDocument(SplicedText):
    """A parameter file; a path is one name. If a name is set twice, the last value counts, as in a script."""

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text, where)
        self._found = {m["name"]: m for m in _LINE.finditer(text)}

    def get(self, path: Path) -> float | None:
        """The number of a parameter; None if it is not set."""
        found = self._found.get(path[0])
        return None if found is None else as_number(found["value"])

    def put(self, path: Path, value: float) -> None:
        """Set a parameter; one that is missing is set after the last one."""
        found = self._found.get(path[0])
        if found is not None:
            self._place((self._at(found.start("value")), self._at(found.end("value"))), number_text(value))
            return
        last = next(reversed(self._found.values()), None)
        if last is None:
            return
        kind = "\t9" if last["head"][0].isdigit() else ""  # a ground station's code for a float
        text = f"\n{last['head']}{path[0]}{last['gap']}{number_text(value)}{kind}"
        self._insert(self._line_end(last.end()), text)
