"""Contents of a recording: signals, clocks, origin, extremes of the motion, and what can be identified from it."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from crazyem.doctor.identifiability import Verdict, identifiability, replay_objection
from crazyem.doctor.kinematics import upright
from crazyem.notebook import finite
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.finding import percent
from crazyem.recordings.ordering import Array, sound_rows, sound_signal
from crazyem.recordings.recording import Recording, SignalArray, about
from crazyem.recordings.thrust import kind_objection, vehicle_for, weight_objection
from crazyem.vehicle import Vehicle

SATURATED_DUTY = 0.999  # duty from which a rotor is at its limit
_SPEED_SPAN = 0.1  # s over which position is differenced where there is no velocity
_MOST_ENTRIES = 12  # most entries of a section of metadata in the text
_MOST_FLIGHTS = 4  # most flights in the text
_MOST_SIGNALS = 16  # most signals in the text
_LONGEST_TEXT = 120  # characters of a metadata value that are shown


@dataclass(frozen=True, slots=True)
class Envelope:
    """Extremes of the airborne part; None where a signal is missing. SI, world z up, body FLU."""

    airborne_s: float
    judged_by: tuple[str, ...]
    speed_max_m_s: float | None = None
    speed_rms_m_s: float | None = None
    speed_from: str = ""
    tilt_max_deg: float | None = None
    tilt_from: str = ""
    body_rate_max_rad_s: tuple[float, float, float] | None = None
    altitude_min_m: float | None = None
    altitude_max_m: float | None = None
    vertical_speed_min_m_s: float | None = None
    vertical_speed_max_m_s: float | None = None
    acceleration_max_m_s2: float | None = None
    specific_force_min_m_s2: float | None = None
    specific_force_max_m_s2: float | None = None
    voltage_start_V: float | None = None
    voltage_end_V: float | None = None
    voltage_min_V: float | None = None
    motor_command_max: float | None = None
    motor_saturated_share: float | None = None
    airborne_intervals_s: tuple[tuple[float, float], ...] = ()


def envelope(recording: Recording, air: Airtime) -> Envelope:
    """Extremes of the airborne part, of samples as measured: one outlier is enough to set an extreme."""
    found = _speeds(recording, air)
    for name, extremes in _EXTREMES.items():
        value = _in_the_air(recording, name, air)
        if value is not None and not (name == "euler" and "tilt_from" in found):
            found |= extremes(value)
        del value  # of a long flight, one signal at a time
    return Envelope(air.seconds, air.judged_by, airborne_intervals_s=air.flown, **found)


def _range(key: str, value: Array) -> dict[str, float]:
    return {key.format("min"): float(value.min()), key.format("max"): float(value.max())}


def _tilt(source: str, upright: Array) -> dict[str, Any]:
    """From the cosines (n,) of the tilt."""
    return {"tilt_from": source, "tilt_max_deg": float(np.degrees(np.arccos(np.clip(upright.min(), -1.0, 1.0))))}


# Signal -> extremes of its samples in the air (n, c); Euler angles count where there is no quaternion.
_EXTREMES: dict[str, Callable[[Array], dict[str, Any]]] = {
    "attitude": lambda q: _tilt("attitude", upright(q)),
    "euler": lambda angles: _tilt("euler", np.cos(angles[:, 0]) * np.cos(angles[:, 1])),
    "body_rate": lambda rate: {"body_rate_max_rad_s": tuple(float(r) for r in np.abs(rate).max(axis=0))},
    "position": lambda position: _range("altitude_{}_m", position[:, 2]),
    "acceleration": lambda a: {"acceleration_max_m_s2": float(np.linalg.norm(a, axis=1).max())},
    "specific_force": lambda force: _range("specific_force_{}_m_s2", np.linalg.norm(force, axis=1)),
    "voltage": lambda volts: {
        "voltage_start_V": float(volts[0, 0]),
        "voltage_end_V": float(volts[-1, 0]),
        "voltage_min_V": float(volts.min()),
    },
    "motor_command": lambda duty: {
        "motor_command_max": float(duty.max()),
        "motor_saturated_share": float((duty >= SATURATED_DUTY).any(axis=1).mean()),
    },
}


def _in_the_air(recording: Recording, name: str, air: Airtime) -> Array | None:
    """(n, c) sound samples of a signal in the air, None if there are none."""
    found = sound_signal(recording, name)
    if found is None:
        return None
    value = found[1][air.covers(found[0])]
    return value if value.size else None


def _speeds(recording: Recording, air: Airtime) -> dict[str, Any]:
    """Extremes of the velocity in the air, or of differences of the position."""
    source, velocity = "velocity", _in_the_air(recording, "velocity", air)
    if velocity is None:
        source, velocity = "position", _differences(recording, air)
    if velocity is None:
        return {}
    norm = np.linalg.norm(velocity, axis=1)
    extremes = {"speed_max_m_s": float(norm.max()), "speed_rms_m_s": float(np.sqrt(np.mean(norm**2)))}
    return {"speed_from": source, **extremes, **_range("vertical_speed_{}_m_s", velocity[:, 2])}


def _differences(recording: Recording, air: Airtime) -> Array | None:
    """Velocity (n, 3) [m/s] in the air by differences of the position; None if there are none."""
    found = sound_signal(recording, "position")
    if found is None:
        return None
    time, position = found
    row = np.searchsorted(time, time + _SPEED_SPAN)
    later = np.minimum(row, time.size - 1)
    span = time[later] - time
    whole = (row < time.size) & air.covers(time) & air.covers(time[later]) & (span < 2.0 * _SPEED_SPAN)
    return (position[later] - position)[whole] / span[whole, None] if whole.any() else None


@dataclass(frozen=True, slots=True)
class SignalRow:
    """One signal; what it does not explain is as in `SignalArray`."""

    name: str
    quantity: str
    unit: str
    frame: str
    clock: str
    stream: str
    source: tuple[str, ...]
    samples: int
    start_s: float | None  # first stamp, on the recording's time axis
    end_s: float | None
    rate_hz: float | None  # mean rate, gaps included: (samples - 1) over the time from the first to the last
    period_s: float | None  # median time between samples; its inverse is the rate without losses
    missing_share: float  # share of samples with a component that is not a number in the file
    marked_share: float  # share of samples that the reader marked as not measured
    longest_gap_s: float | None  # longest time between two samples


@dataclass(frozen=True, slots=True)
class ClockRow:
    """One clock."""

    name: str
    signals: int  # number of its signals
    start_s: float  # first stamp
    end_s: float
    # rate over that of the host's clock, less 1, from a line through the arrival times; None without these
    against_host_ppm: float | None


@dataclass(frozen=True, slots=True)
class Inventory:
    """Contents of a recording. `to_dict` is for JSON, `text` is for a terminal."""

    path: str
    source: str
    duration_s: float
    samples: int
    vehicle: str
    signals: tuple[SignalRow, ...]
    clocks: tuple[ClockRow, ...]
    metadata: Mapping[str, Mapping[str, str]]
    events: Mapping[str, int]
    envelope: Envelope
    verdicts: tuple[Verdict, ...]
    kind: str = ""  # of vehicle, from its autopilot; "" if unknown
    other_kind: str = ""  # why the models do not describe this kind of vehicle; "" if they do
    unlike: str = ""  # why the rotors do not fit the vehicle; "" if they do
    on_the_ground: str = ""  # why there was no flight; "" if there was one
    no_replay: str = ""  # why `crazyem replay` cannot use the recording; "" if it can

    def to_dict(self) -> dict[str, Any]:
        """For JSON: units in the names of the keys, None where unknown."""
        objections = {"kind": "other_kind", "weight": "unlike", "flight": "on_the_ground", "replay": "no_replay"}
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in objections.values()}
        values |= {key: [asdict(row) for row in values.pop(key)] for key in ("signals", "clocks")}
        values["identifiable"] = [asdict(verdict) for verdict in values.pop("verdicts")]
        values["envelope"] = asdict(self.envelope)
        values["objections"] = {key: getattr(self, name) for key, name in objections.items()}
        plain: dict[str, Any] = finite(values)
        return plain

    def text(self, *, everything: bool = False) -> str:
        """A summary of at most 20 lines; with `everything`, then also metadata, clocks and all signals."""
        head = f"{self.path}: {self.source}, {self.duration_s:.2f} s, {self.samples} samples"
        kind = self.other_kind or (f"{self.kind}, by its autopilot" if self.kind else "")
        remarks = [f"{what}: {text}" for what, text in (("vehicle", kind), ("weight", self.unlike)) if text]
        parts = [head, *remarks, *_flight_lines(self.envelope, self.on_the_ground)]
        parts += [f"what it could identify, as vehicle {self.vehicle}:", *_verdict_lines(self.verdicts)]
        if self.no_replay and all(verdict.reason != self.no_replay for verdict in self.verdicts):
            parts.append(f"  crazyem replay cannot use it: {self.no_replay}")
        if not everything:
            return "\n".join([*parts, *_summary_lines(self.signals)])
        parts += [
            "",
            *(_metadata_line(*section) for section in self.metadata.items()),
            *_signal_lines(self.signals),
            *map(_clock_line, self.clocks),
        ]
        if self.events:
            parts.append("events: " + ", ".join(f"{count} {kind}" for kind, count in self.events.items()))
        return "\n".join(parts)


def inventory(recording: Recording, vehicle: Vehicle | None = None) -> Inventory:
    """The inventory of a recording.

    Args:
        recording: any.
        vehicle: gives rotor law and inertia; None: the vehicle named in the recording, else chosen by its signals.
    """
    vehicle = vehicle or vehicle_for(recording)
    air = airtime(recording)
    return Inventory(
        path=recording.path,
        source=recording.source,
        duration_s=recording.duration,
        samples=len(recording),
        vehicle=vehicle.name,
        signals=tuple(_row(name, array) for name, array in recording.signals.items()),
        clocks=_clocks(recording),
        metadata=_short(recording.metadata),
        events=Counter(event.kind for event in recording.events),
        envelope=envelope(recording, air),
        verdicts=identifiability(recording, vehicle, air),
        kind=recording.metadata.get("vehicle", {}).get("kind", ""),
        other_kind=kind_objection(recording),
        unlike=weight_objection(recording, vehicle, air),
        on_the_ground=air.reason,
        no_replay=replay_objection(recording, vehicle),
    )


def _row(name: str, array: SignalArray) -> SignalRow:
    n = array.time.size
    time = array.time[np.isfinite(array.time)]
    steps = np.diff(time)
    span = float(time.max() - time.min()) if time.size > 1 else 0.0
    bad = ~sound_rows(array.value)
    return SignalRow(
        name=name,
        **about(array),
        samples=n,
        start_s=float(time.min()) if time.size else None,
        end_s=float(time.max()) if time.size else None,
        rate_hz=(time.size - 1) / span if span > 0.0 else None,
        period_s=float(np.median(steps)) if steps.size else None,
        missing_share=float((bad & ~array.marked).mean()) if n else 0.0,
        marked_share=float(array.marked.mean()) if n else 0.0,
        longest_gap_s=float(steps.max()) if steps.size else None,
    )


def _clocks(recording: Recording) -> tuple[ClockRow, ...]:
    by_name: dict[str, list[SignalArray]] = {}
    for array in recording.signals.values():
        if np.isfinite(array.time).any():
            by_name.setdefault(array.clock, []).append(array)
    rows = []
    for name, arrays in by_name.items():
        start, end = min(float(np.nanmin(a.time)) for a in arrays), max(float(np.nanmax(a.time)) for a in arrays)
        best = max(arrays, key=lambda a: int(np.isfinite(a.host_time).sum()))
        rows.append(ClockRow(name, len(arrays), start, end, _against_host(best)))
    return tuple(rows)


def _against_host(array: SignalArray) -> float | None:
    """Rate of the stamps over that of the host's clock, less 1 [1e-6], by least squares; None with too few data."""
    good = np.isfinite(array.host_time) & np.isfinite(array.time)
    if good.sum() < 10:
        return None
    host = array.host_time[good] - array.host_time[good][0]
    stamps = array.time[good] - array.time[good][0]
    if np.ptp(host) < 1.0:
        return None
    host = host - host.mean()
    return float(1e6 * (host @ (stamps - stamps.mean()) / (host @ host) - 1.0))


