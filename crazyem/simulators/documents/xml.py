"""XML as editable document: URDF, MJCF, SDF. A path is element steps, then "@attribute" or "#", then maybe an index.

An element step is `tag`, `tag[2]` (the third of that tag) or `tag[name=x]`. "#" is the text of an element. An index
chooses one of several numbers in a text: `("link[name=base_link]", "inertial", "origin", "@xyz", 0)`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

from crazyem.errors import FileFormatError
from crazyem.simulators.documents.spliced import Path, Spliced, as_number, number_text

_TAG = re.compile(rb"""<[^>"']*(?:"[^"]*"[^>"']*|'[^']*'[^>"']*)*>""")
_ATTRIBUTE = re.compile(rb"""([\w:.\-]+)\s*=\s*("[^"]*"|'[^']*')""")
_STEP = re.compile(r"([^\[]+)(?:\[(?:(\d+)|name=([^\]]*))\])?$")


@dataclass
class Element:
    """An element: its attributes as (value, start, end), its text likewise, and where it starts and ends [bytes]."""

    tag: str
    attributes: dict[str, tuple[str, int, int]]
    start: int
    inside: int
    end: int = 0
    last: int = 0
    children: list["Element"] = field(default_factory=list)

    def all(self, tag: str) -> list["Element"]:
        """Children of a tag."""
        return [c for c in self.children if c.tag == tag]

    def name(self) -> str:
        """Its `name`."""
        return self.attributes.get("name", ("", 0, 0))[0]


class XmlDocument(Spliced):
    """An XML file. Raises FileFormatError if it is none."""

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text, where)
        self._open: list[Element] = [Element("", {}, 0, 0)]
        parser = expat.ParserCreate()
        parser.StartElementHandler = lambda tag, _: self._begun(tag, parser.CurrentByteIndex)
        parser.EndElementHandler = lambda _: self._ended(parser.CurrentByteIndex)
        parser.EntityDeclHandler = self._entity
        try:
            parser.Parse(self._data, True)
        except expat.ExpatError as error:
            raise FileFormatError(f"{where}: not valid XML: {error}") from None
        self.root = self._open[0].children[0]

    def _entity(self, *_: Any) -> None:
        raise FileFormatError(f"{self.where}: XML with entities of its own is not read")

    def _begun(self, tag: str, at: int) -> None:
        found = _TAG.match(self._data, at)
        if found is None:
            raise FileFormatError(f"{self.where}: element <{tag}> cannot be read")
        attributes = {
            m[1].decode(): (m[2][1:-1].decode(), at + m.start(2) + 1, at + m.end(2) - 1)
            for m in _ATTRIBUTE.finditer(found[0])
        }
        element = Element(tag, attributes, at, found.end())
        self._open[-1].children.append(element)
        self._open.append(element)

    def _ended(self, at: int) -> None:
        element = self._open.pop()
        element.end = max(at, element.inside)
        closing = _TAG.match(self._data, at) if at >= element.inside else None
        element.last = closing.end() if closing else element.inside

    def find(self, path: Path) -> Element | None:
        """The element of a path of steps below the root; None if there is none."""
        element = self.root
        for step in path:
            tag, index, name = _STEP.match(step).groups()  # type: ignore[union-attr]
            found = element.all(tag)
            if name is not None:
                found = [c for c in found if c.name() == name]
            if int(index or 0) >= len(found):
                return None
            element = found[int(index or 0)]
        return element

    def all(self, path: Path, tag: str) -> list[Element]:
        """Children of a tag of the element of a path; none if there is no such element."""
        element = self.find(path)
        return [] if element is None else element.all(tag)

    def inner(self, element: Element) -> str:
        """The text of an element, as it was read."""
        return self._data[element.inside : element.end].decode()

    def words(self, path: Path) -> tuple[list[str], int, int] | None:
        """The words of an attribute or text, and its start and end."""
        index = next(k for k, step in enumerate(path) if str(step)[0] in "@#")
        element = self.find(path[:index])
        if element is None:
            return None
        if path[index] != "#":
            found = element.attributes.get(path[index][1:])
            return None if found is None else (found[0].split(), found[1], found[2])
        return self.inner(element).split(), element.inside, element.end

    def get(self, path: Path) -> float | None:
        """The number at a path; None if there is none."""
        found = self.words(path)
        at = path[-1] if isinstance(path[-1], int) else 0
        return None if found is None or at >= len(found[0]) else as_number(found[0][at])

    def put(self, path: Path, value: float) -> None:
        """Write a number at a path, if there is such a place. A missing element is added to its parent."""
        found = self.words(path)
        at = path[-1] if isinstance(path[-1], int) else 0
        if found is None:
            self._add(path, number_text(value))
            return
        words, start, end = found
        if at >= len(words):
            return
        now = self._edits.get((start, end), self._data[start:end]).decode()
        spans = [m.span() for m in re.finditer(r"\S+", now)]
        self._place((start, end), now[: spans[at][0]] + number_text(value) + now[spans[at][1] :])

    def put_vector(self, path: Path, values: Sequence[float]) -> None:
        """Write numbers into an attribute or text; a missing one is added."""
        found, text = self.words(path), " ".join(map(number_text, values))
        if found is None:
            self._add(path, text)
        else:
            self._place((found[1], found[2]), text)

    def _add(self, path: Path, text: str) -> None:
        """Add a missing leaf `<tag>value</tag>` as the last child of its parent."""
        if path[-1] != "#" or len(path) < 2:
            return
        parent = self.find(path[:-2])
        if parent is None or not parent.children:
            return
        sibling = parent.children[-1]
        before = self._data[: sibling.start].decode()
        indent = before[len(before.rstrip(" \t\r\n")) :]
        self._insert(sibling.last, f"{indent}<{path[-2]}>{text}</{path[-2]}>")
