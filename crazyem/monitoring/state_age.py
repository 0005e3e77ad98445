"""Age of an onboard state that is constant between predictions: a Bayes filter over the phase of the predictions.

A Crazyflie predicts its state every 10 ms and holds it in between. So position, velocity and attitude of a log are up
to 10 ms old, and the age changes from sample to sample. From one sample to the next, the position moves by velocity
times the difference of the predictions' times, and the attitude turns by body rate times this difference. That tells
the phase of the predictions, which is a hidden state: one of `PHASES`, or "not held" for other filters. A prediction
that is late makes all later ones late, so the phase increases by steps of 1 ms.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.estimation.in_step import PERIOD
from crazyem.estimation.online import SAME_NODE, STATE_COLUMNS

Array = NDArray[np.float64]

PHASES = 10  # phases in a period: the firmware's clock has steps of 1 ms
# Share of predictions that are 1 ms late, as firmware_sim has it (docs: firmware_sim.md). With a tenth of it, or ten
# times as much, ages are the same within 0.2 ms.
SLIP = 0.002
ANEW = 1e-4  # probability per sample that the phase is any other, as after a restart of the filter
MEAN_AGE = 0.5 * PERIOD * (1.0 - 1.0 / PHASES)  # s, of the ages 0, 1 ... 9 ms
LONGEST = 0.08  # s; over a longer gap a state tells nothing of its age
# standard deviations of the first increments of position [m] and attitude [rad]; samples that this prior counts for,
# and samples in the running mean
FIRST_SD, FIRST_COUNT, MEMORY = (2e-3, 5e-3), 20.0, 300.0
KEPT = 400  # newest ages that are kept: some seconds of a fast log
FORGETTING = 2.0  # s, time constant: much longer than a beat of two periods, such as 0.11 s of 10 and 11 ms
CLIPPED = 3.0  # standard deviations: largest deviation of an increment, so that an outlier says little


@compiled
def age_at(time: float, phase: float) -> float:
    """Age [s] of the state at a time [s], for predictions at `phase` periods after multiples of the period."""
    return (time / PERIOD - phase / PHASES + 1e-4) % 1.0 * PERIOD


@compiled
def expected_age(probability: Array, time: float) -> float:
    """Expected age [s] of the state at a time [s] by the phase, less the mean age; 0 for a state that is not held."""
    total = 0.0
    for j in range(PHASES):
        total += probability[j] * (age_at(time, j) - MEAN_AGE)
    return total


@compiled
def advance(
    probability: Array, variance: Array, count: Array, before: float, last: Array, now: float, state: Array
) -> float:
    """Update the probabilities (PHASES + 1,) of the phases and of "not held" by one more state.

    Args:
        variance: (2,) of increments of position [m^2] and attitude [rad^2], an axis; updated, as count (1,).
        before, now: s, stamps of the states last and state (13,): position, velocity, attitude, body rate.

    Returns: the expected change of the age [s].
    """
    moved, expected = np.empty((2, 3)), np.empty((2, 3))
    sign = 1.0 if np.sum(last[6:10] * state[6:10]) > 0.0 else -1.0
    for i in range(3):
        a, b = 6 + (i + 1) % 3, 6 + (i + 2) % 3
        moved[0, i] = state[i] - last[i]
        # the vector of conj(last) state, twice: the rotation in body axes, to first order
        moved[1, i] = last[9] * state[6 + i] - state[9] * last[6 + i] - last[a] * state[b] + last[b] * state[a]
        moved[1, i] *= 2.0 * sign
        expected[0, i] = 0.5 * (last[3 + i] + state[3 + i])
        expected[1, i] = 0.5 * (last[10 + i] + state[10 + i])
    span = now - before
    slip = min(SLIP * span / PERIOD, 1.0)
    # pairs of phases before and now: the same one, or the next one after a late prediction; the last pair: not held
    changes, squares = np.zeros(2 * PHASES + 1), np.zeros((2, 2 * PHASES + 1))
    logarithm = np.empty(2 * PHASES + 1)
    for pair in range(2 * PHASES + 1):
        value = probability[PHASES]
        if pair < 2 * PHASES:
            j, late = pair % PHASES, pair // PHASES
            changes[pair] = age_at(now, (j + late) % PHASES) - age_at(before, j)
            value = probability[j] * (slip if late else 1.0 - slip)
        value = np.log((1.0 - ANEW) * value + ANEW / (2 * PHASES + 1))
        for s in range(2):
            for i in range(3):
                squares[s, pair] += (moved[s, i] - (span - changes[pair]) * expected[s, i]) ** 2 / 3.0
            value -= 1.5 * min(squares[s, pair] / variance[s], CLIPPED**2)
        logarithm[pair] = value
    share = np.exp(logarithm - logarithm.max())
    share /= share.sum()
    for j in range(PHASES):
        probability[j] = share[j] + share[PHASES + (j - 1) % PHASES]
    probability[PHASES] = share[2 * PHASES]
    count[0] = min(count[0] + 1.0, MEMORY)
    for s in range(2):
        square = share @ squares[s]
        variance[s] += (min(square, CLIPPED**2 * variance[s]) - variance[s]) / count[0]
    return float(share @ changes)


class StateAge:
    """The age of the newest state, sample by sample.

    An age that is always the same cannot be seen, only its changes can. So the age is the sum of the changes. It tends
    to the age by the phase, less the mean age, within `FORGETTING`.

    Attributes:
        probability: (PHASES + 1,) of each phase, and of a state that is not held.
        age: s, expected age less the mean age.
    """

    def __init__(self) -> None:
        self.probability = np.full(PHASES + 1, 0.5 / PHASES)
        self.probability[PHASES] = 0.5
        self.age = 0.0
        self._variance, self._count = np.square(FIRST_SD), np.full(1, FIRST_COUNT)
        self._last: tuple[float, NDArray[np.float64]] = (-math.inf, np.zeros(13))

    def add(self, time: float, state: NDArray[np.float64]) -> float:
        """Take the state (13,) with stamp `time` [s]: position, velocity, attitude, body rate. Returns its `age`."""
        before, last = self._last
        self._last = (time, state)
        if not 0.0 < time - before < LONGEST:
            self.age = 0.0
            return self.age
        self.age += advance(self.probability, self._variance, self._count, before, last, time, state)
        self.age += (expected_age(self.probability, time) - self.age) * -math.expm1((before - time) / FORGETTING)
        return self.age


class StateAges:
    """Ages of the newest states of a stream of samples; only complete states, of one packet, have an age."""

    def __init__(self) -> None:
        self._age = StateAge()
        self._known: deque[tuple[float, float]] = deque(maxlen=KEPT)  # s, stamp and age
        self._time, self._state = math.nan, np.full(13, math.nan)

    def add(self, signal: str, time: float, value: tuple[float, ...]) -> None:
        """Add a value with its stamp [s]; signals that are not of the state are ignored."""
        columns = STATE_COLUMNS.get(signal)
        if columns is None:
            return
        if time != self._time:
            self._time, self._state = time, np.full(13, math.nan)
        self._state[columns] = value
        if np.isfinite(self._state).all():
            self._known.append((time, self._age.add(time, self._state)))

    def at(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) s, ages of the states at times (n,); 0 where there is none."""
        if not self._known:
            return np.zeros(len(times))
        stamps, ages = np.array(self._known).T
        nearest = np.minimum(np.searchsorted(stamps, times - SAME_NODE), len(stamps) - 1)
        return np.where(np.abs(stamps[nearest] - times) < SAME_NODE, ages[nearest], 0.0)
