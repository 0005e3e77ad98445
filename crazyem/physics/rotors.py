"""From logged signals to force and torque: command and voltage (or rotor speed) -> thrust of each rotor -> F and M.

Rotors are numbered as on the Crazyflie: 1 front right, 2 back right, 3 back left, 4 front left; body x forward, y left,
z up. The reaction torque of rotors 1 and 3 is towards negative yaw. Source: power_distribution_quadrotor.c, motors.c.

>>> import numpy as np
>>> wrench(np.full(4, 0.1), arm=(0.0325, 0.0325), torque_per_thrust=0.007)
array([0.4, 0. , 0. , 0. ])
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyem.compiled import compiled
from crazyem.vehicle import Vehicle

# Sign of each rotor's thrust in the torque about body x, y and z.
ROLL_SIGN = np.array([-1.0, -1.0, 1.0, 1.0])
PITCH_SIGN = np.array([-1.0, 1.0, 1.0, -1.0])
YAW_SIGN = np.array([-1.0, 1.0, -1.0, 1.0])


def thrust_from_command(command: ArrayLike, voltage: ArrayLike, *, thrust_curve: Sequence[float]) -> NDArray:
    """Static thrust of rotors from their duty cycle and the battery voltage.

    Args:
        command: (..., 4) duty after battery compensation, 0..1.
        voltage: (...,) battery voltage [V].
        thrust_curve: polynomial in motor volts, constant first [N, N/V, ...].

    Returns:
        (..., 4) thrust [N]; 0 for a command of zero, never negative.
    """
    command = np.asarray(command, float)
    motor_volts = command * np.asarray(voltage, float)[..., None]
    thrust = np.zeros_like(motor_volts)
    for coefficient in reversed(thrust_curve):
        thrust = thrust * motor_volts + coefficient
    return np.where(command == 0.0, 0.0, np.where(thrust < 0.0, 0.0, thrust))  # keeps NaN


def thrust_from_speed(speed: ArrayLike, *, rotor_constant: float) -> NDArray:
    """Thrust of rotors from measured speed, which includes the rotor lag. speed: (..., 4) rad/s -> (..., 4) N."""
    return rotor_constant * np.square(np.asarray(speed, float))


def wrench(thrust: ArrayLike, *, arm: Sequence[float], torque_per_thrust: float) -> NDArray:
    """Total thrust and torque about the centre of the rotors.

    Args:
        thrust: (..., 4) of each rotor [N].
        arm: rotor offset along body x and y [m].
        torque_per_thrust: yaw torque of a rotor over its thrust [m].

    Returns:
        (..., 4): F along body z [N]; Mx, My, Mz [N m], body FLU.
    """
    thrust = np.asarray(thrust, float)
    along_x, along_y = arm
    return np.stack(
        [
            thrust.sum(-1),
            along_y * (thrust @ ROLL_SIGN),
            along_x * (thrust @ PITCH_SIGN),
            torque_per_thrust * (thrust @ YAW_SIGN),
        ],
        axis=-1,
    )


def wrench_from_command(command: ArrayLike, voltage: ArrayLike, vehicle: Vehicle) -> NDArray:
    """Settled F and M of a vehicle's rotors for a command: (..., 4) duty, (...,) V -> (..., 4) N, N m."""
    thrust = thrust_from_command(command, voltage, thrust_curve=vehicle.thrust_curve)
    return wrench(thrust, arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)


def wrench_from_one_command(command: tuple[float, ...], voltage: float, vehicle: Vehicle) -> NDArray:
    """`wrench_from_command` for one logged command, 40 times faster: (4,) duty, V -> (4,) N, N m."""
    duty = tuple(map(float, command))
    out: NDArray = _one_wrench(duty, float(voltage), vehicle.thrust_curve, vehicle.arm, vehicle.torque_per_thrust)
    return out


@compiled
def _one_wrench(command, voltage, thrust_curve, arm, torque_per_thrust):
    out = np.zeros(4)
    for i in range(4):
        volts = command[i] * voltage
        thrust = 0.0
        for k in range(len(thrust_curve) - 1, -1, -1):
            thrust = thrust * volts + thrust_curve[k]
        if command[i] == 0.0 or thrust < 0.0:  # keeps NaN
            thrust = 0.0
        out[0] += thrust
        out[1] += ROLL_SIGN[i] * thrust
        out[2] += PITCH_SIGN[i] * thrust
        out[3] += YAW_SIGN[i] * thrust
    out[1] *= arm[1]
    out[2] *= arm[0]
    out[3] *= torque_per_thrust
    return out


def wrench_from_speed(speed: ArrayLike, vehicle: Vehicle) -> NDArray:
    """F and M of a vehicle from its measured rotor speeds: (..., 4) rad/s -> (..., 4) N, N m."""
    if vehicle.rotor_constant is None:
        raise ValueError(f"vehicle {vehicle.name} has no rotor_constant")
    thrust = thrust_from_speed(speed, rotor_constant=vehicle.rotor_constant)
    return wrench(thrust, arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)
