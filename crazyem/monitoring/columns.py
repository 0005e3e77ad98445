"""Numerical rows of hypotheses: effect of each column on body and sensors in each step of the filter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.model import Parameters
from crazyem.estimation.tape import Tape
from crazyem.monitoring import hypotheses as h
from crazyem.physics.effects.onboard_estimate import LATERAL_SD, LATERAL_SECONDS, path_errors
from crazyem.physics.rotors import PITCH_SIGN, ROLL_SIGN, YAW_SIGN
from crazyem.vehicle import Vehicle

# Standard deviation of the drag over mass [1/s] that is not in a vehicle file: propellers and frame of a small
# quadrotor, 3 to 9 mN s/m (Foerster 2015) over 30 g.
DRAG_SD = 0.2
# Standard deviation of the delay of measurements against commands [s]: a period of the onboard filter.
DELAY_SD = 0.01
# Standard deviations of the scales of velocities (an onboard filter that knows no drag has an error of 9 cm/s at
# 1.45 m/s, docs: controller_parameters.md) and of body rates (BMI088: sensitivity within 1 %, 1 % with temperature).
VELOCITY_SCALE_SD, RATE_SCALE_SD = 0.06, 0.02
# parameters of the estimator, drag along x, y, z, delays of the four measured quantities, two scales, the error of an
# onboard filter that knows no drag
NUISANCES = 19
LASTING = (9, 10, 11, 18)  # of these, the drags: constants of the drone, which the estimator does not have


@dataclass(frozen=True)
class Columns:
    """The columns of all hypotheses side by side, and the nuisances.

    Attributes:
        columns: (C,), columns of one hypothesis next to each other.
        first: (H + 1,) index of the first column of each hypothesis.
        block: (C,) index of the first column of the same hypothesis.
        sd: (C,) standard deviations of the priors of the sizes.
        once: (C,) whether a column acts in the first step only.
        onboard: (U,) columns that act on the onboard filter. seconds: (U,) time constants of its path. later: (U,)
            whether a column is a delay of its fixes.
    """

    columns: tuple[h.Column, ...]
    first: NDArray[np.int64]
    block: NDArray[np.int64]
    sd: NDArray[np.float64]
    once: NDArray[np.bool_]
    onboard: NDArray[np.int64]
    seconds: NDArray[np.float64]
    later: NDArray[np.bool_]

    @classmethod
    def of(cls, hypotheses: Sequence[h.Hypothesis]) -> "Columns":
        """The columns of hypotheses, in their order."""
        columns = tuple(c for hypothesis in hypotheses for c in hypothesis.columns)
        first = np.cumsum([0, *(len(hypothesis.columns) for hypothesis in hypotheses)])
        block = np.repeat(first[:-1], np.diff(first))
        sd = np.array([c.sd for c in columns])
        kinds = np.array([c.kind for c in columns])
        onboard = np.flatnonzero(np.isin(kinds, h.ONBOARD))
        # the time constant is known within a half: two columns of a delay have its mean less and plus its sd
        seconds = [
            LATERAL_SECONDS
            + (0.0 if columns[i].kind == h.UNKNOWN_FORCE else (-LATERAL_SD, LATERAL_SD)[columns[i].index])
            for i in onboard
        ]
        return cls(
            columns, first, block, sd, np.isin(kinds, h.ONCE), onboard, np.array(seconds), kinds[onboard] == h.FIX_DELAY
        )  # fmt: skip


def mixing(vehicle: Vehicle) -> NDArray[np.float64]:
    """Matrix (4, 4) from the thrusts of the rotors [N] to F [N] and M [N m]."""
    x, y = vehicle.arm
    return np.stack([np.ones(4), y * ROLL_SIGN, x * PITCH_SIGN, vehicle.torque_per_thrust * YAW_SIGN])


def lateness(tape: Tape, first: int, last: int) -> NDArray[np.float64]:
    """(n, 12) additions to measured position, velocity, attitude and body rate that are late by one second, to first
    order: less their derivatives."""
    now, before = tape.xp[first:last], tape.xf[first - 1 : last - 1]
    span = (tape.time[first:last] - tape.time[first - 1 : last - 1])[:, None]
    acceleration, turning = (now[:, 3:6] - before[:, 3:6]) / span, (now[:, 10:13] - before[:, 10:13]) / span
    return -np.concatenate([now[:, 3:6], acceleration, now[:, 10:13], turning], axis=1)


class RowMaker:
    """Computes the rows of columns and nuisances for a vehicle.

    Args:
        columns: of the hypotheses. vehicle: its geometry.
    """

    def __init__(self, columns: Columns, vehicle: Vehicle) -> None:
        self.columns = columns
        self.mass = vehicle.mass
        matrix = mixing(vehicle)
        self.restart()
        self._unmix = np.linalg.inv(matrix) if abs(np.linalg.det(matrix)) > 0 else None
        self._mix = matrix

    def restart(self) -> None:
        """The tests begin: the error of an onboard filter counts from 0; it settles within a second."""
        self._filter_error = np.zeros((2, 3))  # m, m/s, for a drag over mass of 1/s

    def rows(self, tape: Tape, p: Parameters, first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Effect of the columns in the steps that end at rows first..last-1.

        Returns:
            acting (n, C, 6): specific force [m/s^2] and angular acceleration [rad/s^2], body axes, for a size of one;
            for columns that act once: changes of velocity [m/s] and rate [rad/s]. sensed (n, C, 12): additions to the
            measured position [m], velocity [m/s], attitude [rad, body] and body rate [rad/s].
        """
        n, size = last - first, len(self.columns.columns)
        acting, sensed = np.zeros((n, size, 6)), np.zeros((n, size, 12))
        mass, inverse = p.theta[0], p.inverse
        force = tape.mean[first:last, 0]
        wrench = tape.mean[first:last]
        turn = tape.middle[first:last]  # body to world, in the middle of the step
        thrusts = wrench @ self._unmix.T if self._unmix is not None else None
        for c, column in enumerate(self.columns.columns):
            kind, i = column.kind, column.index
            if kind == h.ROTOR and thrusts is not None:
                lost = thrusts[:, i : i + 1] * self._mix[:, i]
                acting[:, c, 2] = -lost[:, 0] / mass
                acting[:, c, 3:] = -lost[:, 1:] @ inverse.T
            elif kind == h.THRUST:
                acting[:, c, 2] = -force / mass
                acting[:, c, 3:] = -wrench[:, 1:] @ inverse.T
            elif kind == h.MASS:
                acting[:, c, 2] = -force / mass**2
            elif kind == h.CENTRE:  # from a centre of mass at (x, y), thrust acts at (-x, -y): torque (-y F, x F, 0)
                acting[:, c, 3:] = (force if i == 0 else -force)[:, None] * inverse[:, 1 - i]
            elif kind in (h.FORCE, h.UNKNOWN_FORCE):
                acting[:, c, :3] = turn[:, i, :] / mass
            elif kind == h.TORQUE:
                acting[:, c, 3:] = inverse[:, i]
            elif kind == h.KICK:
                acting[:, c, :3] = turn[:, i, :]
            elif kind == h.TURN:
                acting[:, c, 3 + i] = 1.0
            elif h.POSITION <= kind <= h.RATE:
                sensed[:, c, 3 * (kind - h.POSITION) + i] = 1.0
            elif kind == h.VELOCITY_SCALE:
                sensed[:, c, 3:6] = tape.xp[first:last, 3:6]
            elif kind == h.RATE_SCALE:
                sensed[:, c, 9:12] = tape.xp[first:last, 10:13]
        return acting, sensed

    def nuisances(
        self, tape: Tape, p: Parameters, unit: NDArray[np.float64], first: int, last: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Effect of the nuisances, errors of the model without a change: acting (n, M, 6), sensed (n, M, 12) as `rows`.

        The nuisances are the nine parameters in the coordinates of the estimator (logarithms, units of the linear
        ones), drag along x, y, z [1/s], delays of position, velocity, attitude and rate [s], scales of velocity and
        rate, drag along x and y that an onboard filter does not know [1/s]. The rows must follow those before.
        """
        acting = np.zeros((last - first, NUISANCES, 6))
        sensed = np.zeros((last - first, NUISANCES, 12))
        theta, inverse = p.theta, p.inverse
        w = tape.xf[first - 1 : last - 1, 10:13]
        acting[:, 0, 2] = -tape.thrust[first:last] / theta[0]
        momentum = w @ p.inertia.T
        alpha = (tape.torque[first:last] - np.cross(w, momentum)) @ inverse.T
        for a in range(3):  # as crazyem/estimation/kernels/sensitivity.py
            b, c = (a + 1) % 3, (a + 2) % 3
            change = np.outer(alpha[:, a], inverse[:, a]) + w[:, a : a + 1] * (
                np.outer(w[:, c], inverse[:, b]) - np.outer(w[:, b], inverse[:, c])
            )
            acting[:, 1 + a, 3:] = -theta[1 + a] * change
        for column, scale, thrust, torque in (
            (4, theta[4], tape.thrust_tau, tape.torque_tau),
            (5, unit[5], tape.thrust_delay, tape.torque_delay),
        ):
            acting[:, column, 2] = scale * thrust[first:last] / theta[0]
            acting[:, column, 3:] = scale * torque[first:last] @ inverse.T
        for a in range(3):
            acting[:, 6 + a, 3:] = unit[6 + a] * inverse[:, a]
        velocity = np.einsum("nij,ni->nj", tape.middle[first:last], tape.xf[first - 1 : last - 1, 3:6])
        for a in range(3):
            acting[:, 9 + a, a] = -velocity[:, a]
        span = (tape.time[first:last] - tape.time[first - 1 : last - 1])[:, None]
        late = lateness(tape, first, last)
        for a in range(4):
            sensed[:, 12 + a, 3 * a : 3 * a + 3] = late[:, 3 * a : 3 * a + 3]
        sensed[:, 16, 3:6] = tape.xp[first:last, 3:6]
        sensed[:, 17, 9:12] = tape.xp[first:last, 10:13]
        lateral = np.einsum("nij,nj->ni", tape.middle[first:last, :, :2], velocity[:, :2])
        sensed[:, 18, 0:3], sensed[:, 18, 3:6] = self._filter_errors(span[:, 0], lateral)
        return acting, sensed

    def _filter_errors(self, span: NDArray[np.float64], drag: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2, n, 3) errors of position [m] and velocity [m/s] by accelerations `drag` (n, 3) over steps of span (n,) s
        (see `path_error`)."""
        errors = np.concatenate([self._filter_error[:, None], np.zeros((2, len(span), 3))], axis=1)
        gap, drive = np.append(0.0, span), np.concatenate([np.zeros((1, 3)), drag])
        path_errors(gap, np.zeros(len(gap), bool), drive, LATERAL_SECONDS, *errors)
        self._filter_error = errors[:, -1].copy()
        return errors[:, 1:]

    def drifting(self, tape: Tape, p: Parameters, reference: Parameters, first: int, last: int) -> NDArray[np.float64]:
        """Accelerations (n, 1, 6) with parameters `p` (those of the tape), less those with `reference`."""
        out = np.zeros((last - first, 1, 6))
        if p is reference:
            return out
        lag, delay = p.theta[4] - reference.theta[4], p.theta[5] - reference.theta[5]
        thrust = tape.thrust[first:last]
        before = thrust - lag * tape.thrust_tau[first:last] - delay * tape.thrust_delay[first:last]
        out[:, 0, 2] = thrust / p.theta[0] - before / reference.theta[0]
        w = tape.xf[first - 1 : last - 1, 10:13]
        torque = tape.torque[first:last]
        was = torque - (p.theta[6:9] - reference.theta[6:9])
        was = was - lag * tape.torque_tau[first:last] - delay * tape.torque_delay[first:last]
        out[:, 0, 3:] = (torque - np.cross(w, w @ p.inertia.T)) @ p.inverse.T
        out[:, 0, 3:] -= (was - np.cross(w, w @ reference.inertia.T)) @ reference.inverse.T
        return out

    @staticmethod
    def precision(sd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Prior precisions (M,) of the nuisances; sd: (9,) standard deviations of the estimator's parameters."""
        own = np.repeat([DRAG_SD, DELAY_SD, VELOCITY_SCALE_SD, RATE_SCALE_SD, DRAG_SD], [3, 4, 1, 1, 1])
        return np.concatenate([np.maximum(sd, 1e-6), own]) ** -2.0
