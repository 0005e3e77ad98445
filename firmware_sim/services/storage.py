"""What survives a reboot: the values that a client has stored of persistent parameters (the drone's EEPROM).

In memory, or in a JSON file {"group.name": value} that the next simulator reads.
"""

import json
import math
from pathlib import Path

from firmware_sim.errors import ServerError


class Storage:
    """Stored parameters, name -> value in the firmware's unit; written to `path` at every change if there is one.

    Raises ServerError in one sentence where the file cannot be read or written, or holds something else.
    """

    def __init__(self, path: Path | None = None):
        self._path = path
        self.values: dict[str, float] = self._read(path) if path is not None and path.exists() else {}
        if path is not None:
            self._write()  # a folder that is not there is told now, not in flight

    @staticmethod
    def _read(path: Path) -> dict[str, float]:
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ServerError(f"cannot read the stored parameters in {path}: {error}") from None
        numbers = isinstance(content, dict) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in content.values()
        )
        if not numbers:
            raise ServerError(f"{path} holds no stored parameters: expected a JSON object of names and numbers")
        return {name: float(value) for name, value in content.items()}

    def _write(self) -> None:
        if self._path is None:
            return
        try:
            self._path.write_text(json.dumps(self.values, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise ServerError(f"cannot write the stored parameters to {self._path}: {error.strerror}") from None

    def store(self, name: str, value: float) -> None:
        """Keep a value for the next boot."""
        self.values[name] = value
        self._write()

    def remove(self, name: str) -> None:
        """Forget a stored value."""
        self.values.pop(name, None)
        self._write()

    def clear(self) -> None:
        """Forget all."""
        self.values.clear()
        self._write()
