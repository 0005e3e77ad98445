"""TOML with comments and order kept, by tomlkit. A path is keys of tables and indices of arrays."""

from typing import Any

from crazyem.errors import FileFormatError
from crazyem.extras import require
from crazyem.simulators.documents.spliced import Path, as_number, number_text


class TomlDocument:
    """A TOML file. Raises FileFormatError if it is none, MissingExtraError without tomlkit."""

    def __init__(self, text: str, where: str) -> None:
        tomlkit = require("tomlkit", "A simulator's TOML file")
        self.where = where
        try:
            self._document: Any = tomlkit.parse(text)
        except (tomlkit.exceptions.TOMLKitError, ValueError) as error:
            raise FileFormatError(f"{where}: not valid TOML: {error}") from None

    @property
    def text(self) -> str:
        """The text with all edits."""
        return str(self._document.as_string())

    def keys(self, path: Path) -> list[str]:
        """Keys of the table at a path."""
        found = self._at(path)
        return list(found) if hasattr(found, "keys") else []

    def get(self, path: Path) -> float | None:
        """The number at a path; None if there is none."""
        return as_number(self._at(path), self.where)

    def put(self, path: Path, value: float) -> bool:
        """Let a number stand at a path; False if there is no such place. A missing key is added to its table."""
        holder = self._at(path[:-1])
        if holder is None or isinstance(holder, int | float | str):
            return False
        if isinstance(path[-1], int) and path[-1] >= len(holder):
            return False
        holder[path[-1]] = float(number_text(value))
        return True

    def _at(self, path: Path) -> Any:
        found: Any = self._document
        for step in path:
            try:
                found = found[step]
            except (KeyError, IndexError, TypeError):
                return None
        return found
