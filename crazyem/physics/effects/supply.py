"""thrust_curve and battery_sag: errors of the map from command to settled thrust, before the lag."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Parameter
from crazyem.physics.effects.prior import Prior, in_turn

REFERENCE_VOLTAGE = 3.7  # V, at which gain_per_volt has no effect: one nearly empty cell


def steeper(
    thrust: NDArray, *, time: NDArray, flown: NDArray, voltage: NDArray, hover: float, slope_error: float
) -> NDArray:
    """Thrust f + slope_error (f - hover), not below 0; 0 for a command of zero."""
    if slope_error == 0.0:
        return thrust
    changed = np.maximum(thrust + slope_error * (thrust - hover), 0.0)
    return np.where(thrust == 0.0, 0.0, changed)


def sagging(
    thrust: NDArray, *, time: NDArray, flown: NDArray, voltage: NDArray, hover: float, gain_per_volt: float,
    gain_per_second: float,
) -> NDArray:  # fmt: skip
    """Thrust times max(0, 1 + gain_per_volt (V - 3.7 V) + gain_per_second t), with t [s] since take-off.

    Where the voltage is unknown, gain_per_volt has no effect.
    """
    volts = np.where(np.isnan(voltage), 0.0, voltage - REFERENCE_VOLTAGE)
    factor = 1 + gain_per_volt * volts + gain_per_second * np.maximum(flown, 0.0)
    return thrust * np.maximum(factor, 0.0)[:, None]


THRUST_CURVE = Effect(
    "thrust_curve",
    (Parameter("slope_error", "", 0.0, -0.9, 3.0, 0.02),),
    order=20,
    commanded=steeper,
    needs=("motor_command",),
    # usual: without a recorded voltage, the battery sags under load (0.06 to 0.3 ohm of a cell and its wires), so the
    # thrust rises less with the command
    prior=Prior(
        own={"slope_error": 0.25},
        usual=lambda conditions: {"slope_error": 0.15} if conditions.no_voltage else {},
        systematic={"slope_error": 0.02},  # estimates of known slopes are too large by this
        detection_limit={"slope_error": 0.06},
    ),
    separates="climb and sink hard with the same battery, or measure thrust over command on a stand",
    needs_torques=True,
    steady_force=True,
    lifts=True,
)

BATTERY_SAG = Effect(
    "battery_sag",
    (
        Parameter("gain_per_volt", "1/V", 0.0, -2.0, 2.0, 0.02, needs=("voltage",), phrase="with the voltage"),
        Parameter(
            "gain_per_second",
            "1/s",
            0.0,
            -0.1,
            0.1,
            2e-4,
            without=("voltage",),
            phrase="with time",
            remark="no battery voltage was recorded, and every battery that empties looks like this",
        ),
    ),
    order=21,
    commanded=sagging,
    needs=("motor_command",),
    alternatives=(("gain_per_volt",), ("gain_per_second",)),
    # own: a cell of 0.1 to 0.3 ohm at some amperes; usual, without a recorded voltage: 4.1 to 3.5 V in 300 s
    prior=Prior(
        in_turn("gain_per_volt gain_per_second", 0.4, 3e-3),
        lambda conditions: {"gain_per_second": 1.5e-3} if conditions.no_voltage else {},
    ),
    separates="log pm.vbat, and fly the same battery from full to empty",
    spared={"voltage": "log pm.vbat, and "},
    steady_force=True,
    imbalance="mean thrust",
    lifts=True,
)
