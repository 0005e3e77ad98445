"""TOML by tomlkit and YAML by ruamel.yaml, comments and order kept. A path is keys of tables and indices of lists."""

import re
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.extras import require
from crazyem.simulators.documents.spliced import Path, SplicedText, as_number, number_text


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
        return as_number(self._at(path))

    def put(self, path: Path, value: float) -> None:
        """Write a number at a path, if there is such a place. A missing key is added to its table."""
        holder = self._at(path[:-1])
        if holder is None or isinstance(holder, int | float | str):
            return
        if not isinstance(path[-1], int) or path[-1] < len(holder):
            holder[path[-1]] = float(number_text(value))

    def _at(self, path: Path) -> Any:
        found: Any = self._document
        for step in path:
            try:
                found = found[step]
            except (KeyError, IndexError, TypeError):
                return None
        return found


class YamlDocument(SplicedText):
    """A YAML file. Raises FileFormatError if it is none, MissingExtraError without ruamel.yaml."""

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text, where)
        yaml = require("ruamel.yaml", "A YAML file")
        try:
            self.root: Any = yaml.YAML(typ="safe", pure=True).compose(text)
        except (yaml.error.YAMLError, ValueError, RecursionError) as error:
            line = str(error).splitlines()[0] if str(error) else "no YAML"
            raise FileFormatError(f"{where}: not valid YAML: {line}") from None

    def keys(self, path: Path) -> list[str]:
        """Keys of the mapping at a path."""
        node = self._node(path)
        return [str(k.value) for k, _ in node.value] if node is not None and _is_mapping(node) else []

    def length(self, path: Path) -> int:
        """Number of entries of the list at a path."""
        node = self._node(path)
        return len(node.value) if node is not None and _is_list(node) else 0

    def get(self, path: Path) -> float | None:
        """The number at a path; None if there is none."""
        node = self._node(path)
        return None if node is None or not isinstance(node.value, str) else as_number(node.value)

    def put(self, path: Path, value: float) -> None:
        """Write a number at a path, if there is such a place. A missing key is added to its mapping."""
        node = self._node(path)
        if node is None:
            self._add(path, value)
        elif isinstance(node.value, str):
            self._place((self._at(node.start_mark.index), self._at(node.end_mark.index)), number_text(value))

    def _add(self, path: Path, value: float) -> None:
        known = next(k for k in range(len(path) - 1, -1, -1) if self._node(path[:k]) is not None)
        parent = self._node(path[:known])
        if not _is_mapping(parent) or parent.flow_style or not parent.value:
            return
        key, last = parent.value[-1]
        indent = key.start_mark.column
        end = self._line_end(len(self._text[: last.end_mark.index].rstrip()))
        deeper = path[known:]
        text = "".join(f"\n{' ' * (indent + 2 * k)}{step}:" for k, step in enumerate(deeper)) + f" {number_text(value)}"
        present = self._edits.get((end, end), b"").decode()
        self._place((end, end), _merged(present, text))

    def _node(self, path: Path) -> Any:
        node = self.root
        for step in path:
            if node is None:
                return None
            if isinstance(step, int):
                node = node.value[step] if _is_list(node) and step < len(node.value) else None
            else:
                pairs = node.value if _is_mapping(node) else []
                node = next((v for k, v in pairs if str(k.value) == step), None)
        return node


def _is_mapping(node: Any) -> bool:
    return type(node).__name__ == "MappingNode"


def _is_list(node: Any) -> bool:
    return type(node).__name__ == "SequenceNode"


def _merged(present: str, text: str) -> str:
    """An addition after another one at the same place, without headings that stand there already."""
    lines = text.splitlines()
    for line in lines[:-1]:
        if line and re.search(rf"^{re.escape(line)}$", present, re.MULTILINE):
            text = text.replace(f"\n{line}", "", 1)
    return present + text
