"""The vehicle of a recording and the signal from which its thrust is computed, or the reason why there is none.

`info`, `replay` and `diagnose` use the same signal and refuse for the same reason. `diagnose` accepts more: also
requests and mixer commands, and recordings without a voltage.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from crazyem.physics import folding
from crazyem.physics.rotors import wrench_from_command, wrench_from_speed
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import Array, held, sound_samples
from crazyem.recordings.recording import Recording
from crazyem.vehicle import GRAVITY, Vehicle, load_vehicle, preset_names

# s; longest interval between samples of a command or rotor speed. Rotors lag by 30 to 70 ms, so their thrust between
# samples further apart is unknown.
LONGEST_INPUT_INTERVAL = 0.1
LARGEST_THRUST_RATIO = 2.0  # thrust over the largest thrust in the vehicle file; larger samples are left out
ASSUMED_VOLTAGE = 3.7  # V, where none is logged
UNKNOWN_VOLTAGE_ERROR = 0.15  # relative error of thrust: a cell has 3.2 to 4.2 V, thrust grows with its square
FLAT_VOLTAGE_SECONDS = 5.0  # s in the air over which the voltage of a battery changes by more than its resolution
# Thrust in the air over the weight of the vehicle that a payload can explain: a Crazyflie of 29 g carries 15 g.
LARGEST_CARRIED_RATIO = 1.5
_QUADROTOR, _ROTORCRAFT = "2", {"2", "3", "4", "13", "14", "15", "29", "35", "43"}  # MAV_TYPE, of lift by rotors alone
_THRUST_LAWS = {"rotor_speed": "rotor_constant", "motor_command": "thrust_curve"}


def vehicle_for(recording: Recording, given: str | None = None) -> Vehicle:
    """The given vehicle, else the vehicle stored in the recording, else a vehicle by the signals of the recording.

    The last is cf21bl if rotor speeds are measured (brushless motors report them), else cf2.

    Raises: as `crazyem.physics.folding.load`.
    """
    if given:
        return folding.load(given)
    stored = recording.metadata.get("vehicle", {}).get("toml")
    if stored:
        return folding.parse(stored, where=f"vehicle in {recording.path}")
    speed = recording.signals.get("rotor_speed")
    return folding.load("cf21bl" if speed is not None and speed.value.any() else "cf2")


def kind_objection(recording: Recording) -> str:
    """Why the models do not fit this kind of vehicle; "" if they fit or the kind is unknown."""
    told = recording.metadata.get("vehicle", {})
    if told.get("mav_type", _QUADROTOR) == _QUADROTOR:
        return ""
    kind = told.get("kind", "vehicle of another kind")
    return f"{'an' if kind[:1] in 'aeiou' else 'a'} {kind}, by its autopilot; the models here are of quadrotors"


def is_rotorcraft(recording: Recording) -> bool:
    """Whether rotors alone lift the vehicle; True if its kind is unknown."""
    return recording.metadata.get("vehicle", {}).get("mav_type", _QUADROTOR) in _ROTORCRAFT


def too_slow(recording: Recording, name: str) -> str:
    """Why the rate of a command or rotor speed is too low to give the thrust; "" if it is high enough."""
    found = _measured(recording, name)
    if found is None or found[0].size < 3:
        return ""
    period = float(np.median(np.diff(found[0])))
    if period <= LONGEST_INPUT_INTERVAL:
        return ""
    longest = f"at most {LONGEST_INPUT_INTERVAL:g} s"
    return f"{name} at {1.0 / period:.2g} Hz is too slow: steps of {period:.2g} s are gaps ({longest})"


def signal_for(recording: Recording, vehicle: Vehicle) -> tuple[str, str]:
    """(signal that gives the thrust of this vehicle, ""), or ("", why there is none, one clause)."""
    other = kind_objection(recording)
    if other:
        return "", other
    why = []
    for name in ("rotor_speed", "motor_command", "wrench_command"):
        if name not in recording.signals or not recording.signals[name].time.size:
            continue
        if _measured(recording, name) is None:
            why.append(f"{name} holds no numbers, or only zeros: no sensor is connected")
        elif slow := too_slow(recording, name):
            why.append(slow)
        elif name in _THRUST_LAWS and not getattr(vehicle, law := _THRUST_LAWS[name]):
            have = [preset for preset in preset_names() if getattr(load_vehicle(preset), law)]
            no_law = f"{name} is recorded, but not the thrust it gives: vehicle {vehicle.name} has no {law}"
            why.append(f"{no_law} (--vehicle {' or '.join(have)} has one)")
        else:
            return name, ""
    if why:
        return "", "; ".join(why)
    if "motor_request" in recording.signals or "mixer_command" in recording.signals:
        return "", "only what was asked of the rotors is known, not the duty that was sent to them"
    absent = recording.metadata.get("not_measured", {}).get("rotor_speed", "")
    return "", "there are no motor commands, rotor speeds or commanded thrust" + (f" ({absent})" if absent else "")


def _measured(recording: Recording, name: str) -> tuple[Array, Array] | None:
    """Times (n,) and values (n, c) of a signal; None without numbers or without a connected sensor (all 0)."""
    array = recording.signals.get(name)
    found = None if array is None else sound_samples(array)
    unconnected = found is not None and name in ("rotor_speed", "voltage") and not found[1].any()
    return None if unconnected else found


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Wrench of the rotors: time (n,) s, wrench (n, 4) N and N m, its signal, whether rotor lag must be added."""

    time: Array
    wrench: Array
    signal: str
    lagged: bool
    voltage_known: bool


