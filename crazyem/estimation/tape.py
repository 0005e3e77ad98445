"""The tape: all arrays that the kernels read and write, for the newest samples; the oldest rows are dropped."""

import numpy as np

from crazyem.estimation import kernels

BREAK = 1  # kind of a sample at which the state starts anew
START_VARIANCE = np.repeat([1.0, 1.0, 0.1, 25.0], 3)  # of the state at a break: m^2, (m/s)^2, rad^2, (rad/s)^2


class Tape:
    """Samples k = 0..size-1 and all quantities computed for them; row k of a step array is the step that ends at k."""

    def __init__(self, capacity: int) -> None:
        def rows(*shape: int, kind: type = float) -> np.ndarray:
            return np.zeros((capacity, *shape), kind)

        self.capacity = capacity
        self.size = 0
        self.time = rows()
        self.y = rows(13)
        self.force = rows(3)  # mean specific force over the step, body [m/s^2]; NaN where not measured
        self.kind = rows(kind=np.int8)
        self.usable = rows(kind=np.bool_)
        self.mean = rows(4)  # mean of lagged F and M over the step
        self.mean_tau, self.mean_delay = rows(4), rows(4)
        self.thrust, self.thrust_tau, self.thrust_delay = rows(), rows(), rows()
        self.torque, self.torque_tau, self.torque_delay = rows(3), rows(3), rows(3)
        self.xp, self.pp = rows(13), rows(12, 12)
        self.xf, self.pf = rows(13), rows(12, 12)
        self.gain, self.s, self.e = rows(12, 12), rows(12), rows(12)
        self.blocks, self.middle = rows(5, 3, 3), rows(3, 3)
        self.loglik = rows()
        self.stats, self.moments = rows(kernels.SIZE), rows(12)
        self.score = rows(kernels.PARAMETERS)

    def append(self, time: float, y: np.ndarray, *, starts: bool, keep: int) -> int:
        """Add a sample; a full tape keeps only its newest `keep` samples. Returns the number of dropped rows."""
        dropped = 0
        if self.size == self.capacity:
            dropped = self.size - keep
            for array in vars(self).values():
                if isinstance(array, np.ndarray):
                    array[:keep] = array[dropped : self.size].copy()
            self.size = keep
        k = self.size
        self.time[k] = time
        self.y[k] = y
        self.force[k] = np.nan
        self.kind[k] = BREAK if starts or k == 0 else 0
        self.usable[k] = self.kind[k] == 0
        self.mean[k] = self.mean_tau[k] = self.mean_delay[k] = 0.0
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
