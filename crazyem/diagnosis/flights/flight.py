"""A recorded flight as arrays for the diagnosis: rows in free flight with their measurements, and inputs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.flights.alignment import Alignment
from crazyem.diagnosis.flights.inputs import inputs_of
from crazyem.diagnosis.settings import RECORDINGS
from crazyem.errors import DataError
from crazyem.physics.motion import RotorInput
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording, onboard_estimate
from crazyem.vehicle import GRAVITY, Vehicle

COLUMNS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}
COMMANDS = ("motor_command", "motor_request", "mixer_command")
YAW = "stateEstimate.yaw"  # deg, right-handed
# rad/s: the gyro as the PID controller logs it, pitch negated (controller_pid.c)
CONTROLLED = (("controller.r_roll", 1.0), ("controller.r_pitch", -1.0), ("controller.r_yaw", 1.0))


@dataclass(frozen=True, eq=False)
class Frame:
    """The tilt of the pose frame of a recording against that of the others.

    Attributes:
        roll, pitch: rad, of the frame in the body, as in `attitude_misalignment`; already removed from the attitude.
        sd: rad, (roll, pitch).
    """

    roll: float
    pitch: float
    sd: tuple[float, float]

    def description(self) -> str:
        """For people."""
        return (
            f"the pose frame of this recording is tilted by {1e3 * self.roll:+.1f} mrad in roll and "
            f"{1e3 * self.pitch:+.1f} mrad in pitch against the others; it is turned back by that much"
        )


@dataclass(frozen=True, eq=False)
class Flight:
    """One flight, airborne samples only.

    Attributes:
        name: of the recording.
        time: (n,) s on the recording's clock, increasing.
        starts: (n,) bool, rows at which the filter starts again.
        gaps: (n,) bool, rows without a known path in the step before, over which nothing is integrated. Each is a
            start. At the other starts, the path of the step is known (`RECORDINGS.piece`, `Data.leave_out_wild`).
        y: (n, 13) position [m], velocity [m/s], attitude (x y z w), body rate [rad/s]; NaN where not measured.
        force: (n, 3) accelerometer [m/s^2, body]; NaN where not measured.
        voltage: (n,) V; NaN where unknown.
        flown: (n,) s since take-off.
        ground: height of the floor [m] in the frame of the position; 0 where unknown.
        grounded: whether the recording shows the floor, by a drone at rest.
        block: (n,) int, consecutive stretches of about a second, of half a second in short flights.
        inputs: commands or measured speeds of the rotors.
        signals: names of the measured signals.
        fused: whether the attitude, or without one the velocity, comes from a filter on board.
        levelled: whether the voltage is not recorded, but chosen so that the first thrust carries the weight.
        coarse: whether the recorded commands do not explain the rotation (see `nuisances.is_nonphysical`).
        differs: whether each of several recordings has a thrust scale of its own (see `model.OWN`).
        alignment: delay of measured rotor speeds, already corrected; None where unknown.
        frame: tilt of the pose frame against other recordings, already corrected; None if equal.
        notices: assumptions about the inputs, a sentence each.
    """

    name: str
    time: NDArray
    starts: NDArray
    gaps: NDArray
    y: NDArray
    force: NDArray
    voltage: NDArray
    flown: NDArray
    ground: float
    block: NDArray
    inputs: RotorInput
    signals: frozenset[str]
    fused: bool = False
    grounded: bool = True
    levelled: bool = False
    coarse: bool = False
    differs: bool = False
    alignment: Alignment | None = None
    frame: Frame | None = None
    notices: tuple[str, ...] = ()

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self.block[-1]) + 1

    @property
    def duration(self) -> float:
        """Seconds in the air."""
        return float(np.sum(np.diff(self.time)[~self.starts[1:]]))

    def rows(self, keep: NDArray) -> "Flight":
        """The flight with the rows `keep` (n,) bool; the filter starts again after each row that is left out."""
        index = np.flatnonzero(keep)
        broken = np.concatenate([[True], np.diff(index) > 1])
        block = np.unique(self.block[index], return_inverse=True)[1]
        return replace(
            self, time=self.time[index], starts=self.starts[index] | broken, gaps=self.gaps[index] | broken,
            y=self.y[index], force=self.force[index], voltage=self.voltage[index], flown=self.flown[index], block=block,
        )  # fmt: skip


def flight_of(recording: Recording, vehicle: Vehicle, *, withhold: Sequence[str] = ()) -> Flight:
    """The flight of a recording.

    Raises:
        DataError: no inputs, no attitude or rates, no flight, or one that is too short.
    """
    recording = without(recording, withhold)
    air = airtime(recording)
    found = inputs_of(recording, vehicle, flight=air)
    inputs = found.rotor
    if not air.flown:
        raise DataError(
            f"{recording.path}: nothing was flown in this recording, so there is nothing to diagnose: {air.reason}"
        )
    measured = {name: ordered(recording.signals[name]) for name in COLUMNS if name in recording.signals}
    if "attitude" not in measured and "body_rate" not in measured and "acceleration" in recording.signals:
        measured["attitude"] = leaning(recording)
    if "body_rate" not in measured and all(name in recording.signals for name, _ in CONTROLLED):
        measured["body_rate"] = controlled_rates(recording)
    measured = {name: thinned(time, value) for name, (time, value) in measured.items()}
    if not measured:
        raise DataError(f"{recording.path}: no position, velocity, attitude or body rate to compare a simulation with")
    if "body_rate" not in measured and "attitude" not in measured and "velocity" not in measured:
        raise DataError(f"{recording.path}: positions alone do not show which physics is missing")
    time = _nodes([t for t, _ in measured.values()], air.flown)
    if time.size < 50:
        raise DataError(f"{recording.path}: only {time.size} samples in the air; at least 50 are needed")
    y = np.full((time.size, 13), np.nan)
    for name, (when, value) in measured.items():
        _place(y[:, COLUMNS[name]], time, when, value)
    force = _force_at(recording, time)
    fresh = np.concatenate([[True], np.any((y[1:] != y[:-1]) & np.isfinite(y[1:]), axis=1)])  # no repeated rows
    time, y, force = time[fresh], y[fresh], force[fresh]
    y[:, 6:10] /= np.linalg.norm(y[:, 6:10], axis=1, keepdims=True)
    gaps = _gaps(time, inputs.time, air.flown)
    voltage = np.full(time.size, np.nan)
    if "voltage" in recording.signals:
        when, value = ordered(recording.signals["voltage"])
        voltage = np.interp(time, when, value[:, 0])
    constant = set() if _changes(time, voltage) else {"voltage"}
    ground = air.ground if np.isfinite(air.ground) else 0.0
    flight = Flight(
        name=recording.path, time=time, starts=_starts(time, gaps), gaps=gaps, y=y, force=force, voltage=voltage,
        flown=time - air.flown[0][0], ground=ground, block=_blocks(time), inputs=inputs,
        signals=frozenset(n for n in (*measured, "specific_force", "voltage", "rotor_speed", *COMMANDS)
                          if n not in constant and (n in recording.signals or (n == "body_rate" and n in measured))),
        fused=onboard_estimate(recording), grounded=bool(np.isfinite(air.ground)),
        levelled=found.level is not None, alignment=found.alignment, notices=found.notices,
    )  # fmt: skip
    if flight.duration < RECORDINGS.min_duration:
        raise DataError(
            f"{recording.path}: {flight.duration:.1f} of {air.seconds:.1f} s in the air have samples no more than "
            f"{RECORDINGS.max_gap:g} s apart, which is too short for a diagnosis "
            f"(at least {RECORDINGS.min_duration:g} s)"
        )
    return flight


def _changes(time: NDArray, voltage: NDArray) -> bool:
    """Whether voltages (n,) V at (n,) s change in flight; a constant one does not show the effect of voltage."""
    second = ((time - time[0]) // 1.0).astype(int)
    means = np.bincount(second, voltage) / np.maximum(np.bincount(second), 1)
    return bool(np.std(means[np.bincount(second) > 0]) > RECORDINGS.steady_voltage)


def _force_at(recording: Recording, time: NDArray) -> NDArray:
    """(n, 3) interpolated specific force [m/s^2]; NaN where no sample is near."""
    force = np.full((time.size, 3), np.nan)
    if "specific_force" in recording.signals:
        when, value = ordered(recording.signals["specific_force"])  # stamps of another log block
        distance = np.abs(when[np.clip(np.searchsorted(when, time), 0, when.size - 1)] - time)
        near = distance < RECORDINGS.max_force_distance
        force[near] = np.stack([np.interp(time[near], when, column) for column in value.T], 1)
    return force


def thinned(time: NDArray, value: NDArray) -> tuple[NDArray, NDArray]:
    """The first sample of a stream (n,), (n, k) in each `RECORDINGS.sample_period`; all samples of a slower stream.

    Intervals are whole periods of the stream and begin halfway between samples, so that jitter of stamps moves no
    sample to another interval. If the first sample is lost, the next one is taken.
    """
    period = float(np.median(np.diff(time))) if time.size > 1 else RECORDINGS.sample_period
    every = math.floor(RECORDINGS.sample_period / period + 0.1) if period > 0.0 else 1
    if every < 2:
        return time, value
    keep = np.diff(np.floor((time / period + 0.5) / every), prepend=-np.inf) > 0
    return time[keep], value[keep]


def leaning(recording: Recording) -> tuple[NDArray, NDArray]:
    """Attitude (n, 4) from the acceleration, for logs without attitude: thrust points along body z.

    World acceleration plus gravity is the direction of the force. The yaw is the estimate of the firmware if logged,
    else 0. The error is the lateral drag over the weight, a few mrad in slow flight.
    """
    time, acceleration = ordered(recording.signals["acceleration"])
    up = acceleration + np.array([0.0, 0.0, GRAVITY])
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    yaw = np.zeros(time.size)
    if YAW in recording.signals:
        when, degrees = ordered(recording.signals[YAW])
        yaw = np.interp(time, when, np.unwrap(np.radians(degrees[:, 0])))
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], 1)
    left = np.cross(up, ahead)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    matrices = np.stack([np.cross(left, up), left, up], axis=2)
    return time, Rotation.from_matrix(matrices).as_quat()


def controlled_rates(recording: Recording) -> tuple[NDArray, NDArray]:
    """Body rates (n, 3) from the log of the PID controller, for logs without gyro."""
    columns = [(*ordered(recording.signals[name]), sign) for name, sign in CONTROLLED]
    time = columns[0][0]
    return time, np.stack([sign * np.interp(time, when, value[:, 0]) for when, value, sign in columns], 1)


def without(recording: Recording, names: Sequence[str]) -> Recording:
    """The recording with some signals withheld: a name of the vocabulary, or one of its sources (pm.vbat)."""
    if not names:
        return recording

    def hidden(name: str) -> bool:
        sources = [s.split("[")[0] for s in recording.signals[name].source]
        # the column pwr_pm_vbat of a CSV is pm.vbat of the firmware
        ends = [(s, "." + s.replace("_", ".")) for s in sources]
        return any(w == name or any(s.startswith(w) or dotted.endswith(f".{w}") for s, dotted in ends) for w in names)

    for wanted in names:
        if not any(hidden(name) for name in recording.signals):
            known = ", ".join(sorted(recording.signals))
            raise DataError(f"{recording.path}: there is no signal '{wanted}' to withhold (there are {known})")
    return replace(recording, signals={n: a for n, a in recording.signals.items() if not hidden(n)})


def _nodes(times: Sequence[NDArray], airborne: Sequence[tuple[float, float]]) -> NDArray:
    """Times of the nodes: one for measurements that belong together, in the air only."""
    time = np.unique(np.concatenate(times))
    keep = np.zeros(time.size, bool)
    for begin, end in airborne:
        keep |= (time >= begin) & (time <= end)
    time = time[keep]
    if time.size == 0:
        return time
    nodes = [time[0]]
    for t in time[1:]:
        if t - nodes[-1] > RECORDINGS.same_time:
            nodes.append(t)
    return np.array(nodes)


def _place(target: NDArray, nodes: NDArray, when: NDArray, value: NDArray) -> None:
    at = np.clip(np.searchsorted(nodes, when, "right") - 1, 0, nodes.size - 1)
    near = (np.abs(nodes[at] - when) < RECORDINGS.same_time) & np.all(np.isfinite(value), axis=1)
    target[at[near]] = value[near]


def _gaps(time: NDArray, commands: NDArray, airborne: Sequence[tuple[float, float]]) -> NDArray:
    """Rows at which a stretch of path begins: after gaps of measurements or inputs, and at take-off."""
    gaps = np.concatenate([[True], np.diff(time) > RECORDINGS.max_gap])
    for g in np.flatnonzero(np.diff(commands) > RECORDINGS.max_gap):  # any step that touches a gap of the inputs
        gaps |= (time > commands[g]) & (time <= commands[g + 1] + RECORDINGS.max_gap)
    gaps |= (time <= commands[0]) | (time > commands[-1] + RECORDINGS.max_gap)
    for begin, _ in airborne:
        at = int(np.searchsorted(time, begin))
        if at < time.size:
            gaps[at] = True
    return gaps


def _starts(time: NDArray, gaps: NDArray) -> NDArray:
    """Rows at which the filter starts: at gaps and every `RECORDINGS.piece` seconds."""
    starts, began = gaps.copy(), time[0]
    for k in range(time.size):
        if starts[k]:
            began = time[k]
        elif time[k] - began > RECORDINGS.piece:
            starts[k], began = True, time[k]
    return starts


def _blocks(time: NDArray) -> NDArray:
    since = time - time[0]
    index = np.floor(
        since / min(RECORDINGS.block, max(RECORDINGS.short_block, float(since[-1]) / RECORDINGS.blocks))
    ).astype(np.int64)
    return np.unique(index, return_inverse=True)[1].astype(np.int64)
