"""The description of a recording as JSON, and back: what an exported table needs beside its numbers to be one again."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from crazyem.recordings.columns import Description, SignalEntry
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.recording import Event

DESCRIPTION_VERSION = 1


def to_json(description: Description) -> dict[str, Any]:
    """For `json.dumps(..., allow_nan=False)`."""
    return {
        "version": DESCRIPTION_VERSION,
        "source": description.source,
        "origin_s": _plain(float(description.origin)),
        "signals": [
            {
                "name": entry.name,
                "components": list(entry.parts),
                "quantity": entry.quantity,
                "unit": entry.unit,
                "frame": entry.frame,
                "clock": entry.clock,
                "stream": entry.stream,
                "source": list(entry.source),
                "marked": entry.marked,
            }
            for entry in description.entries
        ],
        "metadata": _plain(description.metadata or {}),
        "findings": [_finding(f) for f in description.findings],
        "events": [
            {"time_s": _plain(float(e.time)), "kind": e.kind, "data": _plain(e.data)} for e in description.events
        ],
    }


def from_json(table: Any) -> Description:
    """Inverse of `to_json`. Raises ValueError saying what does not fit."""
    _expect(isinstance(table, dict) and table.get("version") == DESCRIPTION_VERSION, "its version is not known here")
    return Description(
        _text(table, "source"),
        tuple(_entry(e) for e in _list(table, "signals")),
        _number(table, "origin_s"),
        _sections(table.get("metadata", {})),
        tuple(_finding_of(f) for f in _list(table, "findings")),
        tuple(_event(e) for e in _list(table, "events")),
    )


def _plain(value: Any) -> Any:
    """Only what JSON knows; numbers that are none become {"number": "nan"}."""
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
    fix = finding.fix
    return {
        "check": finding.check,
        "grade": str(finding.grade),
        "text": finding.text,
        "signal": finding.signal,
        "intervals": _plain([[float(a), float(b)] for a, b in finding.intervals]),
        "evidence": _plain({k: float(v) for k, v in finding.evidence.items()}),
        "advice": finding.advice,
        "fix": None
        if fix is None
        else {
            "kind": fix.kind,
            "signals": list(fix.signals),
            "factor": _plain([float(f) for f in fix.factor]),
            "rows": None if fix.rows is None else [int(r) for r in fix.rows],
        },
    }


def _finding_of(table: Any) -> Finding:
    fix = table.get("fix") if isinstance(table, dict) else None
    intervals = [_back(pair) for pair in _list(table, "intervals")]
    _expect(all(isinstance(p, list) and len(p) == 2 for p in intervals), "an interval is not two numbers")
    evidence = _back(table.get("evidence", {}))
    _expect(isinstance(evidence, dict), "the evidence of a finding is not a table")
    _expect(_text(table, "grade") in set(Grade), "a finding has an unknown grade")
    return Finding(
        _text(table, "check"),
        Grade(_text(table, "grade")),
        _text(table, "text"),
        _text(table, "signal"),
        tuple((_float(a), _float(b)) for a, b in intervals),
        {str(k): _float(v) for k, v in evidence.items()},
        _text(table, "advice"),
        None if fix is None else _fix(fix),
    )


def _fix(table: Any) -> Fix:
    rows = table.get("rows") if isinstance(table, dict) else None
    _expect(
        rows is None or (isinstance(rows, list) and all(type(r) is int and abs(r) < 2**62 for r in rows)),
        "the rows of a fix are not whole numbers",
    )
    return Fix(
        _text(table, "kind"),
        tuple(str(s) for s in _list(table, "signals")),
        tuple(_float(_back(f)) for f in _list(table, "factor")),
        None if rows is None else np.array(rows, np.int64),
    )


def _event(table: Any) -> Event:
    data = table.get("data") if isinstance(table, dict) else None
    _expect(isinstance(data, dict), "an event has no data")
    assert isinstance(data, dict)
    data = {k: _back(v) for k, v in data.items()}
    return Event(_number(table, "time_s"), _text(table, "kind"), data)


def _entry(table: Any) -> SignalEntry:
    parts = tuple(_list(table, "components"))
    _expect(bool(parts) and all(isinstance(p, str) for p in parts), "a signal has no components")
    source = tuple(_list(table, "source"))
    _expect(all(isinstance(s, str) for s in source), "the source of a signal is not a list of names")
    return SignalEntry(
        _text(table, "name"),
        parts,
        _text(table, "quantity"),
        _text(table, "unit"),
        _text(table, "frame"),
        _text(table, "clock"),
        _text(table, "stream"),
        source,
        table.get("marked") is True,
    )


def _sections(table: Any) -> dict[str, dict[str, str]]:
    _expect(isinstance(table, dict) and all(isinstance(v, dict) for v in table.values()), "its metadata is no table")
    return {name: {key: str(value) for key, value in section.items()} for name, section in table.items()}


def _text(table: Any, key: str) -> str:
    value = table.get(key) if isinstance(table, dict) else None
    _expect(isinstance(value, str), f'"{key}" is not a text')
    return str(value)


def _list(table: Any, key: str) -> list[Any]:
    value = table.get(key) if isinstance(table, dict) else None
    _expect(isinstance(value, list), f'"{key}" is not a list')
    assert isinstance(value, list)
    return value


def _number(table: Any, key: str) -> float:
    return _float(_back(table.get(key)) if isinstance(table, dict) else None)


def _float(value: Any) -> float:
    _expect(isinstance(value, int | float) and not isinstance(value, bool), "a number is not one")
    return float(value)


def _expect(sound: bool, why: str) -> None:
    if not sound:
        raise ValueError(why)
