"""A recorded flight as the arrays that diagnosis works on: nodes in free flight, what was measured there, inputs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.flights.alignment import Alignment
from crazyem.diagnosis.flights.inputs import inputs_of
from crazyem.errors import DataError
from crazyem.physics.motion import RotorInput
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording, onboard_estimate
from crazyem.vehicle import GRAVITY, Vehicle

SAME_NODE = 1.5e-3  # s: measurements closer than this belong to one node
MAX_GAP = 0.1  # s between nodes, or between inputs, beyond which a step cannot be trusted
# s: unit of resampling and held-out blocks; shorter in a short flight, so that there are `BLOCKS` of them, twice as
# many as things that are always free. Scores hang together for tenths of a second.
BLOCK, SHORT, BLOCKS = 1.0, 0.5, 40
# V, standard deviation of means over a second, below which the voltage is constant: 12 mV and more in 51 flights of the
# simulated firmware, 32 mV and more in 19 of CrazyPAD and NanoBench. A gain of 0.4/V makes 0.2 % of thrust of it.
STEADY_VOLTAGE = 5e-3
NEAR = 0.03  # s between samples of the accelerometer, at most, for a value between them
SHORTEST = 4.0  # s of flight below which nothing is said
# s between samples of a stream, about. Filters of gyros and of state estimates take 2 to 5 ms (a low-pass of 80 Hz:
# 2.8 ms, crazyflie-firmware sensors_bmi088_bmp3xx.c). Samples closer than that repeat the filter's own dynamics, which
# the model does not have: in hover they read as a negative damping. Sampling follows the dynamics that are looked for,
# about ten samples in a rise time (Ljung, System Identification, 1999, 13.7).
SAMPLING = 0.01
PIECE = 60.0  # s after which the filter starts anew, so that long flights are swept in pieces
COLUMNS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}
COMMANDS = ("motor_command", "motor_request", "mixer_command")
YAW = "stateEstimate.yaw"  # deg, right-handed
# rad/s: the gyro as the PID controller logs it, pitch negated (controller_pid.c)
CONTROLLED = (("controller.r_roll", 1.0), ("controller.r_pitch", -1.0), ("controller.r_yaw", 1.0))


@dataclass(frozen=True, eq=False)
class Frame:
    """How a recording's pose frame is turned against those of the others.

    Attributes:
        roll, pitch: rad, of the frame in the body, as `attitude_misalignment` has them; taken off already.
        sd: rad, (roll, pitch).
    """

    roll: float
    pitch: float
    sd: tuple[float, float]

    def said(self) -> str:
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
        starts: (n,) bool: where the filter begins anew.
        gaps: (n,) bool: where nothing is known of the step before, so that nothing can be carried along the path.
            Each is a start; a start elsewhere leaves out a step whose path is known (`PIECE`, `Data.leave_out_wild`).
        y: (n, 13) position [m], velocity [m/s], attitude (x y z w), body rate [rad/s]; NaN where not measured.
        force: (n, 3) accelerometer [m/s^2, body]; NaN where not measured.
        voltage: (n,) V; NaN where unknown.
        flown: (n,) s since the feet left the floor.
        ground: height of the floor [m] in the frame of the position; 0 where nothing shows it.
        grounded: whether the recording shows the floor, by where the drone rests.
        block: (n,) int: consecutive stretches of about a second, of half a second in short flights.
        inputs: what the rotors were told.
        signals: names of what is measured.
        fused: a filter on board made the attitude, or the velocity where there is none.
        levelled: the voltage is not recorded, and the thrust of its beginning is the weight by assumption.
        coarse: what turned the drone is not in the commands as recorded (see `nuisances.unlike_a_body`).
        differs: there are several recordings, and each may have a thrust of its own (see `model.OWN`).
        alignment: how late measured rotor speeds are; they are moved already. None where unknown.
        frame: how the pose lies against that of other recordings; it is turned back already. None where alike.
        notices: what had to be assumed of the inputs, a sentence each.
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
        """How many blocks there are."""
        return int(self.block[-1]) + 1

    @property
    def duration(self) -> float:
        """Seconds in the air."""
        return float(np.sum(np.diff(self.time)[~self.starts[1:]]))

    def rows(self, keep: NDArray) -> "Flight":
        """Some rows (n,) bool; where a row is left out the next one starts anew."""
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
    force = np.full((time.size, 3), np.nan)
    if "specific_force" in recording.signals:
        when, value = ordered(recording.signals["specific_force"])  # another log block: stamps of its own
        near = np.abs(when[np.clip(np.searchsorted(when, time), 0, when.size - 1)] - time) < NEAR
        force[near] = np.stack([np.interp(time[near], when, column) for column in value.T], 1)
    fresh = np.concatenate([[True], np.any((y[1:] != y[:-1]) & np.isfinite(y[1:]), axis=1)])  # a repeated row is none
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
    if flight.duration < SHORTEST:
        raise DataError(
            f"{recording.path}: {flight.duration:.1f} of {air.seconds:.1f} s in the air have samples no more than "
            f"{MAX_GAP:g} s apart, which is too short for a diagnosis (at least {SHORTEST:g} s)"
        )
    return flight


def _changes(time: NDArray, voltage: NDArray) -> bool:
    """Whether voltages (n,) V at (n,) s change in flight; a constant one tells as little of its effect as none."""
    second = ((time - time[0]) // 1.0).astype(int)
    means = np.bincount(second, voltage) / np.maximum(np.bincount(second), 1)
    return bool(np.std(means[np.bincount(second) > 0]) > STEADY_VOLTAGE)


def thinned(time: NDArray, value: NDArray) -> tuple[NDArray, NDArray]:
    """The first of the samples (n,), (n, k) of a stream in each interval of about `SAMPLING`; all of a slower stream.

    Intervals are whole periods of the stream and begin halfway between samples, so that the jitter of stamps moves none
    into another. Where the first one was lost, the next stands for it.
    """
    period = float(np.median(np.diff(time))) if time.size > 1 else SAMPLING
    every = math.floor(SAMPLING / period + 0.1) if period > 0.0 else 1
    if every < 2:
        return time, value
    keep = np.diff(np.floor((time / period + 0.5) / every), prepend=-np.inf) > 0
    return time[keep], value[keep]


def leaning(recording: Recording) -> tuple[NDArray, NDArray]:
    """Attitude (n, 4) from the acceleration, for logs that hold no attitude: thrust points along body z.

    World acceleration plus gravity is the direction of the force; the yaw is that of the firmware's estimate where it
    was logged, else 0. Good to the sideways drag over the weight, a few mrad in slow flight.
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
    """Body rates (n, 3) from the PID controller's log, for logs that hold no gyro."""
    columns = [(*ordered(recording.signals[name]), sign) for name, sign in CONTROLLED]
    time = columns[0][0]
    return time, np.stack([sign * np.interp(time, when, value[:, 0]) for when, value, sign in columns], 1)


