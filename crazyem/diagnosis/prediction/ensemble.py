"""Open-loop predictions by many drones that may be this one: a band instead of a line.

The band has two parts: what is not known of the drone (its members), and what no constants tell: disturbances and the
error of the state at the start. The second part is learned from other flights, as the joint error of position,
velocity, attitude and rate of the vehicle itself, in the heading frame; without such flights it is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.prediction.horizon import UNITS, Windows, open_loop, windows
from crazyem.diagnosis.prediction.predict import Recorded, recorded
from crazyem.errors import DataError
from crazyem.physics.rotations import quaternion_conjugate, quaternion_product
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Array = NDArray[np.float64]
BAND = 0.9  # share that the band should hold
QUANTITIES = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9), "body_rate": slice(9, 12)}
FEWEST_STARTS = 30  # of errors to learn twelve spreads from


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Predictions by many drones at one time ahead.

    Attributes:
        rows: (n,) starts, rows of the recording's states. time: (n,) s when each was predicted for.
        centre: (n, 13) by the vehicle itself, as `predict.NAMES`.
        offsets: (m, n, 12) of each member from that: position m, velocity m/s (world), attitude as rotation vector
            rad (body), rate rad/s.
        truth: (n, 12) of what was recorded, from the same centre; NaN where nothing was.
        horizon: s.
    """

    rows: NDArray[np.int64]
    time: Array
    centre: Array
    offsets: Array
    truth: Array
    horizon: float

    def band(self) -> tuple[Array, Array]:
        """(n, 12) lower and upper edge of the middle `BAND` of the members, as offsets."""
        edges = np.quantile(self.offsets, [(1.0 - BAND) / 2.0, (1.0 + BAND) / 2.0], axis=0)
        return edges[0], edges[1]

    def held(self) -> dict[str, float]:
        """Share of what was recorded that lies in the band, by quantity."""
        low, high = self.band()
        inside = np.where(np.isfinite(self.truth), (self.truth >= low) & (self.truth <= high), np.nan)
        return {q: float(np.nanmean(inside[:, c])) for q, c in QUANTITIES.items()}

    def width(self) -> dict[str, float]:
        """Mean width of the band, by quantity [m, m/s, rad, rad/s]."""
        low, high = self.band()
        return {q: float(np.mean((high - low)[:, c])) for q, c in QUANTITIES.items()}

    def __str__(self) -> str:
        held, width = self.held(), self.width()
        each = (f"{q} {100 * held[q]:.0f} % in a band {width[q]:.2g} {unit} wide" for q, unit in UNITS.items())
        return (
            f"{len(self.offsets)} drones, {self.horizon:g} s ahead of {len(self.rows)} starts; of what was recorded, "
            + ", ".join(each)
        )

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """For a file."""
        low, high = self.band()
        return {
            "start_index": self.rows, "time": self.time, "centre": self.centre, "offsets": self.offsets, "low": low,
            "high": high, "truth": self.truth, "horizon": np.array(self.horizon),
            "quantities": np.array(list(QUANTITIES)),
        }  # fmt: skip


def ensemble(
    recording: Recording,
    vehicle: Vehicle,
    members: Sequence[Vehicle],
    *,
    horizon: float = 0.5,
    calibrate: Sequence[Recording] = (),
    seed: int = 0,
) -> Ensemble:
    """Predict `horizon` [s] ahead by every member, from starts all along a flight.

    Args:
        vehicle: the most likely drone. members: drones as they may be.
        calibrate: other flights of the drone, by which disturbances are learned.
        seed: of the draws of disturbances.

    Raises: DataError as `predict.recorded` and `horizon.windows`.
    """
    shown = recorded(recording, vehicle)
    at = windows(shown, horizons=(horizon,))
    centre = open_loop(shown, at)[:, -1]
    offsets = np.stack([offset(_flown(recording, shown, at, member), centre) for member in members])
    root = _disturbances(calibrate, vehicle, horizon)
    if root is not None:
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal((*offsets.shape[:2], 12)) @ root.T
        offsets = offsets + _to_world(noise, centre)
    return Ensemble(at.rows, at.times[:, -1], centre, offsets, offset(at.truth[:, -1], centre), horizon)


def _flown(recording: Recording, shown: Recorded, at: Windows, member: Vehicle) -> Array:
    """(n, 13) by a member; the recording is read anew where its law of thrust is another one."""
    law, own = ((v.rotor_constant, v.thrust_curve, v.thrust_max) for v in (member, shown.inputs.vehicle))
    if law != own:
        shown = recorded(recording, member)
    found: Array = open_loop(shown, at, vehicle=member)[:, -1]
    return found


def offset(state: Array, centre: Array) -> Array:
    """(n, 12) from states (n, 13) to others: world differences, the attitude's as a rotation vector in the body."""
    between = quaternion_product(quaternion_conjugate(centre[:, 6:10]), state[:, 6:10])
    between = between * np.where(between[:, 3:] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(between[:, :3], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, between[:, 3:])
    turn = np.where(sine > 1e-12, between[:, :3] / np.maximum(sine, 1e-12) * angle, 2.0 * between[:, :3])
    found: Array = np.concatenate([state[:, :6] - centre[:, :6], turn, state[:, 10:] - centre[:, 10:]], axis=1)
    return found


def _headings(centre: Array) -> Array:
    x, y, z, w = centre[:, 6:10].T
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def _to_world(noise: Array, centre: Array) -> Array:
    """Positions and velocities (..., n, 12) of the heading frame in the world."""
    return _turned(noise, _headings(centre))


def _turned(values: Array, angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    found = values.copy()
    for first in (0, 3):
        x, y = values[..., first], values[..., first + 1]
        found[..., first], found[..., first + 1] = c * x - s * y, s * x + c * y
    return found


def _disturbances(recordings: Sequence[Recording], vehicle: Vehicle, horizon: float) -> Array | None:
    """A root (12, 12) of the mean square of errors along flights, in the heading frame; None without flights."""
    errors = []
    for recording in recordings:
        try:
            shown = recorded(recording, vehicle)
            at = windows(shown, horizons=(horizon,))
        except DataError:
            continue
        centre = open_loop(shown, at)[:, -1]
        found = _turned(offset(at.truth[:, -1], centre), -_headings(centre))
        errors.append(found[np.isfinite(found).all(axis=1)])
    if not errors:
        return None
    rows = np.concatenate(errors)
    if len(rows) < FEWEST_STARTS:
        raise DataError(f"{len(rows)} starts are too few to learn disturbances from (at least {FEWEST_STARTS})")
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    found_root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return found_root
