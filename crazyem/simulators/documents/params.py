"""PX4 parameters: `param set-default NAME VALUE` of an airframe script, or a ground station's table of parameters."""

import re

from crazyem.simulators.documents.spliced import Path, Spliced, as_number, number_text

_LINE = re.compile(
    r"^(?P<head>\s*param\s+set(?:-default)?\s+|\d+\t\d+\t)(?P<name>[A-Z][A-Z0-9_]*)(?P<gap>[ \t]+)(?P<value>[^\s#]+)",
    re.MULTILINE,
)


class ParamDocument(Spliced):
    """A file of parameters; a path is one name. Of a name that is set twice the last counts, as in a script."""

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text, where)
        self._text = text
        self._found = {m["name"]: m for m in _LINE.finditer(text)}

    def names(self) -> list[str]:
        """Of all parameters."""
        return list(self._found)

    def get(self, path: Path) -> float | None:
        """The number of a parameter; None if it is not set."""
        found = self._found.get(path[0])
        return None if found is None else as_number(found["value"], self.where)

    def put(self, path: Path, value: float) -> bool:
        """Set a parameter; one that is missing is set after the last one."""
        found = self._found.get(path[0])
        if found is not None:
            self._place(self._span(found.start("value"), found.end("value")), number_text(value))
            return True
        last = next(reversed(self._found.values()), None)
        if last is None:
            return False
        end = self._text.find("\n", last.end())
        span = self._span(*((len(self._text),) * 2 if end < 0 else (end, end)))
        kind = "\t9" if last["head"][0].isdigit() else ""  # a ground station's code for a float
        present = self._edits.get(span, b"").decode()
        self._place(span, f"{present}\n{last['head']}{path[0]}{last['gap']}{number_text(value)}{kind}")
        return True

    def _span(self, start: int, end: int) -> tuple[int, int]:
        return len(self._text[:start].encode()), len(self._text[:end].encode())
