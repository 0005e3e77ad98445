"""The tape: all arrays that the kernels read and write, for the newest samples; the oldest rows are dropped."""

import numpy as np

from crazyem.estimation import kernels

BREAK = 1  # kind of a sample at which the state starts anew
START_VARIANCE = np.repeat([1.0, 1.0, 0.1, 25.0], 3)  # of the state at a break: m^2, (m/s)^2, rad^2, (rad/s)^2


class Tape:
    """Samples k = 0..size-1 and all quantities computed for them; row k of a step array is the step that ends at k."""

    _ROWS = (
        ("time", (), float),
        ("y", (13,), float),
        ("force", (3,), float),  # mean specific force over the step, body [m/s^2]; NaN where not measured
        ("kind", (), np.int8),
        ("usable", (), np.bool_),
        ("mean", (4,), float),  # mean of lagged F and M over the step
        ("mean_tau", (4,), float),
        ("mean_delay", (4,), float),
        ("thrust", (), float),
        ("torque", (3,), float),
        ("thrust_tau", (), float),
        ("torque_tau", (3,), float),
        ("thrust_delay", (), float),
        ("torque_delay", (3,), float),
        ("xp", (13,), float),
        ("pp", (12, 12), float),
        ("xf", (13,), float),
        ("pf", (12, 12), float),
        ("gain", (12, 12), float),
        ("s", (12,), float),
        ("e", (12,), float),
        ("blocks", (5, 3, 3), float),
        ("middle", (3, 3), float),
        ("loglik", (), float),
        ("stats", (kernels.SIZE,), float),
        ("moments", (12,), float),
        ("score", (kernels.PARAMETERS,), float),
    )

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.size = 0
        for name, shape, kind in self._ROWS:
            setattr(self, name, np.zeros((capacity, *shape), kind))

    # for the type checker
    time: np.ndarray
    y: np.ndarray
    force: np.ndarray
    kind: np.ndarray
    usable: np.ndarray
    mean: np.ndarray
    mean_tau: np.ndarray
    mean_delay: np.ndarray
    thrust: np.ndarray
    torque: np.ndarray
    thrust_tau: np.ndarray
    torque_tau: np.ndarray
    thrust_delay: np.ndarray
    torque_delay: np.ndarray
    xp: np.ndarray
    pp: np.ndarray
    xf: np.ndarray
    pf: np.ndarray
    gain: np.ndarray
    s: np.ndarray
    e: np.ndarray
    blocks: np.ndarray
    middle: np.ndarray
    loglik: np.ndarray
    stats: np.ndarray
    moments: np.ndarray
    score: np.ndarray

    def append(self, time: float, y: np.ndarray, *, starts: bool, keep: int) -> int:
        """Add a sample; a full tape keeps only its newest `keep` samples. Returns the number of dropped rows."""
        dropped = 0
        if self.size == self.capacity:
            dropped = self.size - keep
            for name, _, _ in self._ROWS:
                array = getattr(self, name)
                array[:keep] = array[dropped : self.size].copy()
            self.size = keep
        k = self.size
        self.time[k] = time
        self.y[k] = y
        self.force[k] = np.nan
        self.kind[k] = BREAK if starts or k == 0 else 0
        self.usable[k] = self.kind[k] == 0
        self.mean[k] = 0.0
        self.mean_tau[k] = 0.0
        self.mean_delay[k] = 0.0
        self.size += 1
        return dropped

    def spread_inputs(self, first: int, last: int, offset: np.ndarray) -> None:
        """Copy the mean inputs, plus the torque offset (3,), into the contiguous columns that the kernels read."""
        self.thrust[first:last] = self.mean[first:last, 0]
        self.torque[first:last] = self.mean[first:last, 1:] + offset
        self.thrust_tau[first:last] = self.mean_tau[first:last, 0]
        self.torque_tau[first:last] = self.mean_tau[first:last, 1:]
        self.thrust_delay[first:last] = self.mean_delay[first:last, 0]
        self.torque_delay[first:last] = self.mean_delay[first:last, 1:]
