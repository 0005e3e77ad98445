"""The files of a study: which folder a file is in decides whether the diagnosing process may get the file."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FLIGHTS = ("recording", "held_out")


@dataclass(frozen=True)
class Study:
    """The diagnosing process gets files of OUT/cases and none of OUT/truth.

    If it gets one flight `alone`, its answers are in OUT/alone instead of OUT/answers.
    """

    folder: Path
    alone: bool = False

    def truth(self, case: str) -> Path:
        return self.folder / "truth" / f"{case}.json"

    def scenario(self, case: str) -> Path:
        return self.folder / "truth" / f"{case}.toml"

    def recording(self, case: str, flight: str) -> Path:
        """The file of a flight, "recording" or "held_out"; a table (.csv) with a mapping beside it if there is one."""
        table = self.folder / "cases" / case / f"{flight}.csv"
        return table if table.is_file() else table.with_suffix(".mcap")

    def mapping(self, case: str) -> Path | None:
        """The mapping of the case's tables; None without tables."""
        file = self.folder / "cases" / case / "mapping.toml"
        return file if file.is_file() else None

    def vehicle(self, case: str) -> Path:
        """The vehicle file of a case of a drawn world, given to the diagnosis."""
        return self.folder / "vehicles" / f"{case}.toml"

    @property
    def given(self) -> tuple[str, ...]:
        """The flights that the diagnosing process gets."""
        return ("recording",) if self.alone else ("recording", "held_out")

    def answer(self, case: str) -> Path:
        return self._answers / f"{case}.json"

    def fitted(self, case: str) -> Path:
        return self._answers / f"{case}.toml"

    @property
    def _answers(self) -> Path:
        return self.folder / ("alone" if self.alone else "answers")

    def cases(self) -> list[str]:
        return sorted(p.stem for p in (self.folder / "truth").glob("[0-9]*.json"))


def read(path: Path) -> Any:
    """The content of a JSON file; None if missing."""
    return json.loads(path.read_text()) if path.is_file() else None


def write(path: Path, document: Any) -> None:
    """Write a JSON file completely or not at all, so that an interrupted study can go on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(document, indent=1) + "\n")
    os.replace(part, path)
