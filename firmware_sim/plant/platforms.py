"""Constants of the two platforms: those compiled into the firmware, and the plant's defaults.

platform_defaults_cf2.h and platform_defaults_cf21bl.h (2.1+ propellers on cf2). Inertia: Foerster, System
Identification of the Crazyflie 2.0, ETH Zurich 2015 (cf2); Busetto et al., arXiv 2512.14450, from CAD (cf21bl).
"""

from dataclasses import dataclass

SQRT_HALF = 0.707106781  # as in power_distribution_quadrotor.c
LIMIT_OVER_FULL_SCALE = 1.25  # thrust of a rotor at most, over the full scale of commands; assumed


@dataclass(frozen=True)
class Platform:
    """SI units; arm_length is from the centre to a rotor, thrust per rotor, curve in N per V^n, constant first."""

    mass: float
    inertia: tuple[float, float, float]
    arm_length: float
    curve: tuple[float, float, float, float]
    thrust_min: float
    thrust_max: float
    torque_per_thrust: float
    brushless: bool
    capacity: float  # A h
    power_coefficient: float  # W/N^1.5 per rotor
    rotor_constant: float  # N/(rad/s)^2

    @property
    def rotor_thrust_limit(self) -> float:
        """N, limit of the plant's rotor."""
        return LIMIT_OVER_FULL_SCALE * self.thrust_max


PLATFORMS = {
    "cf2": Platform(
        mass=0.029,
        inertia=(1.657171e-5, 1.6655602e-5, 2.9261652e-5),
        arm_length=0.046,
        curve=(-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145),
        thrust_min=0.012817578,
        thrust_max=0.12,
        torque_per_thrust=0.0069928948992470565,
        brushless=False,
        capacity=0.25,
        power_coefficient=90.0,
        rotor_constant=2.0e-8,
    ),
    "cf21bl": Platform(
        mass=0.0393,
        inertia=(2.3951e-5, 2.3951e-5, 3.2347e-5),
        arm_length=0.050,
        curve=(-0.014058926705279723, 0.04265273261724981, 0.0018327760144017432, 0.0020576974784587178),
        thrust_min=0.021362631,
        thrust_max=0.2,
        torque_per_thrust=0.00569278844371417,
        brushless=True,
        capacity=0.35,
        power_coefficient=60.0,
        rotor_constant=3.72e-8,
    ),
}