def without(recording: Recording, names: Sequence[str]) -> Recording:
    """The recording with some signals withheld: a name of the vocabulary, or one of its sources (pm.vbat)."""
    if not names:
        return recording

    def hidden(name: str) -> bool:
        sources = [s.split("[")[0] for s in recording.signals[name].source]
        # a CSV's column pwr_pm_vbat is the firmware's pm.vbat
        return any(w == name or any(s.startswith(w) or _dotted(s).endswith(f".{w}") for s in sources) for w in names)

    for wanted in names:
        if not any(hidden(name) for name in recording.signals):
            known = ", ".join(sorted(recording.signals))
            raise DataError(f"{recording.path}: there is no signal '{wanted}' to withhold (there are {known})")
    return replace(recording, signals={n: a for n, a in recording.signals.items() if not hidden(n)})


def _dotted(source: str) -> str:
    return "." + source.replace("_", ".")


def _nodes(times: Sequence[NDArray], airborne: Sequence[tuple[float, float]]) -> NDArray:
    """One time for all that was measured together, in the air only."""
    time = np.unique(np.concatenate(times))
    keep = np.zeros(time.size, bool)
    for begin, end in airborne:
        keep |= (time >= begin) & (time <= end)
    time = time[keep]
    if time.size == 0:
        return time
    nodes = [time[0]]
    for t in time[1:]:
        if t - nodes[-1] > SAME_NODE:
            nodes.append(t)
    return np.array(nodes)


def _place(target: NDArray, nodes: NDArray, when: NDArray, value: NDArray) -> None:
    at = np.clip(np.searchsorted(nodes, when, "right") - 1, 0, nodes.size - 1)
    near = (np.abs(nodes[at] - when) < SAME_NODE) & np.all(np.isfinite(value), axis=1)
    target[at[near]] = value[near]


def _gaps(time: NDArray, commands: NDArray, airborne: Sequence[tuple[float, float]]) -> NDArray:
    """Where a stretch of path begins: gaps of measurements or inputs, and flights."""
    gaps = np.concatenate([[True], np.diff(time) > MAX_GAP])
    for g in np.flatnonzero(np.diff(commands) > MAX_GAP):  # any step that touches a gap of the inputs
        gaps |= (time > commands[g]) & (time <= commands[g + 1] + MAX_GAP)
    gaps |= (time <= commands[0]) | (time > commands[-1] + MAX_GAP)
    for begin, _ in airborne:
        at = int(np.searchsorted(time, begin))
        if at < time.size:
            gaps[at] = True
    return gaps


def _starts(time: NDArray, gaps: NDArray) -> NDArray:
    """Where the filter begins anew: at gaps and every `PIECE` seconds."""
    starts, began = gaps.copy(), time[0]
    for k in range(time.size):
        if starts[k]:
            began = time[k]
        elif time[k] - began > PIECE:
            starts[k], began = True, time[k]
    return starts


def _blocks(time: NDArray) -> NDArray:
    since = time - time[0]
    index = np.floor(since / min(BLOCK, max(SHORT, float(since[-1]) / BLOCKS))).astype(np.int64)
    return np.unique(index, return_inverse=True)[1].astype(np.int64)
