"""Open-loop predictions by many drones that may be this one: a band instead of a line.

The centre is the prediction by the vehicle, corrected as in `predict` by the flight before each start, and by other
flights. The band has two parts. The first is the uncertainty of the parameters: the members. The second are
disturbances and errors of the start state. Other flights give the shape of this part: their prediction errors, in the
heading frame, are divided by a scale and resampled. The scale of each start is the root mean square of the errors that
are known then, of other flights and of this flight so far. Without other flights the second part is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.prediction.bias_correction import Weights, correction_weights, moments
from crazyem.diagnosis.prediction.horizon import UNITS, Windows, open_loop, windows
from crazyem.diagnosis.prediction.predict import Recorded, recorded, turned_by
from crazyem.diagnosis.settings import PREDICTION
from crazyem.errors import DataError
from crazyem.physics.rotations import quaternion_conjugate, quaternion_product
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Array = NDArray[np.float64]
BAND = 0.9  # nominal coverage of the band
QUANTITIES = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9), "body_rate": slice(9, 12)}


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Predictions by many drones at one time ahead.

    Attributes:
        rows: (n,) starts, rows of the recorded states. time: (n,) s, times of the predicted states.
        centre: (n, 13) prediction by the vehicle, corrected as in `predict`; as `predict.NAMES`.
        offsets: (m, n, 12) of each member from the centre: position m, velocity m/s (world), attitude as rotation
            vector rad (body), rate rad/s.
        truth: (n, 12) of the recorded states from the centre; NaN where not recorded.
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
        """Share of the recorded states that lies in the band, by quantity."""
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
        """All arrays by name, for a file."""
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
    plain: bool = False,
) -> Ensemble:
    """Predict `horizon` [s] ahead by every member, from starts all along a flight.

    Args:
        vehicle: the most likely drone. members: possible drones.
        calibrate: other flights of the drone, for the spread of disturbances.
        seed: of the draws of disturbances.
        plain: the model alone, not corrected by the flight before each start.

    Raises: DataError as `predict.recorded` and `horizon.windows`.
    """
    flown = [f for f in (_flown(r, vehicle) for r in calibrate) if f is not None]
    learned = [] if plain else [moments(turned_by(shown), horizon=horizon) for shown in flown]
    flight = _Flight.of(recorded(recording, vehicle), horizon, learned, plain=plain)
    at, centre = flight.at, flight.centre
    offsets = np.stack([offset(flight.flown(member, recording), centre) for member in members])
    others = [_Flight.of(shown, horizon, learned[:k] + learned[k + 1 :], plain=plain) for k, shown in enumerate(flown)]
    if others:
        errors = np.concatenate([f.errors[f.complete] for f in others])
        if len(errors) < PREDICTION.min_starts:
            raise DataError(
                f"{len(errors)} starts are too few to learn disturbances from (at least {PREDICTION.min_starts})"
            )
        prior = (errors**2).mean(axis=0)
        shape = np.concatenate([(f.errors / f.scale(prior))[f.complete] for f in others])
        drawn = np.random.default_rng(seed).integers(len(shape), size=offsets.shape[:2])
        offsets = offsets + _turned(shape[drawn] * flight.scale(prior), _headings(centre))
    return Ensemble(at.rows, at.times[:, -1], centre, offsets, offset(at.truth[:, -1], centre), horizon)


@dataclass(frozen=True, eq=False)
class _Flight:
    """Predictions of one flight by the vehicle.

    Attributes:
        shown, at: the recording and its n starts. weights: corrections of each start; None: the model alone.
        centre: (n, 13). errors: (n, 12) of the recorded states from the centre, heading frame; NaN where not
            recorded.
    """

    shown: Recorded
    at: Windows
    weights: Weights | None
    centre: Array
    errors: Array

    @staticmethod
    def of(shown: Recorded, horizon: float, before: Sequence[Array], *, plain: bool) -> "_Flight":
        """Predictions with the `moments` of other flights."""
        at = windows(shown, horizons=(horizon,))
        learned = np.mean(before, axis=0) if before else None
        weights = None
        if not plain:
            weights = correction_weights(turned_by(shown), at.times[:, 0], horizon=horizon, before=learned)
        centre = open_loop(shown, at, weights=weights, substep=PREDICTION.ensemble_step)[:, -1]
        errors = _turned(offset(at.truth[:, -1], centre), -_headings(centre))
        return _Flight(shown, at, weights, centre, errors)

    @property
    def complete(self) -> NDArray[np.bool_]:
        """(n,) whether all components of an error are known."""
        return np.asarray(np.isfinite(self.errors).all(axis=1))

    def flown(self, member: Vehicle, recording: Recording) -> Array:
        """(n, 13) predictions by a member; the recording is read again if the member has another thrust curve."""
        shown = self.shown
        law, own = ((v.rotor_constant, v.thrust_curve, v.thrust_max) for v in (member, shown.inputs.vehicle))
        if law != own:
            shown = recorded(recording, member)
        found: Array = open_loop(
            shown, self.at, vehicle=member, weights=self.weights, substep=PREDICTION.ensemble_step
        )[:, -1]
        return found

    def scale(self, prior: Array) -> Array:
        """(n, 12), see `error_scale`."""
        return error_scale(self.at.times[:, 0], self.at.times[:, -1], self.errors, prior)


def _flown(recording: Recording, vehicle: Vehicle) -> Recorded | None:
    """The states of a flight; None if it has no complete states or is too short."""
    try:
        shown = recorded(recording, vehicle)
        windows(shown)
    except DataError:
        return None
    return shown


def error_scale(begin: Array, end: Array, errors: Array, prior: Array) -> Array:
    """Size of the errors that are known at each start.

    Args:
        begin, end: (n,) s, starts in order, and the times from which their errors are known.
        errors: (n, q); rows that are not finite are left out.
        prior: (q,) mean square before the flight; counts as `PREDICTION.prior_time` of flight.

    Returns: (n, q) root mean square with smaller weights of older errors (`PREDICTION.memory`).
    """
    whole = np.asarray(np.isfinite(errors).all(axis=1))
    apart = np.diff(begin, append=begin[-1:] + PREDICTION.spacing)
    span = apart.clip(0.0, PREDICTION.spacing)  # s of flight of each start
    ago = begin[:, None] - end
    weight = np.where((ago >= 0.0) & whole, span * np.exp(-np.maximum(ago, 0.0) / PREDICTION.memory), 0.0)
    square = weight @ np.where(whole[:, None], errors, 0.0) ** 2
    found: Array = np.sqrt(
        (PREDICTION.prior_time * prior + square) / (PREDICTION.prior_time + weight.sum(axis=1, keepdims=True))
    )
    return found


def offset(state: Array, centre: Array) -> Array:
    """(n, 12) states (n, 13) less centres (n, 13), world; attitudes as rotation vectors in the body."""
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


def _turned(values: Array, angle: Array) -> Array:
    """Positions and velocities of (..., n, 12) turned about the vertical by (n,) rad."""
    c, s = np.cos(angle), np.sin(angle)
    found = values.copy()
    for first in (0, 3):
        x, y = values[..., first], values[..., first + 1]
        found[..., first], found[..., first + 1] = c * x - s * y, s * x + c * y
    return found
