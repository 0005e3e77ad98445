"""The description of a recording as JSON, and back: all that a reader needs beside the numbers of an exported table."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.columns import Description, SignalEntry
from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Event

_LARGEST_ROW = 2**62


class _Event(msgspec.Struct, rename={"time": "time_s"}):
    """An `Event` in the file."""

    time: float
    kind: str
    data: dict[str, Any]


class _File(msgspec.Struct):
    """A `Description` in the file; missing keys and other types are refused."""

    version: Literal[1]
    source: str
    origin_s: float
    signals: tuple[SignalEntry, ...]
    findings: tuple[Finding, ...]
    events: tuple[_Event, ...]
    metadata: dict[str, dict[str, Any]] = {}


def to_json(description: Description) -> dict[str, Any]:
    """For `json.dumps(..., allow_nan=False)`."""
    return {
        "version": 1,
        "source": description.source,
        "origin_s": _plain(float(description.origin)),
        "signals": msgspec.to_builtins(description.entries),
        "metadata": _plain(description.metadata or {}),
        "findings": [_plain(_finding(f)) for f in description.findings],
        "events": [_plain({"time_s": float(e.time), "kind": e.kind, "data": e.data}) for e in description.events],
    }


def from_json(table: Any) -> Description:
    """Inverse of `to_json`. Raises ValueError with the reason."""
    if not isinstance(table, dict):
        raise ValueError("it is no table")
    table = {key: value if key == "metadata" else _back(value) for key, value in table.items()}
    file = msgspec.convert(table, _File, dec_hook=_rows)
    return Description(
        file.source,
        file.signals,
        file.origin_s,
        {name: {key: str(value) for key, value in section.items()} for name, section in file.metadata.items()},
        file.findings,
        tuple(Event(event.time, event.kind, event.data) for event in file.events),
    )


def _plain(value: Any) -> Any:
    """The value in types of JSON; NaN becomes {"number": "nan"}, infinities likewise."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": repr(value)}
    if isinstance(value, bytes):
        return {"bytes": value.hex()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _back(value: Any) -> Any:
    if isinstance(value, list):
        return [_back(v) for v in value]
    if not isinstance(value, dict):
        return value
    if set(value) == {"number"} and value["number"] in ("nan", "inf", "-inf"):
        return float(value["number"])
    if set(value) == {"bytes"} and isinstance(value["bytes"], str):
        return bytes.fromhex(value["bytes"])
    return {k: _back(v) for k, v in value.items()}


def _finding(finding: Finding) -> dict[str, Any]:
    table = finding.to_dict()
    if finding.fix is not None and finding.fix.rows is not None:
        table["fix"]["rows"] = finding.fix.rows.tolist()
    return table


def _rows(kind: type, value: Any) -> NDArray[np.int64]:
    """Rows of a fix: the only numpy array in a finding."""
    rows = msgspec.convert(value, list[Annotated[int, msgspec.Meta(ge=0, le=_LARGEST_ROW)]])
    return np.array(rows, np.int64)
