"""Open-loop prediction of the drone by the model, from a recorded state and recorded inputs alone.

The rigid body with its effects is integrated from every start. No state measured after the start is used, and no input
stamped after the start of the last step. The lagged thrust at the start follows from the inputs before it. The
predicted states are those that the recording would show.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import COLUMNS
from crazyem.diagnosis.flights.inputs import Inputs, inputs_of
from crazyem.diagnosis.prediction.bias_correction import Turned, correction_weights, weighted_mean
from crazyem.diagnosis.prediction.simulate import Simulator
from crazyem.diagnosis.settings import LEVELLING, PREDICTION, RECORDINGS
from crazyem.errors import DataError
from crazyem.notebook import finite, html_table, new_figure, saved
from crazyem.physics.rotations import quaternion_from_euler, rotation_matrix
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import inside, ordered
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = ("x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw", "wx", "wy", "wz")


@dataclass(frozen=True, eq=False)
class Recorded:
    """The states that a recording shows, at the samples of its position.

    Attributes:
        path: of the recording.
        time: (r,) s, increasing.
        state: (r, 13) as `NAMES`, SI; every part is the newest at or before this time, NaN if it is too old.
        age: (r,) s, age of the oldest part.
        row: (r,) index of the sample in the recorded position.
        airborne: (r,) bool.
        inputs: inputs of the rotors.
        parts: recorded samples of position, velocity, attitude and body_rate: (k,) s and (k, 3 or 4), by name.
        flights: intervals in the air [s].
        before: inputs with voltages estimated from the first part of the flight only (`level_of`), in order of time,
            for early starts. Empty if the voltage is recorded.
    """

    path: str
    time: NDArray[np.float64]
    state: NDArray[np.float64]
    age: NDArray[np.float64]
    row: NDArray[np.int64]
    airborne: NDArray[np.bool_]
    inputs: Inputs
    parts: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    flights: tuple[tuple[float, float], ...]
    before: tuple[Inputs, ...] = ()

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.time)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted states.

    Attributes:
        prediction: (starts, N, 13) as `NAMES`: position m and velocity m/s (world), attitude x y z w (body to world),
            body rate rad/s (FLU).
        time: (starts, N) s of each predicted state, on the recording's clock.
        start_time: (starts,) s.
        start_index: (starts,) sample of the recorded position.
        start_age: (starts,) s, age of the oldest part of the start state.
        airborne: (starts,) bool, whether the drone flies at the start.
        step: s; the median of recorded steps.
        vehicle: of the model. input_signal: source of the rotor input. notices: assumptions.
        left_out: number of missing starts: without a complete state, or with a gap in the inputs.
    """

    prediction: NDArray[np.float64]
    time: NDArray[np.float64]
    start_time: NDArray[np.float64]
    start_index: NDArray[np.int64]
    start_age: NDArray[np.float64]
    airborne: NDArray[np.bool_]
    step: float
    vehicle: Vehicle
    input_signal: str
    notices: tuple[str, ...] = ()
    left_out: int = 0

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name, for a file."""
        own = ("prediction", "time", "start_time", "start_index", "start_age", "airborne")
        return {**{n: getattr(self, n) for n in own}, "step": np.array(self.step), "names": np.array(NAMES)}

    def to_dict(self) -> dict[str, Any]:
        """All results by name, ready for JSON: lists, and None for numbers that are not finite."""
        arrays = {name: finite(array.tolist()) for name, array in self.arrays().items()}
        about = {"vehicle": self.vehicle.name, "input_signal": self.input_signal, "left_out": self.left_out}
        return {**arrays, **about, "notices": list(self.notices)}

    def __str__(self) -> str:
        effects = f" with {', '.join(self.vehicle.effects)}" if self.vehicle.effects else ""
        return (
            f"{self.prediction.shape[0]} starts x {self.prediction.shape[1]} steps of {1e3 * self.step:.4g} ms from "
            f"{self.input_signal}, vehicle {self.vehicle.name}{effects}"
        )

    def _repr_html_(self) -> str:
        last = self.prediction[:, -1]
        rows = [
            (name, *(float(v) for v in np.nanquantile(last[:, k], (0.0, 0.5, 1.0)))) for k, name in enumerate(NAMES)
        ]
        return html_table(str(self), ("after the last step", "smallest", "median", "largest"), rows, self.notices)

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Plot position and body rate over time, from thirty starts; saved to `path`, if given.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no matplotlib.
        """
        figure = new_figure(8.0, 8.0)
        columns = (0, 1, 2, 10, 11, 12)
        for axes, k in zip(figure.subplots(len(columns), sharex=True), columns, strict=True):
            for start in np.unique(np.linspace(0, len(self.time) - 1, 30).astype(int)):
                axes.plot(self.time[start], self.prediction[start, :, k], linewidth=0.8)
            axes.set_ylabel(f"{NAMES[k]} [{'m' if k < 3 else 'rad/s'}]")
            axes.grid(alpha=0.3)
        axes.set_xlabel("time [s]")
        return saved(figure, path)


