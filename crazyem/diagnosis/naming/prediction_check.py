"""Removal of effects with which the model predicts flights worse than without them.

The likelihood judges predictions of one step. There a control loop that answers an unknown vibration or wind makes
inertias, lags and torques look wrong: they gain thousands of nats, but spoil predictions within a tenth of a second. A
real effect improves predictions, or leaves them as they are where it hardly matters.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.flights.flight import without as without_signals
from crazyem.diagnosis.naming.prune import left_out
from crazyem.diagnosis.naming.trials import Selection
from crazyem.diagnosis.prediction.horizon import UNITS, HorizonErrors, errors, open_loop, windows
from crazyem.diagnosis.prediction.predict import recorded
from crazyem.diagnosis.settings import SELECTION
from crazyem.errors import DataError
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle


def without_worse_predictions(
    data: Data,
    selection: Selection,
    vehicle: Vehicle,
    recordings: Sequence[Recording],
    *,
    withhold: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Selection:
    """The selection without effects that make open-loop predictions of recordings worse than those by `vehicle`.

    Args:
        recordings: the held-out ones, or the fitted ones if there are none.
    """
    if data.coarse:  # the recorded commands lack the torques: no model predicts the rotation
        return selection
    shown = [without_signals(r, withhold) for r in recordings]
    nominal = [_errors_of(r, vehicle) for r in shown]

    def worse(accepted: Sequence[Candidate]) -> float:
        fitted = with_accepted_effects(vehicle, selection, accepted)
        return ratio(nominal, [_errors_of(r, fitted) for r in shown])

    while selection.accepted and worse(selection.accepted) > SELECTION.max_error_ratio:
        rest = [[a for a in selection.accepted if a is not c] for c in selection.accepted]
        misled = selection.accepted[int(np.argmin(data.workers.map(worse, rest)))]
        say(f"  left out again, flights are predicted worse with it: {misled.label}")
        selection = left_out(data, selection, misled)
    return selection


def with_accepted_effects(vehicle: Vehicle, selection: Selection, accepted: Sequence[Candidate]) -> Vehicle:
    """The vehicle with the accepted effects at their fitted values."""
    kept = {n: dict(v) for n, v in vehicle.effects.items()}
    for candidate in accepted:
        found = selection.final.effects.get(candidate.effect, {})
        kept[candidate.effect] = {k: v for k, v in found.items() if v is not None}
    return replace(vehicle, effects=kept)


def ratio(before: Sequence[HorizonErrors | None], after: Sequence[HorizonErrors | None]) -> float:
    """Geometric mean of errors after over errors before, for recordings, quantities and all horizons but the first; 1
    if there are none, inf if the model diverges."""
    found = [
        a.rms[name][k] / b.rms[name][k]
        for b, a in zip(before, after, strict=True)
        if a is not None and b is not None
        for name in UNITS
        for k in range(1, len(b.horizons))
        if np.isfinite(b.rms[name][k]) and b.rms[name][k] > 0 and not np.isnan(a.rms[name][k])
    ]
    return float(np.exp(np.mean(np.log(np.maximum(found, 1e-9))))) if found else 1.0


def _errors_of(recording: Recording, vehicle: Vehicle) -> HorizonErrors | None:
    """Errors of open-loop predictions by a vehicle; None where the recording has no complete states."""
    try:
        shown = recorded(recording, vehicle)
        at = windows(shown)
        return errors(open_loop(shown, at), at)
    except DataError:
        return None
