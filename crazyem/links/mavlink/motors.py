"""Mapping from output channels to our rotors, and the scale of their values, from the autopilot's parameters.

Our rotors: 1 front right, 2 back right, 3 back left, 4 front left, 1 and 3 counter-clockwise. PX4's and ArduPilot's
motors of an X quad: 1 front right, 2 back left, 3 front left, 4 back right, 1 and 2 counter-clockwise.
Sources: PX4 airframes reference "Quadrotor x" and actuator parameters; ArduPilot "Connect ESCs and motors", Quad X.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

OUR_ROTOR_PLACES = (0, 3, 1, 2)  # of our rotors 1..4: index of the autopilot's motor
SHORTEST_PULSE, LONGEST_PULSE = 1000.0, 2000.0  # us, the usual range of pulses
_PX4_MOTOR, _ARDUPILOT_MOTOR = 101, 33  # value of a channel's function for motor 1
PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT


def wanted(autopilot: int) -> tuple[str, ...]:
    """Names of the parameters that `Outputs.of` uses."""
    if autopilot == PX4:
        bank = [f"PWM_MAIN_{what}{n}" for what in ("FUNC", "MIN", "MAX") for n in range(1, 5)]
        return (*bank, *(f"CA_ROTOR{n}_P{axis}" for n in range(4) for axis in "XY"))
    if autopilot == ARDUPILOT:
        return ("MOT_PWM_MIN", "MOT_PWM_MAX", *(f"SERVO{n}_FUNCTION" for n in range(1, 5)))
    return ()


@dataclass(frozen=True, slots=True)
class Outputs:
    """Mapping of output channels and rotor speeds to our rotors.

    Attributes:
        channels: index of the output channel of our rotors 1..4. motors: index of the autopilot's motor, likewise.
        least, most: us of each channel 0..3 at no and at full thrust.
        assumed: assumptions in place of missing parameters.
    """

    channels: tuple[int, int, int, int] = OUR_ROTOR_PLACES
    motors: tuple[int, int, int, int] = OUR_ROTOR_PLACES
    least: tuple[float, ...] = (SHORTEST_PULSE,) * 4
    most: tuple[float, ...] = (LONGEST_PULSE,) * 4
    assumed: tuple[str, ...] = ()

    @classmethod
    def of(cls, autopilot: int, parameters: Mapping[str, float]) -> "Outputs":
        """The mapping from the autopilot's parameters; without a parameter, the usual value of an X quad."""
        assumed = []
        motors = _by_place(parameters)
        if motors is None:
            motors = OUR_ROTOR_PLACES
            assumed.append("motors are where an X quad has them")
        first, pattern = (_PX4_MOTOR, "PWM_MAIN_FUNC") if autopilot == PX4 else (_ARDUPILOT_MOTOR, "SERVO{}_FUNCTION")
        names = [pattern.format(n) if "{}" in pattern else f"{pattern}{n}" for n in range(1, 5)]
        functions = [parameters.get(name, math.nan) - first for name in names]
        if sorted(functions) == [0.0, 1.0, 2.0, 3.0]:
            channel = [functions.index(m) for m in range(4)]
        else:
            channel = [0, 1, 2, 3]
            assumed.append("outputs 1 to 4 drive motors 1 to 4")
        low = [parameters.get(f"PWM_MAIN_MIN{n}", parameters.get("MOT_PWM_MIN", math.nan)) for n in range(1, 5)]
        high = [parameters.get(f"PWM_MAIN_MAX{n}", parameters.get("MOT_PWM_MAX", math.nan)) for n in range(1, 5)]
        if not all(500.0 <= a < b <= 2500.0 for a, b in zip(low, high)):
            low, high = [SHORTEST_PULSE] * 4, [LONGEST_PULSE] * 4
            assumed.append("pulses go from 1000 to 2000 us")
        a, b, c, d = (channel[m] for m in motors)
        return cls((a, b, c, d), motors, tuple(low), tuple(high), tuple(assumed))

    def duty(self, values: Sequence[float]) -> tuple[float, float, float, float] | None:
        """Shares 0..1 of the full thrust command of our rotors, from the first outputs as sent; None if invalid.

        Numbers within -1..1 are shares (negative: reversed or stopped, 0 here); other numbers are pulses in us.
        """
        used = [float(values[i]) for i in self.channels]
        if not all(math.isfinite(v) for v in used):
            return None
        if all(-1.0 <= v <= 1.0 for v in used):
            a, b, c, d = (max(v, 0.0) for v in used)
            return a, b, c, d
        if not all(0.0 <= v <= 3000.0 for v in used):
            return None
        shares = [
            min(max((v - self.least[i]) / (self.most[i] - self.least[i]), 0.0), 1.0)
            for v, i in zip(used, self.channels, strict=True)
        ]
        a, b, c, d = shares
        return a, b, c, d

    def speeds(self, rpm: Sequence[float]) -> tuple[float, float, float, float]:
        """Speeds [rpm] of our rotors 1..4 from those of the autopilot's motors, without sign."""
        a, b, c, d = (abs(float(rpm[i])) for i in self.motors)
        return a, b, c, d


def _by_place(parameters: Mapping[str, float]) -> tuple[int, int, int, int] | None:
    """Motors by the signs of their positions (x forward, y right); None unless each corner has one."""
    corners: dict[tuple[bool, bool], int] = {}
    for n in range(4):
        x, y = (parameters.get(f"CA_ROTOR{n}_P{axis}", 0.0) for axis in "XY")
        if not (x and y):
            return None
        corners[(x > 0, y > 0)] = n
    if len(corners) < 4:
        return None
    return corners[True, True], corners[False, True], corners[False, False], corners[True, False]