# -- recorded states ---------------------------------------------------------------------------------------------------


def recorded(recording: Recording, vehicle: Vehicle) -> Recorded:
    """States and inputs of a recording.

    Raises: DataError if a part of the state, or every input, is missing.
    """
    arrays = _state_signals(recording)
    flight = airtime(recording)
    inputs = inputs_of(recording, vehicle, flight=flight)
    base = arrays["position"]
    row = np.flatnonzero(np.isfinite(base.time))
    row = row[np.argsort(base.time[row], kind="stable")]
    row = row[np.concatenate([[True], np.diff(base.time[row]) > 0])] if row.size else row
    time = base.time[row]
    if time.size < 2:
        raise DataError(f"{recording.path}: fewer than two positions, so there is nothing to predict")
    state, age = np.full((time.size, 13), np.nan), np.zeros(time.size)
    parts: dict[str, tuple[NDArray, NDArray]] = {}
    for name, columns in COLUMNS.items():
        when, value = ordered(arrays[name])
        if name == "attitude":
            norm = np.linalg.norm(value, axis=1, keepdims=True)
            sound = (norm > 0.5)[:, 0] & (norm < 2.0)[:, 0]
            when, value = when[sound], value[sound] / norm[sound]
        parts[name] = when, value
        at = np.searchsorted(when, time + 1e-9, "right") - 1
        since = np.where(at >= 0, time - when[np.maximum(at, 0)], np.inf) if when.size else np.full(time.size, np.inf)
        known = since <= PREDICTION.oldest
        state[known, columns] = value[at[known]]
        age = np.maximum(age, np.maximum(since, 0.0))
    flights = flight.flown
    looks = () if inputs.level is None else (0.0, *LEVELLING.looks)
    before = tuple(inputs_of(recording, vehicle, flight=flight, until=inputs.took_off + s) for s in looks)
    return Recorded(recording.path, time, state, age, row, inside(time, flights), inputs, parts, flights, before)


def _state_signals(recording: Recording) -> dict[str, SignalArray]:
    """Signals of position, velocity, attitude and rate: the signal of that name, else another of the same quantity;
    for the attitude also Euler angles."""
    found = {}
    for name in COLUMNS:
        wanted = [name, *(n for n in recording.signals if n.startswith(f"{name}@"))]
        array = next((recording.signals[n] for n in wanted if n in recording.signals), None)
        if array is None and name == "attitude" and "euler" in recording.signals:
            euler = recording.signals["euler"]
            array = replace(euler, value=quaternion_from_euler(*euler.value.T), quantity="attitude")
        if array is not None and array.time.size:
            found[name] = array
    missing = [name for name in COLUMNS if name not in found]
    if missing:
        raise DataError(
            f"{recording.path}: the recording has no {' and no '.join(missing)}; a prediction needs a whole state to "
            "start from (position, velocity, attitude and body rate)"
        )
    return found


# -- a whole recording -------------------------------------------------------------------------------------------------


