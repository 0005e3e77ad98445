"""Faults from a TOML file: a `[[fault]]` table each, keys as the fields of `faults.Fault`."""

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any

from firmware_sim.relay.faults import Fault
from firmware_sim.relay.kinds import RelayError

LARGEST_FILE = 1 << 20  # bytes
MOST_FAULTS = 1000
_INTEGER_KEYS = {"skip", "count", "distance", "bits", "copies"}
_RENAMED = {"from": "start", "until": "end"}  # names in the file; `from` cannot be a field in Python


def load_schedule(path: Path) -> tuple[list[Fault], int | None]:
    """The faults of a file, in its order, and its `seed` if it has one.

    Raises: RelayError naming the file and the error.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise RelayError(f"{path} is larger than {LARGEST_FILE} bytes: no schedule")
        table = tomllib.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise RelayError(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RelayError(f"{path} is no TOML file: {error}") from None
    unknown = sorted(set(table) - {"seed", "fault"})
    if unknown:
        raise RelayError(f'{path}: unknown key "{unknown[0]}" (a schedule has seed and [[fault]])')
    seed = table.get("seed")
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise RelayError(f"{path}: seed must be a whole number, not negative")
    faults = table.get("fault", [])
    if not isinstance(faults, list) or not all(isinstance(f, dict) for f in faults) or len(faults) > MOST_FAULTS:
        raise RelayError(f"{path}: faults are [[fault]] tables, at most {MOST_FAULTS}")
    return [_fault(entry, f"{path}: fault {i + 1}") for i, entry in enumerate(faults)], seed


def _fault(entry: dict[str, Any], where: str) -> Fault:
    types = {f.name: f.type for f in dataclasses.fields(Fault)}
    values: dict[str, Any] = {}
    for key, value in entry.items():
        name = _RENAMED.get(key, key)
        if name not in types or key in _RENAMED.values():
            raise RelayError(f'{where}: unknown key "{key}"')
        if name == "kinds":
            words = [value] if isinstance(value, str) else value
            if not isinstance(words, list) or not all(isinstance(w, str) for w in words):
                raise RelayError(f"{where}: kinds must be a list of names")
            values[name] = frozenset(words)
        elif types[name] in (str, "str"):
            if not isinstance(value, str):
                raise RelayError(f"{where}: {key} must be a word")
            values[name] = value
        else:
            wanted = (int,) if name in _INTEGER_KEYS else (int, float)
            if isinstance(value, bool) or not isinstance(value, wanted) or math.isnan(value):
                raise RelayError(f"{where}: {key} must be a {'whole ' if name in _INTEGER_KEYS else ''}number")
            values[name] = value
    if "what" not in values:
        raise RelayError(f'{where}: "what" is missing')
    try:
        return Fault(**values)
    except RelayError as error:
        raise RelayError(f"{where}: {error}") from None
