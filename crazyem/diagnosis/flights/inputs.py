"""Commands or measured speeds of the rotors of a recorded flight, as the rotor input of the model with effects.

The choice of the signal is made here alone: measured speeds before commands, commands with voltage before those
without, sent commands before requested ones. Nothing is resampled; stamps are those of the recording.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.alignment import Alignment, align
from crazyem.diagnosis.flights.level import Level, level_of
from crazyem.diagnosis.settings import RECORDINGS
from crazyem.errors import DataError
from crazyem.physics.motion import RotorInput
from crazyem.physics.rotors import thrust_from_command, thrust_from_speed, wrench
from crazyem.recordings.airborne import LARGEST_COMMAND, Airtime, airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording, onboard_estimate
from crazyem.recordings.thrust import kind_objection, signal_for, too_slow
from crazyem.vehicle import Vehicle

_SAMPLED = ("motor_command", "motor_request", "mixer_command")
FULL = 65535.0  # counts of PWM

_SANE = {**LARGEST_COMMAND, "wrench_command": 1e3, "mixer_command": 1e6}  # as `LARGEST_COMMAND`, SI and counts

# Requested thrust -> motor volts, in the battery compensation of crazyflie-firmware until 2022-11 (motors.c): grams of
# thrust of all four motors, then a parabola.
_GRAMS, _VOLTS = 60.0, (0.088, -0.0006239)


@dataclass(frozen=True, eq=False)
class Inputs:
    """Rotor input of a recording.

    Attributes:
        rotor: see `RotorInput`.
        signal: the signal that it is made from.
        vehicle: the vehicle to use with this input. A vehicle without rotors gets stand-ins for arm and torque per
            thrust, so that four thrusts represent the thrust and the torque of its input.
        notices: assumptions, a sentence each.
        ground: height of the floor in the frame of the position [m]; 0 where unknown.
        took_off: time of the first take-off [s]; of the first input where unknown.
        alignment: delay of measured rotor speeds behind the body rates in this recording; None where unknown.
        level: the voltage estimated from the flight, if none is recorded; else None.
        fused: whether the recorded attitude, or without one the velocity, comes from a filter on board.
    """

    rotor: RotorInput
    signal: str
    vehicle: Vehicle
    notices: tuple[str, ...]
    ground: float
    took_off: float
    alignment: Alignment | None = None
    level: Level | None = None
    fused: bool = False


def inputs_of(
    recording: Recording, vehicle: Vehicle, *, flight: Airtime | None = None, until: float = np.inf
) -> Inputs:
    """The rotor input of a vehicle from a recording.

    Args:
        recording: of any format.
        vehicle: decides which signals can become thrust.
        flight: `airtime(recording)`, if already known.
        until: s, end of the flight from which a voltage that is not recorded is estimated (see `level_of`); too early
            for an estimate, the voltage is nominal.

    Raises:
        DataError: the recording has no signal that this vehicle can turn into thrust.
    """
    if other := kind_objection(recording):
        raise DataError(f"{recording.path}: {other}.")
    for name, read in _CHOICES:
        if too_slow(recording, name):
            continue
        time, value = samples(recording, name)
        found = read(recording, vehicle, time, value) if time.size >= 2 else None
        if found is not None and found.time.size >= 2:
            break
    else:
        raise DataError(f"{recording.path}: nothing says what the rotors did: {signal_for(recording, vehicle)[1]}.")
    flight = airtime(recording) if flight is None else flight
    took_off = flight.flown[0][0] if flight is not None and flight.flown else float(found.time[0])
    ground = flight.ground if flight is not None and np.isfinite(flight.ground) else 0.0
    level = None
    if found.sent is not None:
        level = level_of(
            recording, vehicle, flight, found.time, found.sent, nominal=RECORDINGS.nominal_voltage, until=until
        )
        found = found if level is None else _sent(vehicle, found.time, found.sent, level)
    alignment = align(recording, found.time, found.thrust, flight) if name == "rotor_speed" else None
    late = RECORDINGS.command_delay if name in _SAMPLED else alignment.delay if alignment is not None else 0.0
    if name in _SAMPLED and "attitude" in recording.signals:
        late -= RECORDINGS.rate_delay
    notices = found.notices if alignment is None else (*found.notices, alignment.description())
    rotor = RotorInput(
        found.time,
        np.ascontiguousarray(found.thrust),
        found.voltage,
        np.maximum(found.time - took_off, 0.0),
        measured=name == "rotor_speed",
        delay=late,
    )
    fused = onboard_estimate(recording)
    return Inputs(rotor, name, found.vehicle or vehicle, notices, ground, took_off, alignment, level, fused)


@dataclass(frozen=True, eq=False)
class _Found:
    time: NDArray[np.float64]
    thrust: NDArray[np.float64]  # (m, 4) N
    voltage: NDArray[np.float64]  # (m,) V
    notices: tuple[str, ...] = ()
    vehicle: Vehicle | None = None  # if it differs from the given one
    sent: NDArray[np.float64] | None = None  # (m, 4) duty where no voltage is recorded


_Array = NDArray[np.float64]


def samples(recording: Recording, name: str) -> tuple[_Array, _Array]:
    """Complete samples of a signal with increasing stamps; of several with the same stamp, the first."""
    array = recording.signals.get(name)
    if array is None:
        return np.empty(0), np.empty((0, 1))
    time, value = ordered(array)
    sound = np.abs(value).max(axis=1, initial=0.0) < _SANE.get(name, np.inf)
    time, value = time[sound], value[sound]
    later = np.ones(time.size, bool)
    later[1:] = np.diff(time) > 0
    return time[later], value[later]


def _voltage(recording: Recording, time: _Array) -> _Array:
    """(m,) V, the newest voltage at each stamp; NaN before the first one."""
    when, volts = samples(recording, "voltage")
    sound = (volts[:, 0] > 0.5) & (volts[:, 0] < 60.0)
    when, volts = when[sound], volts[sound, 0]
    if not when.size:
        return np.full(time.size, np.nan)
    at = np.searchsorted(when, time, "right") - 1
    return np.where(at >= 0, volts[np.maximum(at, 0)], np.nan)


def _from_speed(recording: Recording, vehicle: Vehicle, time: _Array, value: _Array) -> _Found | None:
    if vehicle.rotor_constant is None or not value.any():
        return None
    thrust = thrust_from_speed(value, rotor_constant=vehicle.rotor_constant)
    return _Found(time, thrust, _voltage(recording, time))


def _from_command(recording: Recording, vehicle: Vehicle, time: _Array, value: _Array) -> _Found | None:
    """Thrust from sent commands with the recorded voltage."""
    if not vehicle.thrust_curve:
        return None
    voltage = _voltage(recording, time)
    known = np.isfinite(voltage)  # before the first voltage, the thrust of a command is unknown
    if not known.any():
        return None
    time, value, voltage = time[known], value[known], voltage[known]
    return _Found(time, thrust_from_command(value, voltage, thrust_curve=vehicle.thrust_curve), voltage)


def _from_command_alone(recording: Recording, vehicle: Vehicle, time: _Array, value: _Array) -> _Found | None:
    """Thrust from sent commands without a recorded voltage."""
    if not vehicle.thrust_curve:
        return None
    return _sent(vehicle, time, value, None)


def _sent(vehicle: Vehicle, time: _Array, value: _Array, level: Level | None) -> _Found:
    """Thrust from sent commands with an assumed or estimated voltage."""
    volts = RECORDINGS.nominal_voltage if level is None else level.voltage
    thrust = thrust_from_command(value, np.full(time.size, volts), thrust_curve=vehicle.thrust_curve)
    why = (
        f"{volts:g} V is assumed throughout, the middle of the 3.7 to 4.0 V of a loaded battery"
        if level is None
        else f"{volts:.2f} V is taken throughout, by which the thrust of the first seconds in the air carries the "
        "vehicle; how heavy or strong it is cannot be told from this recording"
    )
    notice = f"no battery voltage is recorded: {why}; a drift of thrust with time may be the battery's"
    return _Found(time, thrust, np.full(time.size, np.nan), (notice,), sent=value)


def _from_request(recording: Recording, vehicle: Vehicle, time: _Array, value: _Array) -> _Found | None:
    """Thrust from requests before the battery compensation, (m, 4) 0..1."""
    voltage = _voltage(recording, time)
    if recording.source == "ulog" and np.isfinite(vehicle.thrust_max):
        notice = f"motor_request is a share of the largest thrust: {vehicle.thrust_max:g} N of each rotor is assumed"
        return _Found(time, np.clip(value, 0.0, 1.0) * vehicle.thrust_max, voltage, (notice,))
    if not vehicle.thrust_curve:
        return None
    if not vehicle.battery_compensated:
        sent = np.clip(value, 0.0, 1.0)
        find = _from_command if np.isfinite(voltage).any() else _from_command_alone
        return find(recording, vehicle, time, sent)
    grams = _GRAMS * np.clip(value, 0.0, None)
    volts = np.clip(_VOLTS[0] * grams + _VOLTS[1] * grams**2, 0.0, np.where(np.isnan(voltage), 5.0, voltage)[:, None])
    thrust = thrust_from_command(volts, np.ones(time.size), thrust_curve=vehicle.thrust_curve)
    notice = (
        "the motor signal is the thrust asked for before battery compensation: motor volts follow from the "
        "compensation of the firmware of before 2022-11, which is taken to have been exact"
    )
    return _Found(time, thrust, voltage, (notice,))


def _from_mixer(recording: Recording, vehicle: Vehicle, time: _Array, value: _Array) -> _Found | None:
    """Thrust from the inputs of the mixer: thrust, roll, pitch, yaw in counts (power_distribution_stock.c)."""
    base, yaw = value[:, 0], value[:, 3]
    roll, pitch = np.trunc(value[:, 1] / 2.0), np.trunc(value[:, 2] / 2.0)
    mixed = np.stack(
        [base - roll + pitch + yaw, base - roll - pitch - yaw, base + roll - pitch + yaw, base + roll + pitch - yaw], 1
    )
    asked = np.where(base[:, None] > 0.0, np.clip(mixed, 0.0, FULL), 0.0) / FULL
    return _from_request(recording, vehicle, time, asked)


def _from_wrench(recording: Recording, vehicle: Vehicle, time: _Array, value: _Array) -> _Found | None:
    """Thrust from commanded thrust and torque, distributed to four rotors by the inverse of the mixing."""
    used = vehicle
    if min(*vehicle.arm, vehicle.torque_per_thrust) <= 0.0:
        used = replace(
            vehicle, arm=(RECORDINGS.stand_in_arm, RECORDINGS.stand_in_arm), torque_per_thrust=RECORDINGS.stand_in_arm
        )
    columns = wrench(np.eye(4), arm=used.arm, torque_per_thrust=used.torque_per_thrust)  # row: of one rotor
    thrust = np.linalg.solve(columns.T, value.T).T
    return _Found(time, thrust, _voltage(recording, time), vehicle=used)


# Signals in the order of preference.
_CHOICES: tuple[tuple[str, Callable[[Recording, Vehicle, _Array, _Array], _Found | None]], ...] = (
    ("rotor_speed", _from_speed),
    ("motor_command", _from_command),
    ("motor_request", _from_request),
    ("motor_command", _from_command_alone),
    ("mixer_command", _from_mixer),
    ("wrench_command", _from_wrench),
)
