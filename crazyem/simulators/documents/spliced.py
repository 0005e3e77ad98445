"""What all documents share: a text, numbers that are found by a path, and edits that touch nothing else."""

from typing import Any

from crazyem.errors import FileFormatError

Path = tuple[Any, ...]  # keys and indices, from the top of the file to one number
LARGEST = 10_000_000  # characters of a file of constants


def number_text(value: float) -> str:
    """A number as files have it: twelve digits, which is more than anybody measures, and no noise of arithmetic."""
    return repr(float(f"{value:.12g}"))


def as_number(text: Any, where: str) -> float | None:
    """The number that a text holds; None if it is no number."""
    if isinstance(text, bool) or text is None:
        return None
    try:
        return float(text)
    except (TypeError, ValueError):
        return None


class Spliced:
    """A text with places of numbers, and what shall stand there.

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
        """Let `text` stand where bytes start to end stand now; a span of no length inserts."""
        self._edits[span] = text.encode()

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
