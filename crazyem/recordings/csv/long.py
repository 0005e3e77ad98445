"""CSV in long form, one row per variable: raw values of log packets of a Crazyflie."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from crazyem.errors import FileFormatError
from crazyem.links.clock import StampUnwrapper
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.csv.mapping import CsvMapping, SignalColumns
from crazyem.recordings.csv.text import Damage, Header, parse_fields, text_blocks, to_number
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.motor_meaning import decide
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.signals.sample import SIGNALS

_LARGEST_STAMP = 2.0**53  # ms


# (block, variables) -> time, order, host time and values of each packet, in order of arrival
_Packets = dict[tuple[str, tuple[str, ...]], list[tuple[float, int, float, list[float]]]]
# consecutive rows with the same block, stamp and time of arrival: first line; these texts; names and values
_Packet = tuple[int, tuple[str, str, str], list[str], list[float]]


def read_long(path: Path, header: Header, mapping: CsvMapping, options: ReadOptions) -> Recording:
    """Read a CSV in long form. Raises FileFormatError naming the file and what is wrong with it."""
    gone = next((c for c in mapping.columns.values() if c not in header.names), None)
    if gone is not None:
        raise FileFormatError(f"{path}: the column {gone} is missing.")
    damage = Damage()
    found = _collected(path, header, mapping, damage)
    layouts: dict[str, tuple[str, ...]] = {}
    most = {key: len(packets) for key, packets in found.items()}
    for block, names in sorted(found, key=lambda key: -most[key]):
        layouts.setdefault(block, names)
    tables = [_table(block, names, found[block, names]) for block, names in found if layouts[block] == names]
    if not tables:
        raise FileFormatError(f"{path}: there is a header but not a single sample.")
    torn = sum(most.values()) - sum(most[key] for key in layouts.items())
    findings: list[Finding] = damage.findings()
    if torn:
        text = f"{torn} packets were incomplete and were dropped."
        grade = Grade.DEGRADES if 100 * torn > sum(most.values()) else Grade.HARMLESS
        findings.append(note("integrity", text, grade, packets=float(torn)))
    metadata = {
        "csv": {"mapping": mapping.name, "title": mapping.title},
        "blocks": {block: " ".join(names) for block, names in layouts.items()},
    }
    meaning = decide(tables, given=options.motor, metadata=metadata)
    signals = signals_from_tables(tables, motor=meaning.meaning)
    for name, source in mapping.signals.items():
        signals = _with_host_signal(signals, name, source)
    metadata.update(meaning.metadata)
    if mapping.claims:
        metadata["claims"] = dict(mapping.claims)
    return Recording(str(path), f"csv:{mapping.name}", signals, metadata, (*findings, *meaning.findings))


def _collected(path: Path, header: Header, mapping: CsvMapping, damage: Damage) -> _Packets:
    """All packets. Values of the host get the newest firmware stamp before them."""
    host_variables = {name for signal in mapping.signals.values() for name in signal.columns}
    found: _Packets = {}
    unwrapper = StampUnwrapper()
    now = math.nan
    for order, packet in enumerate(_packets(path, header, mapping, damage)):
        line, (host_text, block, stamp_text), names, values = packet
        host_time, stamp = _number_or_none(host_text), _number_or_none(stamp_text)
        if host_time is None:
            damage.drop(line, f'line {line}: "{host_text[:20]}" is not a number')
            continue
        if not host_variables.issuperset(names):
            if stamp is None or not abs(stamp) < _LARGEST_STAMP:
                damage.drop(line, f'line {line}: "{stamp_text[:20]}" is not a firmware stamp')
                damage.check(path)
                continue
            now = unwrapper.unwrap(int(stamp)) / 1000.0
        elif math.isnan(now):
            continue  # no firmware stamp yet, so no time
        found.setdefault((block, tuple(names)), []).append((now, order, host_time, values))
    damage.check(path)
    return found


def _packets(path: Path, header: Header, mapping: CsvMapping, damage: Damage) -> Iterator[_Packet]:
    at = {key: header.names.index(column) for key, column in mapping.columns.items()}
    h, b, s, n, v = (at[key] for key in ("host_time", "block", "stamp_ms", "name", "value"))
    packet: _Packet | None = None
    line = 0
    for block in text_blocks(path, damage):
        for raw in block.split(b"\n")[:-1]:
            line += 1
            if line == 1 or not raw.strip():
                continue
            fields = parse_fields(raw, header.delimiter)
            if len(fields) != len(header.names):
                damage.drop(line, f"line {line} has {len(fields)} fields, the header has {len(header.names)}")
                continue
            value = _number_or_none(fields[v], header.decimal)
            if value is None:
                damage.drop(line, f'line {line}, column {header.names[v]}: "{fields[v][:20]}" is not a number')
                continue
            damage.rows += 1
            key = (fields[h], fields[b], fields[s])
            if packet is not None and packet[1] == key and fields[n] not in packet[2]:
                packet[2].append(fields[n])
                packet[3].append(value)
                continue
            if packet is not None:
                yield packet
            packet = (line, key, [fields[n]], [value])
        damage.check(path)
    if packet is not None:
        yield packet


def _number_or_none(text: str, decimal: str = ".") -> float | None:
    try:
        return to_number(text, decimal)
    except ValueError:
        return None


def _table(block: str, names: tuple[str, ...], packets: list[tuple[float, int, float, list[float]]]) -> Table:
    time, order, host_time, values = zip(*packets, strict=True)
    columns = dict(zip(names, np.array(values, float).T, strict=True))
    return Table(block, columns, np.array(time), np.array(order, np.int64), np.array(host_time))


def _with_host_signal(signals: dict[str, SignalArray], name: str, source: SignalColumns) -> dict[str, SignalArray]:
    """The signals with a host signal joined from its variables, whose own signals it replaces."""
    variables = source.columns
    parts = [next((k for k, a in signals.items() if a.source == (v,) and not a.quantity), None) for v in variables]
    arrays = [signals[key] for key in parts if key is not None]
    if len(arrays) != len(variables) or any(a.time is not arrays[0].time for a in arrays):
        return signals
    value = source.converted(np.column_stack([a.value[:, 0] for a in arrays]))
    unit, frame = SIGNALS[source.quantity][1:]
    whole = replace(arrays[0], value=value, quantity=source.quantity, unit=unit, frame=frame, source=variables)
    rest = {key: array for key, array in signals.items() if key not in parts and key != name}
    return {name: whole, **rest}
