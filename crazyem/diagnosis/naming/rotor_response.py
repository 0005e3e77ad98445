"""Lag and delay of rotors behind their commands, where commands and rotor speeds are recorded.

With measured speeds the model of the flight needs neither, so only commands and speeds determine them. Over a sample
time h, a first-order lag of the thrust f answers to the commands u by

    f(t + d + h) = k f(t + d) + (1 - k) g(u(t)) + e,    k = exp(-h / lag),

with a parabola g for each rotor, constant within a flight. Between their samples commands are a spline. u is the
command times the voltage, and the voltage drops at once under the load of all rotors. A file without a voltage says
nothing of the lag: a firmware that compensates the drop looks like quick rotors. A high-pass removes slow changes.

All terms have errors: speeds have noise, commands are sampled, and air disturbs the rotors, to which the loop answers.
Each error biases least squares, noise of 1 % by a sixth. The errors of a sample do not affect earlier samples, so
earlier commands and thrusts are instruments (Söderström and Stoica, System Identification, 1989, ch. 8): at the true
lag and delay, e does not correlate with them. If the instruments hardly predict changes of f, the flight does not
determine the lag.

A regression of the commands on the thrusts around them leaves residuals. These are similar for healthy rotors; a rotor
that sticks, slips or misfires has larger ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt
from scipy.special import expit

from crazyem.diagnosis.flights.inputs import samples
from crazyem.diagnosis.locating.locate import Finding
from crazyem.diagnosis.settings import CONFIDENCE, RECORDINGS, ROTOR_RESPONSE, SELECTION
from crazyem.physics.effects.timing import INPUT_DELAY, MOTOR_LAG
from crazyem.physics.rotors import thrust_from_speed
from crazyem.recordings.airborne import airtime
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

LAG, DELAY = MOTOR_LAG.name, INPUT_DELAY.name


@dataclass(frozen=True)
class Response:
    """Lag and delay of rotors behind their commands [s], and their covariance (2, 2)."""

    lag: float
    delay: float
    covariance: NDArray

    def nats(self, lag: float, delay: float) -> float:
        """Log-likelihood of a lag and delay [s], less that of the best."""
        z = np.array([lag - self.lag, delay - self.delay])
        return -0.5 * float(z @ np.linalg.solve(self.covariance, z))


@dataclass(frozen=True, eq=False)
class Answer:
    """Result of one recording.

    Attributes:
        best: (2,) lag and delay [s].
        covariance: by scatter; None: without a voltage, or with weak instruments, lag and delay are not known.
        left: (4, n) N, the thrust that was commanded and not produced by each rotor.
        span: of time [s].
    """

    best: NDArray
    covariance: NDArray | None
    left: NDArray
    span: tuple[float, float]


def answers(recordings: Sequence[Recording], vehicle: Vehicle) -> list[Answer]:
    """Results of the recordings with commands and speeds."""
    return [a for a in (_of_one(recording, vehicle) for recording in recordings) if a is not None]


def response(found: Sequence[Answer]) -> Response | None:
    """Lag and delay by all recordings together; None if no recording determines them."""
    known = [(r.best, np.linalg.inv(r.covariance)) for r in found if r.covariance is not None]
    if not known:
        return None
    covariance = np.linalg.inv(sum(information for _, information in known))
    lag, delay = covariance @ sum(information @ best for best, information in known)
    sd = np.array([ROTOR_RESPONSE.lag_sd * lag, ROTOR_RESPONSE.delay_sd])
    usual = np.outer(sd, sd) * np.array([[1.0, ROTOR_RESPONSE.correlation], [ROTOR_RESPONSE.correlation, 1.0]])
    return Response(float(lag), float(delay), covariance + usual)


def unresponsive_rotor(found: Sequence[Answer]) -> Finding | None:
    """The rotor that follows its command worse than the others do, in all recordings; None if there is none."""
    if not found:
        return None
    power = np.array([np.mean(r.left**2, axis=1) for r in found])
    ratio = np.array([[p[k] / np.median(np.delete(p, k)) for k in range(4)] for p in power])
    rotor = int(np.argmax(ratio.min(axis=0)))
    least = ratio[:, rotor]
    if least.min() < ROTOR_RESPONSE.max_residual:
        return None
    samples_of = np.array([r.left.shape[1] / ROTOR_RESPONSE.independent for r in found])
    nats = float(np.sum(0.5 * samples_of * (least - 1.0 - np.log(least))))
    size = float(np.sqrt(power[0, rotor]))
    sd = size / float(np.sqrt(2.0 * samples_of[0]))
    where = f"rotor {rotor + 1} does not follow its command"
    return Finding("force", "z", where, "rotor", found[0].span, size, sd, "N", nats, float(np.exp(-min(nats, 700.0))))


def _of_one(recording: Recording, vehicle: Vehicle) -> Answer | None:
    """Result of one recording; None if commands or speeds are missing or too slow."""
    air = airtime(recording)
    if vehicle.rotor_constant is None or not air.flown:
        return None
    if any(n not in recording.signals for n in ("motor_command", "rotor_speed")):
        return None
    time, command = samples(recording, "motor_command")
    when, speed = samples(recording, "rotor_speed")
    if (
        when.size < ROTOR_RESPONSE.min_samples
        or time.size < ROTOR_RESPONSE.min_samples
        or float(np.median(np.diff(when))) > ROTOR_RESPONSE.max_period
    ):
        return None
    begin = max(air.flown[0][0] + RECORDINGS.edge, when[0] + ROTOR_RESPONSE.max_delay)
    end = min(air.flown[-1][1] - RECORDINGS.edge, when[-1] - ROTOR_RESPONSE.max_delay)
    inside = (time > begin) & (time < end)
    if inside.sum() < ROTOR_RESPONSE.min_samples:
        return None
    at, wanted = time[inside], command[inside].astype(float)
    step = float(np.median(np.diff(at)))
    if step > ROTOR_RESPONSE.max_period or not np.all(np.std(wanted, axis=0) > 0):
        return None
    thrust = CubicSpline(when, thrust_from_speed(speed, rotor_constant=vehicle.rotor_constant))
    volts, measured = samples(recording, "voltage")
    wanted = wanted * _voltage(volts, measured[:, 0], at, thrust)[:, None] if volts.size > 1 else wanted
    equation = _LagEquation.of(at, wanted, thrust, step)
    min_delay = -ROTOR_RESPONSE.spline_reach * step  # below, instruments share errors with e
    bounds = (
        np.array([ROTOR_RESPONSE.min_lag, min_delay]),
        np.array([ROTOR_RESPONSE.max_lag, ROTOR_RESPONSE.max_delay]),
    )
    tries = [
        least_squares(equation.moments, [s, 0.0], bounds=bounds, x_scale=[0.01, 0.01], diff_step=1e-3)
        for s in ROTOR_RESPONSE.start_lags
    ]
    best = min(tries, key=lambda t: float(t.cost))
    plain, _ = equation.errors(best.x)
    free = best.fun.size - best.x.size - 4 * equation.shapes.shape[3]
    variance = max(float(np.mean(plain**2)), 2.0 * best.cost / free)  # the second is larger if errors have a memory
    known = volts.size > 1 and np.linalg.matrix_rank(best.jac) == 2 and equation.strength(best.x) > ROTOR_RESPONSE.min_f
    covariance = variance * np.linalg.inv(best.jac.T @ best.jac) if known else None
    return Answer(best.x, covariance, _command_residuals(at, wanted, thrust, step), (float(at[0]), float(at[-1])))


def _voltage(when: NDArray, volts: NDArray, at: NDArray, thrust: CubicSpline) -> NDArray:
    """Voltage (n,) [V] at times (n,) s, from samples (k,) at times (k,) s: a slow trend, and a drop under the load.

    A battery is measured at 10 Hz or less, but its voltage follows the current at once. The current goes with the power
    of all rotors.
    """
    new = np.flatnonzero(np.diff(volts) != 0.0) + 1
    new = new[(when[new] > at[0]) & (when[new] < at[-1])]

    def regressors(times: NDArray) -> NDArray:
        load = np.maximum(thrust(times), 0.0) ** 1.5
        trend = np.polynomial.legendre.legvander(2.0 * (times - at[0]) / (at[-1] - at[0]) - 1.0, 3)
        return np.column_stack([trend, load.mean(axis=1)])

    if new.size < ROTOR_RESPONSE.min_voltages:
        return np.interp(at, when, volts)
    fit = np.linalg.lstsq(regressors(when[new]), volts[new], rcond=None)[0]
    return regressors(at) @ fit


def _command_residuals(at: NDArray, wanted: NDArray, thrust: CubicSpline, step: float) -> NDArray:
    """(4, n) N: residuals of commands (n, 4) at times (n,) s, regressed on the thrusts around."""
    near = thrust(at[:, None] + step * np.arange(*ROTOR_RESPONSE.near))  # (n, samples, 4)
    shapes = _high_pass(np.concatenate([near, near[:, :1] ** 2 / near.mean()], axis=1), step)
    fast, left = _high_pass(wanted, step), []
    for rotor in range(4):
        fit = np.linalg.lstsq(shapes[:, :, rotor], fast[:, rotor], rcond=None)[0]
        slope = fit[:-1].sum() + 2.0 * fit[-1] * near[:, 0, rotor].mean() / near.mean()
        left.append((fast[:, rotor] - shapes[:, :, rotor] @ fit) / slope)
    return np.stack(left)


@dataclass(frozen=True, eq=False)
class _LagEquation:
    """Equation of the first-order lag of thrusts over their mean on a grid of times, and its instruments.

    Attributes:
        grid: (n,) s, every `step`. thrust: at any time (m,) [s] -> (m, 4) N. mean: (4,) N.
        shapes: (parts, n, 4, 2) command and its square at the start of each part of a step. row: (m,) start rows of
            the equation, which ends `steps` rows later.
        instruments: (4, m, p) orthonormal.
    """

    grid: NDArray
    step: float
    steps: int
    thrust: CubicSpline
    mean: NDArray
    shapes: NDArray
    row: NDArray
    instruments: NDArray

    @classmethod
    def of(cls, at: NDArray, wanted: NDArray, thrust: CubicSpline, step: float) -> "_LagEquation":
        """The equation of commands (k, 4) at times (k,) s and of thrusts."""
        grid = np.arange(at[0], at[-1], step)
        parts = max(1, round(step / ROTOR_RESPONSE.command_period))
        command = CubicSpline(at, wanted / wanted.mean(axis=0))
        fine = [command(grid + i / parts * step) for i in range(parts)]
        shapes = np.stack([_high_pass(np.stack([u, u**2], 2), step) for u in fine])
        mean = thrust(grid).mean(axis=0)
        steps = max(1, round(ROTOR_RESPONSE.spacing / step))
        edge = round(RECORDINGS.edge / step)  # transients of the high-pass
        row = np.arange(edge + ROTOR_RESPONSE.instruments, grid.size - edge - steps)
        changes = _high_pass(thrust(grid) / mean, step)
        before = np.roll(changes, ROTOR_RESPONSE.spline_reach, axis=0)  # samples without influence on f(t + d)
        earlier = np.concatenate([_high_pass(command(grid), step), before], axis=1)
        past = np.stack([earlier[row - j] for j in range(1, ROTOR_RESPONSE.instruments + 1)], 2)  # (m, 8, j)
        instruments = [np.linalg.qr(past[:, (r, r + 4)].reshape(row.size, -1))[0] for r in range(4)]
        return cls(grid, step, steps, thrust, mean, shapes, row, np.stack(instruments))

    def errors(self, x: NDArray) -> tuple[NDArray, NDArray]:
        """(4, m) errors e for a lag and a delay [s], and (4, p) their projections on the instruments."""
        keep, parts = np.exp(-self.step / x[0]), len(self.shapes)
        part = np.exp(-self.step / parts / x[0])
        now = _high_pass(self.thrust(self.grid + x[1]) / self.mean, self.step)
        change = now[self.row + self.steps] - keep**self.steps * now[self.row]
        of_step = sum((1.0 - part) * part ** (parts - 1 - i) * self.shapes[i] for i in range(parts))
        regressors = sum(keep ** (self.steps - 1 - j) * of_step[self.row + j] for j in range(self.steps))
        plain, projected = [], []
        for rotor, q in enumerate(self.instruments):
            target, projection = q.T @ change[:, rotor], q.T @ regressors[:, rotor]
            gains = np.linalg.lstsq(projection, target, rcond=None)[0]
            plain.append(change[:, rotor] - regressors[:, rotor] @ gains)
            projected.append(target - projection @ gains)
        return np.stack(plain), np.stack(projected)

    def moments(self, x: NDArray) -> NDArray:
        """(4 p,) projections of e, which are 0 on average at the true lag and delay."""
        return self.errors(x)[1].ravel()

    def strength(self, x: NDArray) -> float:
        """First-stage F statistic of the instruments, in their weakest direction of lag and delay."""
        little = 1e-4  # s
        base = self.errors(x)
        change = [tuple((a - b) / little for a, b in zip(self.errors(x + d), base)) for d in little * np.eye(2)]
        whole, explained = (np.stack([c[k].ravel() for c in change], 1) for k in (0, 1))
        unexplained = (whole.T @ whole - explained.T @ explained) / len(whole)
        return float(eigh(explained.T @ explained, unexplained, eigvals_only=True)[0]) / len(explained)


def _high_pass(values: NDArray, step: float) -> NDArray:
    """Values (n, ...) every `step` s without frequencies below `ROTOR_RESPONSE.min_frequency`."""
    return np.asarray(
        sosfiltfilt(butter(2, ROTOR_RESPONSE.min_frequency * 2 * step, "high", output="sos"), values, axis=0)
    )


@dataclass(frozen=True)
class Late:
    """Difference of the rotors from the vehicle file.

    Attributes:
        values: effect (`LAG`, `DELAY`), if it differs -> value and standard deviation [s].
        nats, held_out: gain on the recordings and on the held-out ones.
        alike: whether lag alone and delay alone explain the difference equally well.
    """

    values: dict[str, tuple[float, float]]
    nats: float
    held_out: float
    alike: bool


def late_response(found: Response, apart: Response | None, vehicle: Vehicle) -> Late | None:
    """Lag or delay that differ from the vehicle file; None if both agree with it, or if held-out flights contradict.

    Args:
        found: by the recordings. apart: by the held-out ones; None if there are none or they do not determine it.
    """
    file = (vehicle.motor_time_constant, float(vehicle.effects.get(DELAY, {}).get("delay", 0.0)))
    (lag_lag, both), (_, late_late) = found.covariance.tolist()
    # each alone, the other as in the file: the most likely value, its standard deviation, and its log-likelihood
    lag = found.lag + both / late_late * (file[1] - found.delay)
    delay = found.delay + both / lag_lag * (file[0] - found.lag)
    alone = {
        LAG: (lag, float(np.sqrt(lag_lag - both**2 / late_late)), found.nats(lag, file[1])),
        DELAY: (delay, float(np.sqrt(late_late - both**2 / lag_lag)), found.nats(file[0], delay)),
    }
    nothing = found.nats(*file)
    name = max(alone, key=lambda n: alone[n][2])
    if -nothing < SELECTION.min_evidence:
        return None
    if -alone[name][2] > SELECTION.min_evidence and found.delay > file[1]:
        values = {LAG: (found.lag, lag_lag**0.5), DELAY: (found.delay, late_late**0.5)}
        at, nats = (found.lag, found.delay), -nothing
    else:
        if delay < file[1]:
            name = LAG  # no rotor answers before its command
        values = {name: alone[name][:2]}
        at = (lag, file[1]) if name == LAG else (file[0], delay)
        nats = alone[name][2] - nothing
    if nats < SELECTION.min_evidence:
        return None
    if apart is not None and -apart.nats(*at) > SELECTION.min_evidence:
        return None
    held = nats if apart is None else apart.nats(*at) - apart.nats(*file)
    surer = float(expit(abs(alone[LAG][2] - alone[DELAY][2])))
    alike = len(values) == 1 and delay > file[1] and surer < 1.0 - CONFIDENCE.min_look_alike
    return Late(values, nats, held, alike) if held > SELECTION.min_evidence / 2 else None