def predict(
    shown: Recorded,
    *,
    horizon: int,
    step: float | None = None,
    every: int = 1,
    plain: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Prediction:
    """Predict `horizon` steps from every `every`-th recorded state.

    Args:
        shown: states and inputs, and the vehicle with its effects: `recorded(recording, vehicle)`.
        horizon: N, steps.
        step: s between predicted states; None: the recorded samples, so that row h of start i is the state at sample
            i + h + 1, at its stamp.
        every: samples from one start to the next.
        plain: the model alone; otherwise it is corrected by the flight before the start (`bias_correction.py`).
        progress: called with the number of finished starts and of all starts.

    Raises:
        DataError: no start has its whole horizon in the recording.
    """
    rows = np.arange(0, shown.time.size, every)
    all_starts = len(range(0, shown.time.size - (horizon if step is None else 0), every))
    rows = rows[start_rows(shown, rows, horizon=horizon, step=step)]
    span = horizon * (shown.period if step is None else step)
    if not rows.size:
        raise DataError(
            f"{shown.path}: no state can be predicted from: none is whole and followed by {span:.3g} s "
            "of inputs without a gap"
        )
    pieces, done = [], 0
    for known, those in _by_knowledge(shown, rows):
        weights = None if plain else correction_weights(turned_by(known), known.time[those], horizon=span)
        simulator = Simulator(known.inputs)
        swings = simulator.swings(known.time, known.state, known.airborne)
        at = 0
        for part in _parts(those, max(1, min(PREDICTION.chunk, 2_000_000 // horizon))):
            grid = _times(known, part, horizon=horizon, step=step)
            swing = None if swings is None else swings[part]
            believed = None if weights is None else weights.of(slice(at, at + part.size))
            pieces.append((simulator.run(known.state[part], grid, swing=swing, weights=believed), grid[:, 1:]))
            at += part.size
            if progress is not None:
                progress(done + at, rows.size)
        done += at
    result, times = (np.concatenate(whole) for whole in zip(*pieces, strict=True))
    return Prediction(
        result, times, shown.time[rows], shown.row[rows], shown.age[rows], shown.airborne[rows],
        shown.period if step is None else step, shown.inputs.vehicle, shown.inputs.signal,
        tuple(shown.inputs.notices), all_starts - rows.size,
    )  # fmt: skip


def _by_knowledge(shown: Recorded, rows: NDArray) -> list[tuple[Recorded, NDArray]]:
    """The starts in groups, each with the inputs by the voltage that is known at these starts."""
    stages = [(i.level.known, i) for i in (*shown.before, shown.inputs) if i.level is not None]
    stages.insert(0, (-np.inf, shown.before[0] if shown.before else shown.inputs))
    known = np.array([when for when, _ in stages])
    stage = np.searchsorted(known, shown.time[rows], "right") - 1
    return [(replace(shown, inputs=stages[k][1]), rows[stage == k]) for k in np.unique(stage)]


def turned_by(shown: Recorded) -> Turned:
    """Predictions of a recorded flight one step ahead of every row, for the corrections."""
    simulator = Simulator(shown.inputs)
    swings = simulator.swings(shown.time, shown.state, shown.airborne)
    gained, lacking = np.zeros((shown.time.size, 3)), np.zeros((shown.time.size, 3))
    flying = np.zeros(shown.time.size, bool)
    rows = np.arange(shown.time.size - 1)
    rows = rows[np.isfinite(shown.state[rows]).all(axis=1) & shown.airborne[rows] & shown.airborne[rows + 1]]
    rows = rows[start_rows(shown, rows, horizon=1, step=None) & (np.diff(shown.time)[rows] < RECORDINGS.max_gap)]
    for part in _parts(rows, PREDICTION.chunk):
        grid = shown.time[part[:, None] + np.arange(2)]
        ahead = simulator.run(shown.state[part], grid, swing=None if swings is None else swings[part])
        gained[part] = ahead[:, 0, 10:13] - shown.state[part, 10:13]
        missed = (shown.state[part + 1, 3:6] - ahead[:, 0, 3:6]) / np.diff(grid)
        lacking[part] = np.einsum("nji,nj->ni", rotation_matrix(shown.state[part, 6:10]), missed)
    flying[rows] = True
    return Turned(shown.time, shown.state[:, 10:13], gained, _at_start(shown, gained, flying), flying, lacking)


def _at_start(shown: Recorded, gained: NDArray, flying: NDArray) -> NDArray:
    """(r, 3, 6) regressors at every row, by axis: the angular acceleration that the model lacked in the step that ends
    there, the rate, and across the axis (0 for z): tilt, velocity, velocity times the flow along the axis of the
    rotors, distance from the mean position so far."""
    rotation = rotation_matrix(shown.state[:, 6:10])
    rate, velocity = shown.state[:, 10:13], np.einsum("nji,nj->ni", rotation, shown.state[:, 3:6])
    place, arrived = shown.state[:, :3], np.concatenate([[False], flying[:-1]])
    away = np.einsum("nji,nj->ni", rotation, place - weighted_mean(place, arrived, shown.period))
    across = [
        np.column_stack([v[:, 1], -v[:, 0], np.zeros(len(v))])
        for v in (rotation[:, 2], velocity, velocity * velocity[:, 2:], away)
    ]
    lacked = np.zeros_like(rate)
    step = np.diff(shown.time)[:, None]
    lacked[1:] = np.where(flying[:-1, None], (np.diff(rate, axis=0) - gained[:-1]) / step, 0.0)
    return np.stack([lacked, rate, *across], axis=2)


def start_rows(shown: Recorded, rows: NDArray, *, horizon: int, step: float | None) -> NDArray:
    """(n,) bool, whether rows (n,) have a complete state, and a horizon in the recording without gaps of inputs."""
    good = np.isfinite(shown.state[rows]).all(axis=1)
    begin, stamps = shown.time[rows], shown.inputs.rotor.time
    if step is None:
        good &= rows + horizon < shown.time.size
        end, before = (shown.time[np.minimum(rows + k, shown.time.size - 1)] for k in (horizon, horizon - 1))
    else:
        end, before = begin + horizon * step, begin + (horizon - 1) * step
        good &= end <= max(shown.time[-1], stamps[-1]) + 1e-6
    good &= begin >= stamps[0] - 1e-9
    good &= before - stamps[np.maximum(np.searchsorted(stamps, before + 1e-9, "right") - 1, 0)] <= RECORDINGS.max_gap
    for gap in np.flatnonzero(np.diff(stamps) > RECORDINGS.max_gap):
        good &= (end <= stamps[gap]) | (begin >= stamps[gap + 1])
    return good


def _parts(rows: NDArray, size: int) -> Iterator[NDArray]:
    for first in range(0, rows.size, size):
        yield rows[first : first + size]


def _times(shown: Recorded, rows: NDArray, *, horizon: int, step: float | None) -> NDArray:
    """(n, N + 1) s, times of the start and of the predicted states."""
    count = np.arange(horizon + 1)
    if step is None:
        return shown.time[rows[:, None] + count]
    return shown.time[rows][:, None] + step * count
