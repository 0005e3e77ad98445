"""How fast measured rotors follow their commands: lag and delay, where both are recorded.

With measured speeds the model needs neither, so the flight says nothing of them; commands and speeds do. Commands are
sampled, so what is logged is what acted plus an error; a regression of speeds on commands would make the lag too short
(errors in the variables, 10 to 15 %). Speeds have hardly any error, so commands are regressed on them: over a sample h
about a stamp, a first-order lag of the thrust f answers to

    u = g( (f(t + d + h/2) - k f(t + d - h/2)) / (1 - k) ),  k = exp(-h / lag),

with g a parabola, the same within a flight, each rotor its own. The slow part is left out: it is the battery's.

What this leaves of a rotor's command is what the rotor does not follow. Three of four rotors leave the same; one that
sticks, slips or misfires leaves more.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

from crazyem.diagnosis.flights.inputs import samples
from crazyem.diagnosis.locating.locate import Finding
from crazyem.physics.rotors import thrust_from_speed
from crazyem.recordings.airborne import airtime
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

SLOW = 0.5  # Hz, below which the battery's state is all there is to see
FASTEST = 0.025  # s between samples, at most
FEWEST = 400  # samples
EDGE = 0.5  # s left out at either end of a flight
STARTS = (0.01, 0.03, 0.08)  # s
SHORTEST, LONGEST, LATEST = 2e-3, 0.5, 0.1  # s
EXPLAINED = 0.8  # share of the commands' variance
# 14 flights of seven random worlds (seed 5050) with true lags and delays: lags of +5 +- 9 %, delays of -0.6 +- 1.3 ms.
PUNCTUAL = -0.6e-3  # s
LAG_SD, DELAY_SD, TOGETHER = 0.1, 1.4e-3, -0.5  # relative; s; correlation
# Power of what a rotor leaves over that of the middle one of the others, in every recording that tells: up to 1.2 in 13
# simulated drones, 5.5 and more in ten flights of five with a rotor that sticks within 1.4 to 5 % of full command.
DISOBEYS = 3.0
INDEPENDENT = 10.0  # samples that say what one does
ENOUGH, CLOSE = 8.0, 4.0  # nats to be named; nats within which lag and delay are not told apart


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
    """What one recording says: best (2,) lag and delay [s], their covariance by scatter, left (4, n) N, thrust that
    each rotor was told and did not give, span of time [s]."""

    best: NDArray
    covariance: NDArray
    left: NDArray
    span: tuple[float, float]


def answers(recordings: Sequence[Recording], vehicle: Vehicle) -> list[Answer]:
    """Of the recordings that have both commands and speeds, of which one tells the other."""
    return [a for a in (_of_one(recording, vehicle) for recording in recordings) if a is not None]


def response(found: Sequence[Answer]) -> Response | None:
    """Of all recordings together; None where none tells."""
    if not found:
        return None
    information = sum(np.linalg.inv(r.covariance) for r in found)
    covariance = np.linalg.inv(information)
    lag, delay = covariance @ sum(np.linalg.solve(r.covariance, r.best) for r in found)
    delay -= PUNCTUAL
    sd = np.array([LAG_SD * lag, DELAY_SD])
    usual = np.outer(sd, sd) * np.array([[1.0, TOGETHER], [TOGETHER, 1.0]])
    return Response(float(lag), float(delay), covariance + usual)


def disobedient(found: Sequence[Answer]) -> Finding | None:
    """The rotor that does not follow its command as the others do theirs, in all recordings that tell; None: none."""
    if not found:
        return None
    power = np.array([np.mean(r.left**2, axis=1) for r in found])
    ratio = np.array([[p[k] / np.median(np.delete(p, k)) for k in range(4)] for p in power])
    rotor = int(np.argmax(ratio.min(axis=0)))
    least = ratio[:, rotor]
    if least.min() < DISOBEYS:
        return None
    samples_of = np.array([r.left.shape[1] / INDEPENDENT for r in found])
    nats = float(np.sum(0.5 * samples_of * (least - 1.0 - np.log(least))))
    size = float(np.sqrt(power[0, rotor]))
    sd = size / float(np.sqrt(2.0 * samples_of[0]))
    where = f"rotor {rotor + 1} does not follow its command"
    return Finding("force", "z", where, "rotor", found[0].span, size, sd, "N", nats, float(np.exp(-min(nats, 700.0))))


def _of_one(recording: Recording, vehicle: Vehicle) -> Answer | None:
    """Of one recording; None where it does not tell."""
    air = airtime(recording)
    if vehicle.rotor_constant is None or not air.flown:
        return None
    if any(n not in recording.signals for n in ("motor_command", "rotor_speed")):
        return None
    time, command = samples(recording, "motor_command")
    when, speed = samples(recording, "rotor_speed")
    if when.size < FEWEST or time.size < FEWEST or float(np.median(np.diff(when))) > FASTEST:
        return None
    begin = max(air.flown[0][0] + EDGE, when[0] + LATEST)
    end = min(air.flown[-1][1] - EDGE, when[-1] - LATEST)
    inside = (time > begin) & (time < end)
    if inside.sum() < FEWEST:
        return None
    at, wanted = time[inside], command[inside].astype(float)
    volts, known = samples(recording, "voltage")
    if volts.size > 1:  # a rotor answers to duty times voltage, and a loaded battery gives the less the more they pull
        wanted = wanted * np.interp(at, volts, known[:, 0])[:, None]
    step = float(np.median(np.diff(at)))
    if step > FASTEST:
        return None
    sections = butter(2, SLOW * 2 * step, "high", output="sos")
    wanted = sosfiltfilt(sections, wanted, axis=0)
    size = np.sqrt(np.mean(wanted**2, axis=0))
    if not np.all(size > 0):
        return None
    thrust = CubicSpline(when, thrust_from_speed(speed, rotor_constant=vehicle.rotor_constant))

    def missed(x: NDArray) -> tuple[NDArray, NDArray]:
        """(4, n) what is left of the commands, and (4,) commands per newton at the mean thrust."""
        keep = np.exp(-step / x[0])
        answer = (thrust(at + x[1] + step / 2) - keep * thrust(at + x[1] - step / 2)) / (1.0 - keep)
        mean = answer.mean(axis=0)
        shapes = sosfiltfilt(sections, np.stack([answer / mean, (answer / mean) ** 2], 2), axis=0)
        out, slope = [], []
        for rotor in range(4):
            fit = np.linalg.lstsq(shapes[:, rotor], wanted[:, rotor], rcond=None)[0]
            out.append(wanted[:, rotor] - shapes[:, rotor] @ fit)
            slope.append((fit[0] + 2.0 * fit[1]) / mean[rotor])
        return np.stack(out), np.array(slope)

    def left(x: NDArray) -> NDArray:
        return (missed(x)[0] / size[:, None]).ravel()

    bounds = (np.array([SHORTEST, -LATEST]), np.array([LONGEST, LATEST]))
    tries = [
        least_squares(left, [s, 0.0], bounds=bounds, x_scale=[0.01, 0.01], diff_step=[1e-3, 1e-3], method="trf")
        for s in STARTS
    ]
    best = min(tries, key=lambda t: float(t.cost))
    variance = 2.0 * best.cost / best.fun.size
    if variance > 1.0 - EXPLAINED or np.linalg.matrix_rank(best.jac) < 2:
        return None
    commands, slope = missed(best.x)
    if not np.all(np.abs(slope) > 0):
        return None
    covariance = variance * np.linalg.inv(best.jac.T @ best.jac)
    return Answer(best.x, covariance, commands / slope[:, None], (float(at[0]), float(at[-1])))


@dataclass(frozen=True)
class Late:
    """How rotors differ from the vehicle's: values and standard deviations [s] of "motor_lag" and "input_delay", those
    that differ; nats on the recordings and on those held out; whether one alone would explain it as well as the other.
    """

    values: dict[str, tuple[float, float]]
    nats: float
    held_out: float
    alike: bool


def late_response(found: Response, apart: Response | None, vehicle: Vehicle) -> Late | None:
    """What of it is not as the vehicle file says; None where all is, or where flights held out do not agree.

    Args:
        found: of the recordings; apart: of those held out, None where there are none or they do not tell.
    """
    file = (vehicle.motor_time_constant, float(vehicle.effects.get("input_delay", {}).get("delay", 0.0)))
    (lag_lag, both), (_, late_late) = found.covariance.tolist()
    # each alone, the other as in the file: the most likely value, its standard deviation, and what it explains
    lag = found.lag + both / late_late * (file[1] - found.delay)
    delay = found.delay + both / lag_lag * (file[0] - found.lag)
    alone = {
        "motor_lag": (lag, float(np.sqrt(lag_lag - both**2 / late_late)), found.nats(lag, file[1])),
        "input_delay": (delay, float(np.sqrt(late_late - both**2 / lag_lag)), found.nats(file[0], delay)),
    }
    nothing = found.nats(*file)
    name = max(alone, key=lambda n: alone[n][2])
    if -nothing < ENOUGH:
        return None
    if -alone[name][2] > ENOUGH and found.delay > file[1]:
        values = {"motor_lag": (found.lag, lag_lag**0.5), "input_delay": (found.delay, late_late**0.5)}
        at, nats = (found.lag, found.delay), -nothing
    else:
        if delay < file[1]:
            name = "motor_lag"  # no rotor answers before it is told to
        values = {name: alone[name][:2]}
        at = (lag, file[1]) if name == "motor_lag" else (file[0], delay)
        nats = alone[name][2] - nothing
    if nats < ENOUGH:
        return None
    if apart is not None and -apart.nats(*at) > ENOUGH:
        return None
    held = nats if apart is None else apart.nats(*at) - apart.nats(*file)
    alike = len(values) == 1 and delay > file[1] and abs(alone["motor_lag"][2] - alone["input_delay"][2]) < CLOSE
    return Late(values, nats, held, alike) if held > ENOUGH / 2 else None