def flat_voltage(recording: Recording, air: Airtime) -> bool:
    """Whether the voltage is constant in a flight of 5 s or more, which a battery voltage never is."""
    voltage = _measured(recording, "voltage")
    if voltage is None or not air.known or air.seconds < FLAT_VOLTAGE_SECONDS:
        return False
    flying = voltage[1][air.covers(voltage[0]), 0]
    return flying.size > 1 and bool((flying == flying[0]).all())


def inputs_of(recording: Recording, vehicle: Vehicle) -> Inputs | str:
    """The wrench for the estimator, or the reason why there is none."""
    name, why = signal_for(recording, vehicle)
    if not name:
        return why
    found = _measured(recording, name)
    assert found is not None
    time, value = found
    if name == "rotor_speed":
        return _sane(Inputs(time, wrench_from_speed(value, vehicle), name, False, True), vehicle)
    lagged = vehicle.motor_time_constant > 0
    if name == "wrench_command":
        return Inputs(time, value, name, lagged, True)
    voltage = _measured(recording, "voltage")
    volts = np.full(time.size, ASSUMED_VOLTAGE) if voltage is None else held(voltage[0], voltage[1][:, 0], time)
    return _sane(Inputs(time, wrench_from_command(value, volts, vehicle), name, lagged, voltage is not None), vehicle)


def _sane(inputs: Inputs, vehicle: Vehicle) -> Inputs:
    """The inputs without samples of impossibly large thrust and without samples whose time does not increase."""
    good = (inputs.wrench[:, 0] < LARGEST_THRUST_RATIO * 4.0 * vehicle.thrust_max) & (
        np.diff(inputs.time, prepend=-np.inf) > 0
    )
    return inputs if good.all() else replace(inputs, time=inputs.time[good], wrench=inputs.wrench[good])


def carried(recording: Recording, vehicle: Vehicle, air: Airtime) -> float:
    """Median thrust in the air over the weight of the vehicle; NaN if unknown."""
    name, _ = signal_for(recording, vehicle)
    inputs = inputs_of(recording, vehicle) if name else ""
    if isinstance(inputs, str) or not inputs.voltage_known or not air.known:
        return math.nan
    rows = air.covers(inputs.time)
    return float(np.median(inputs.wrench[rows, 0])) / (vehicle.mass * GRAVITY) if rows.any() else math.nan


def weight_objection(recording: Recording, vehicle: Vehicle, air: Airtime) -> str:
    """A clause with the ratio of thrust to weight if it is far from 1 for this vehicle; else ""."""
    ratio = carried(recording, vehicle, air)
    if math.isnan(ratio) or 1.0 / LARGEST_CARRIED_RATIO <= ratio <= LARGEST_CARRIED_RATIO:
        return ""
    never = "never carry its weight: they carry" if ratio < 1.0 else "carry"
    return f"by vehicle {vehicle.name} the rotors {never} {ratio:.2g} times the weight in the air; is it this vehicle?"
