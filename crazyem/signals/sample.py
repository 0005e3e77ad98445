"""One time-stamped sample of one signal in SI units: what links and recordings hand to the estimator."""

from dataclasses import dataclass

# name -> (number of components, unit, frame)
SIGNALS: dict[str, tuple[int, str, str]] = {
    "position": (3, "m", "world"),
    "velocity": (3, "m/s", "world"),
    "attitude": (4, "1", "quaternion x y z w, body (FLU) to world"),
    "body_rate": (3, "rad/s", "body FLU"),
    "specific_force": (3, "m/s^2", "body FLU"),
    "motor_command": (4, "1", "duty sent to rotors 1..4, after battery compensation, 0..1"),
    "rotor_speed": (4, "rad/s", "rotors 1..4"),
    "voltage": (1, "V", ""),
    "wrench_command": (4, "N, N m", "thrust and torque asked for by the controller, body FLU"),
    "setpoint_position": (3, "m", "world"),
    "setpoint_velocity": (3, "m/s", "world"),
    "flying": (1, "1", "1 while the firmware says that rotors turn, else 0"),
}


@dataclass(frozen=True, slots=True)
class Sample:
    """One value of one signal.

    Attributes:
        signal: a key of `SIGNALS`.
        time: seconds on the clock of the source (firmware clock for a drone), unwrapped.
        value: the components, SI; NaN where a component is missing.
        host_time: seconds since the epoch at which the host received it, NaN if unknown.
    """

    signal: str
    time: float
    value: tuple[float, ...]
    host_time: float = float("nan")
