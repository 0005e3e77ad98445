"""Command units of the firmware's controllers: parameters of INDI and Mellinger.

PID, Mellinger and INDI command in units of the firmware's legacy mixer (powerDistributionLegacy in
power_distribution_quadrotor.c). One unit of thrust or yaw changes every rotor by one unit; one unit of roll or pitch
changes every rotor by half a unit. 65535 units are the firmware's THRUST_MAX if it compensates the battery voltage
(motors.c, motorsCompensateBatteryVoltage), else full duty.
"""

import math

from crazyem.physics.effects.rotors import TYPICAL_ROTOR_CONSTANT
from crazyem.vehicle import GRAVITY, Vehicle

FULL = 65535.0  # units
LOOP = 0.002  # s, the period of INDI's loop: ATTITUDE_RATE 500 Hz in stabilizer_types.h
BISECTIONS = 60  # of the voltage interval, to the last bit


def motor_volts(vehicle: Vehicle, thrust: float) -> float:
    """Motor voltage [V] at which one rotor's thrust curve gives `thrust` [N], on its rising branch (0 to 20 V).

    Raises:
        ValueError: the curve does not reach this thrust.
    """
    low, high = _lowest(vehicle), 20.0
    if not _thrust(vehicle, low) <= thrust <= _thrust(vehicle, high):
        raise ValueError(f"the thrust curve of {vehicle.name} does not give {thrust:.4g} N")
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _thrust(vehicle, middle) < thrust else (low, middle)
    return 0.5 * (low + high)


def _thrust(vehicle: Vehicle, volts: float) -> float:
    return sum(c * volts**n for n, c in enumerate(vehicle.thrust_curve))


def _lowest(vehicle: Vehicle) -> float:
    """Lowest voltage above which the curve only rises, in steps of 0.05 V."""
    steps = [0.05 * n for n in range(401)]
    falling = [v for v in steps if _slope(vehicle, v) <= 0.0]
    return max(falling, default=-0.05) + 0.05


def _slope(vehicle: Vehicle, volts: float) -> float:
    return sum(n * c * volts ** (n - 1) for n, c in enumerate(vehicle.thrust_curve) if n)


def thrust_per_unit(vehicle: Vehicle, *, thrust: float, volts: float) -> float:
    """Change of one rotor's thrust per unit of command [N], at `thrust` [N] and the battery voltage `volts` [V].

    If the firmware compensates the voltage, this is THRUST_MAX/65535 at every voltage (the vehicle's thrust_max).

    Raises:
        ValueError: the vehicle has no finite thrust_max (compensated), or its curve does not reach the thrust.
    """
    if vehicle.battery_compensated:
        if not math.isfinite(vehicle.thrust_max):
            raise ValueError(f"the vehicle file of {vehicle.name} has no thrust_max")
        return vehicle.thrust_max / FULL
    return _slope(vehicle, motor_volts(vehicle, thrust)) * volts / FULL


def unit_torque(vehicle: Vehicle, per_unit: float) -> tuple[float, float, float]:
    """Torque [N m] about x, y, z of one unit of roll, pitch, yaw: half a unit per rotor (roll, pitch), or one (yaw)."""
    along_x, along_y = vehicle.arm
    return 2.0 * along_y * per_unit, 2.0 * along_x * per_unit, 4.0 * vehicle.torque_per_thrust * per_unit


def rotor_reaction(per_unit: float, *, thrust: float, rotor_constant: float, rotor_inertia: float, izz: float) -> float:
    """ctrlINDI.g2 [rad/s^2 per unit]: yaw acceleration from the inertia of four rotors at a step of the command.

    4 I_r (dW/df)(df/du) / (Izz T) with W = sqrt(f/k), T the loop's period: G2 of Smeur, Chu, de Croon 2016, eq. 12.

    Args:
        per_unit: thrust per unit [N]. thrust: of one rotor in hover [N]. rotor_constant: k [N/(rad/s)^2].
        rotor_inertia: I_r of a rotor with propeller [kg m^2]. izz: kg m^2.
    """
    speed_per_thrust = 0.5 / math.sqrt(rotor_constant * thrust)  # dW/df = 1/(2 k W)
    return 4.0 * rotor_inertia * speed_per_thrust * per_unit / (izz * LOOP)


def lag_share(time_constant: float) -> float:
    """ctrlINDI.act_dyn_*: share of a step that rotors with this lag [s] follow in one loop period; 1 without lag."""
    return 1.0 - math.exp(-LOOP / time_constant) if time_constant > 0.0 else 1.0


def lag_of(share: float) -> float:
    """Time constant [s], inverse of `lag_share`: 0 for a share of 1 or more, infinite for 0 or less."""
    if share >= 1.0:
        return 0.0
    return -LOOP / math.log1p(-share) if share > 0.0 else math.inf


def mass_thrust(vehicle: Vehicle, *, force: float, volts: float) -> float:
    """ctrlMel.massThrust: units of thrust per newton of commanded force [1/N], exact at `force` [N] of four rotors.

    Raises:
        ValueError: as `thrust_per_unit`.
    """
    if vehicle.battery_compensated:
        return 1.0 / (4.0 * thrust_per_unit(vehicle, thrust=force / 4.0, volts=volts))
    return motor_volts(vehicle, force / 4.0) / volts * FULL / force


def effectiveness_torque(vehicle: Vehicle) -> tuple[float, float, float]:
    """Torque about x, y, z of one unit of command [N m], at every voltage: g1 times the inertia.

    Raises:
        ValueError: the vehicle has no rotors or thrust_max, or its firmware does not compensate the battery voltage.
            Then the torque depends on the voltage (see `thrust_per_unit` and `unit_torque`).
    """
    if not vehicle.battery_compensated:
        raise ValueError(f"commands of {vehicle.name} are not compensated for the battery voltage")
    torque = unit_torque(vehicle, thrust_per_unit(vehicle, thrust=0.0, volts=0.0))
    if not min(torque) > 0.0:
        raise ValueError(f"the vehicle file of {vehicle.name} has no arm or no torque_per_thrust")
    return torque


def rotor_reaction_factor(vehicle: Vehicle, rotor_inertia: float) -> float:
    """g2 times Izz [N m per unit] in hover, for rotors of `rotor_inertia` [kg m^2]; see `rotor_reaction`."""
    constant = vehicle.rotor_constant or TYPICAL_ROTOR_CONSTANT
    per_unit = thrust_per_unit(vehicle, thrust=0.0, volts=0.0)
    thrust = vehicle.mass * GRAVITY / 4.0
    return rotor_reaction(per_unit, thrust=thrust, rotor_constant=constant, rotor_inertia=rotor_inertia, izz=1.0)