def _short(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Metadata without long values such as whole tables and vehicle files."""
    kept: dict[str, dict[str, str]] = {}
    for section, values in metadata.items():
        for key, value in values.items():
            if len(text := str(value)) <= _LONGEST_TEXT and "\n" not in text:
                kept.setdefault(section, {})[key] = text
    return kept


def _metadata_line(section: str, values: Mapping[str, str]) -> str:
    entries = ", ".join(f"{key} {value}" for key, value in values.items())
    return f"  {section}: {entries if len(values) <= _MOST_ENTRIES else f'{len(values)} entries (--json shows them)'}"


def _signal_lines(rows: tuple[SignalRow, ...]) -> list[str]:
    width = max([len(row.name) for row in rows] + [6])
    lines = [
        f"{'signal':<{width}} {'unit':<8} {'samples':>8} {'rate Hz':>8} {'1/period':>8} {'missing':>8} {'marked':>7} "
        f"{'gap s':>7}  clock, stream, source"
    ]
    for row in rows:
        rate = "-" if row.rate_hz is None else f"{row.rate_hz:.2f}"
        usual = f"{1.0 / row.period_s:.2f}" if row.period_s else "-"
        gap = "-" if row.longest_gap_s is None else f"{row.longest_gap_s:.3f}"
        origin = ", ".join(part for part in (row.clock, row.stream, _names(row.source)) if part)
        lines.append(
            f"{row.name:<{width}} {row.unit:<8} {row.samples:>8} {rate:>8} {usual:>8} {100 * row.missing_share:>7.1f}% "
            f"{100 * row.marked_share:>6.1f}% {gap:>7}  {origin}"
        )
    return lines


def _names(source: tuple[str, ...]) -> str:
    return source[0] if len(source) == 1 else f"{source[0]} .. {source[-1]}" if source else ""


def _clock_line(row: ClockRow) -> str:
    drift = "" if row.against_host_ppm is None else f", {row.against_host_ppm:+.0f} ppm against the host"
    return f"clock {row.name or 'unnamed'}: {row.start_s:.3f} to {row.end_s:.3f} s{drift}"


def _flight_lines(e: Envelope, on_the_ground: str) -> list[str]:
    """Time in the air, the signals that show it, and extremes of the motion: at most three lines."""
    by = "by " + ", ".join(e.judged_by) if e.judged_by else "no signal says when; all of it counts"
    spans = e.airborne_intervals_s
    shown = " and ".join(f"{a:.2f} to {b:.2f}" for a, b in spans[:_MOST_FLIGHTS])
    more = f" and {len(spans) - _MOST_FLIGHTS} more" if len(spans) > _MOST_FLIGHTS else ""
    if not spans:
        return [f"in the air: never ({by}): {on_the_ground}"]
    lines = [f"in the air: {e.airborne_s:.2f} s ({shown}{more} s; {by})"]
    motion = []
    if e.speed_max_m_s is not None:
        source = "" if e.speed_from == "velocity" else f" (from {e.speed_from})"
        motion.append(
            f"speed up to {e.speed_max_m_s:.2f} m/s, rms {e.speed_rms_m_s:.2f}; vertical "
            f"{e.vertical_speed_min_m_s:.2f} to {e.vertical_speed_max_m_s:.2f} m/s{source}"
        )
    if e.altitude_min_m is not None:
        motion.append(f"altitude {e.altitude_min_m:.2f} to {e.altitude_max_m:.2f} m")
    if e.tilt_max_deg is not None:
        motion.append(f"tilt up to {e.tilt_max_deg:.1f} deg" + ("" if e.tilt_from == "attitude" else " (from euler)"))
    forces = []
    if e.body_rate_max_rad_s is not None:
        forces.append("body rate up to " + ", ".join(f"{r:.2f}" for r in e.body_rate_max_rad_s) + " rad/s (x, y, z)")
    if e.specific_force_max_m_s2 is not None:
        forces.append(f"specific force {e.specific_force_min_m_s2:.2f} to {e.specific_force_max_m_s2:.2f} m/s^2")
    if e.acceleration_max_m_s2 is not None:
        forces.append(f"acceleration up to {e.acceleration_max_m_s2:.2f} m/s^2")
    if e.voltage_min_V is not None:
        forces.append(f"battery {e.voltage_start_V:.2f} to {e.voltage_end_V:.2f} V, lowest {e.voltage_min_V:.2f} V")
    if e.motor_command_max is not None and e.motor_saturated_share is not None:
        forces.append(
            f"motor command up to {e.motor_command_max:.3f}; at the limit in {percent(e.motor_saturated_share)} of the "
            "samples"
        )
    return [*lines, *("  " + "; ".join(part) for part in (motion, forces) if part)]


def _verdict_lines(verdicts: tuple[Verdict, ...]) -> list[str]:
    """One line for each identifiable parameter; one line for each reason why others are not identifiable."""
    lines = [verdict.line() for verdict in verdicts if verdict.verdict != "no"]
    reasons: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        if verdict.verdict == "no":
            reasons.setdefault(verdict.reason, []).append(verdict)
    for reason, group in reasons.items():
        if len(group) == 1:
            lines.append(group[0].line())
        else:
            names = "everything" if len(group) == len(verdicts) else ", ".join(v.name for v in group)
            lines.append(f"  not {names}: {reason}")
    return lines


def _summary_lines(rows: tuple[SignalRow, ...]) -> list[str]:
    """The signals in use with their rates, and the number of others: one line."""
    used = [row for row in rows if row.quantity]
    others = len(rows) - len(used)
    words = [row.name + (f" {row.rate_hz:.0f} Hz" if row.rate_hz else "") for row in used]
    shown, more = words[:_MOST_SIGNALS], len(words) - _MOST_SIGNALS
    text = ", ".join(shown) + (f" and {more} more" if more > 0 else "") if used else "none that is known here"
    rest = f"; {others} others that nothing here uses" if others else ""
    return [f"signals: {text}{rest} (--all shows everything)"]
