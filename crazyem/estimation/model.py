"""Data classes of the estimator: parameter vector, noise scales, priors, setup; all frozen."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.estimation.result import PARAMETER_UNITS
from crazyem.vehicle import GRAVITY, Vehicle

NAMES = tuple(PARAMETER_UNITS)
GROUPS = ("position", "velocity", "attitude", "body_rate", "specific_force")


# Rule of integration (`lead` in estimation/kernels). The midpoint rule is for real flights. The other two are exact for
# simulators that use explicit Euler (as eq. 56 does) or semi-implicit Euler.
INTEGRATION = {"midpoint": 0.5, "euler": 0.0, "semi-implicit": 1.0}
# Smallest allowed noise scales, in the order of `Noise.logs`: far below the resolution of real sensors.
SMALLEST_SCALES = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 5e-5, 1e-4, 1e-4, 1e-4, 1e-4])
TINY_IMPULSE = 1e-7  # m/s^2 sqrt(s), rad/s^2 sqrt(s): stands for a process noise of zero


@dataclass(frozen=True)
class Noise:
    """Noise scales; process noise in units of acceleration, where it does not depend on mass and inertia.

    Attributes:
        impulse: (6,) intensities of specific force x y z [m/s^2 sqrt(s)] and angular acceleration [rad/s^2 sqrt(s)].
        measurement: (5,) standard deviations of position [m], velocity [m/s], attitude [rad], body rate [rad/s],
            specific force [m/s^2] (if an accelerometer is used).
    """

    impulse: NDArray
    measurement: NDArray

    @cached_property
    def logs(self) -> NDArray:
        """Logarithms of all eleven scales: impulses, then measurements."""
        return np.log(np.concatenate([self.impulse, self.measurement]))

    @classmethod
    def from_logs(cls, logs: NDArray) -> "Noise":
        """Inverse of `logs`."""
        return cls(np.exp(logs[:6]), np.exp(logs[6:]))

    @cached_property
    def q(self) -> NDArray:
        """Impulse variances per second (6,), for the kernels."""
        return np.square(self.impulse)

    @cached_property
    def r(self) -> NDArray:
        """Measurement variances (12,), for the kernels."""
        return np.repeat(np.square(self.measurement[:4]), 3)


@dataclass(frozen=True)
class Prior:
    """Weak log-normal priors on parameters and noise scales; they keep a noise scale from collapsing to zero.

    Attributes:
        centre: (9,) centre of the prior of theta.
        sd: (9,) standard deviations of the logarithms, or of the linear parameters in their units.
        noise: centre of the prior of the noise scales.
        noise_sd: standard deviation of the logarithms of the noise scales.
    """

    centre: NDArray
    sd: NDArray
    noise: Noise
    noise_sd: float = 1.5

    @cached_property
    def precision(self) -> NDArray:
        """Precisions (9,) of the logarithms, or of the linear parameters in their units."""
        return 1.0 / np.square(self.sd)

    @cached_property
    def floor(self) -> NDArray:
        """Logarithms of the smallest allowed scales (11,)."""
        return np.log(SMALLEST_SCALES)


@dataclass(frozen=True)
class Parameters:
    """A point in parameter space: theta (9,; SI; kernels/layout.py), noise, fixed products of inertia."""

    theta: NDArray
    noise: Noise
    inertia_products: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def inertia(self) -> NDArray:
        """Inertia matrix (3, 3) [kg m^2]."""
        xy, xz, yz = self.inertia_products
        return np.array([[self.theta[1], xy, xz], [xy, self.theta[2], yz], [xz, yz, self.theta[3]]])

    @cached_property
    def inverse(self) -> NDArray:
        """Inverse of the inertia matrix."""
        return np.linalg.inv(self.inertia)


@dataclass(frozen=True)
class KnownNoise:
    """Noise scales that are known and not estimated; a scale that is None is estimated.

    Process noise is given in newtons and newton metres. The estimator divides it by the mass or an inertia to get units
    of acceleration. So the size of the noise also carries information on mass and inertia (errata of eq. 104 to 106).

    Attributes:
        force: intensity of the noise in thrust [N sqrt(s)].
        torque: about each axis, or one number for all [N m sqrt(s)].
        lateral_force: along body x and y [N sqrt(s)]; may be 0.
        position, velocity, attitude, body_rate, specific_force: standard deviations of the measurements [m], [m/s],
            [rad], [rad/s], [m/s^2].

    Raises:
        UsageError: one is not a positive number.
    """

    force: float | None = None
    torque: float | tuple[float, float, float] | None = None
    lateral_force: float | None = None
    position: float | None = None
    velocity: float | None = None
    attitude: float | None = None
    body_rate: float | None = None
    specific_force: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("torque", v) for v in self._torques):
            _check_known(name, value)
        for name in ("force", "lateral_force", *GROUPS):
            _check_known(name, getattr(self, name), zero=name == "lateral_force")

    @property
    def _torques(self) -> tuple[float | None, ...]:
        return self.torque if isinstance(self.torque, tuple) else (self.torque,) * 3

    @cached_property
    def mask(self) -> NDArray:
        """(11,) bool: which scales of `Noise` are known."""
        return np.isfinite(self.logs(np.ones(len(NAMES))))

    def logs(self, theta: NDArray) -> NDArray:
        """Logarithms (11,) of the scales of `Noise` with the parameters theta (9,); NaN where not known."""
        body = np.array([theta[0], theta[0], theta[0], theta[1], theta[2], theta[3]])
        process = (self.lateral_force, self.lateral_force, self.force, *self._torques)
        sensors = tuple(getattr(self, name) for name in GROUPS)
        values = np.array([math.nan if v is None else v for v in (*process, *sensors)], float)
        values[:6] = np.maximum(values[:6] / body, TINY_IMPULSE)
        return np.log(values)


def _check_known(name: str, value: float | None, *, zero: bool = False) -> None:
    if value is not None and not (0 < value < math.inf or (zero and value == 0)):
        raise UsageError(f"the known noise of {name.replace('_', ' ')} must be a positive number, not {value}")


@dataclass(frozen=True)
class Setup:
    """Settings of the estimator before the first sample: start, prior, free parameters.

    Attributes:
        start: where the estimation begins.
        prior: on parameters and noise scales.
        free: (9,) bool, which parameters are estimated.
        unit: (9,) units of the linear parameters; 1 for parameters that are estimated by their logarithms.
        lead: rule of integration (estimation/kernels): 0.5 midpoint, 0 explicit Euler, 1 semi-implicit Euler.
        known: noise that is not estimated.
    """

    start: Parameters
    prior: Prior
    free: NDArray
    unit: NDArray
    lead: float = 0.5
    known: KnownNoise | None = None

    def noise_at(self, theta: NDArray, logs: NDArray) -> Noise:
        """Noise from logarithms of the scales (11,); known scales get their value at theta (9,)."""
        if self.known is None:
            return Noise.from_logs(logs)
        known = self.known.logs(theta)
        return Noise.from_logs(np.where(np.isnan(known), logs, known))

    @cached_property
    def known_scales(self) -> NDArray:
        """(11,) bool: scales that are known, not estimated."""
        return np.zeros(11, bool) if self.known is None else self.known.mask

    @cached_property
    def known_squares(self) -> NDArray:
        """(5,) squared intensities of thrust, torque, lateral force where known, else 0 (`mstep.maximise`)."""
        if self.known is None:
            return np.zeros(5)
        process = self.known.logs(np.ones(len(NAMES)))[[2, 3, 4, 5, 0]]
        return np.nan_to_num(np.exp(2 * process), nan=0.0) * (process > np.log(2 * TINY_IMPULSE))

    def after_step(self, theta: NDArray, sd: NDArray, noise: Noise) -> "Setup":
        """The setup for a window that begins after a step of mass: what was known before is prior, mass and torque
        offset aside.

        theta (9,), sd (9,): estimate before, and standard deviations in the same units. noise: estimate before.
        """
        unit = np.append(np.where(self.free[:5], theta[:5], 1.0), self.unit[5:])  # the first five by their logarithms
        known = np.hypot(sd / unit, CHANGE_BY_STEP)
        kept = self.free & (known < self.prior.sd)
        prior = replace(
            self.prior, centre=np.where(kept, theta, self.prior.centre), sd=np.where(kept, known, self.prior.sd),
            noise=noise, noise_sd=NOISE_CHANGE_BY_STEP,
        )  # fmt: skip
        return replace(self, prior=prior)

    @cached_property
    def carried(self) -> NDArray:
        """(11, 9) derivatives of the log known scales by log theta: more mass means less acceleration noise."""
        slopes = np.zeros((11, len(NAMES)))
        acts = self.known_squares[[4, 4, 0, 1, 2, 3]] > 0
        for scale, parameter in enumerate((0, 0, 0, 1, 2, 3)):
            slopes[scale, parameter] = -1.0 if acts[scale] else 0.0
        return slopes


# Standard deviations of what a step of mass changes, in the coordinates of the prior: a load of a fifth of the mass at
# half an arm from the centre has 0.1 to 0.2 of the inertia; rotors and log stay the same.
CHANGE_BY_STEP = np.array([np.inf, 0.2, 0.2, 0.2, 0.0, 0.0, np.inf, np.inf, np.inf])
# the same of the logarithms of noise scales: the same force on a fifth more mass
NOISE_CHANGE_BY_STEP = 0.2

# Start values of the noise scales. Process noise starts large, so that the first samples outweigh the start value.
START_IMPULSE = np.array([0.5, 0.5, 5.0, 20.0, 20.0, 20.0])
# Measurement noise starts large, too: where it is too small, the likelihood is flat in it.
START_MEASUREMENT = np.array([2e-2, 1e-1, 3e-2, 1e-1, 0.5])
TYPICAL_MEASUREMENT = np.array([1e-3, 1e-2, 3e-3, 3e-3, 0.1])

# Delay between an input's stamp and its effect on the logged rates [s]: centre and standard deviation of the prior.
# Commands of a Crazyflie: held for 2 ms at 500 Hz (1 ms in the mean), and rates low-passed at 80 Hz (2.8 ms).
DELAY_OF_COMMANDS = (3.5e-3, 2e-3)
DELAY_OF_SPEEDS = (0.0, 10e-3)
DELAY_UNIT = 1e-3  # s

# Standard deviation of the prior of the torque offset, as a shift of the centre of mass over the arm. Rotors are never
# equal, and the centre of mass is never exactly between them. So a drone in steady flight commands a torque without
# angular acceleration. Without the offset, this torque would look like a huge inertia.
TRIM_SD = 0.05


# Standard deviations of the logarithms of mass, Ixx, Iyy, Izz and of the rotor lag, where the vehicle file gives none.
# In a cold start, mass and inertia are unknown.
SPREAD = (1.0, 0.5, 0.5, 0.5)
COLD_SPREAD = (10.0, 1.5, 1.5, 1.5)
SPREAD_OF_LAG = 0.7


def _spread(vehicle: Vehicle) -> tuple[float, ...]:
    mass = SPREAD[0] if vehicle.mass_sd is None else vehicle.mass_sd
    return (mass, *(SPREAD[1:] if vehicle.inertia_sd is None else vehicle.inertia_sd))


def setup_for(
    vehicle: Vehicle,
    *,
    mass: float | None = None,
    inertia: tuple[float, float, float] | None = None,
    lag: bool = True,
    integration: str = "midpoint",
    known_noise: KnownNoise | None = None,
) -> Setup:
    """Start and prior for a vehicle.

    Args:
        vehicle: nominal constants; centre of the prior, and its width where the file gives one.
        mass: [kg] start of a cold start, e.g. 0.001 (paper, eq. 116); the prior on mass is then flat in effect.
        inertia: [kg m^2] start of a cold start.
        lag: whether inputs are commands, before the rotor lag (False: rotor speeds or true wrenches).
        integration: midpoint, euler or semi-implicit: the rule by which the data move (`INTEGRATION`).
        known_noise: noise that is not estimated.

    Raises:
        UsageError: there is no such integration.
    """
    if integration not in INTEGRATION:
        raise UsageError(f"unknown integration '{integration}' (known: {', '.join(INTEGRATION)})")
    delay, delay_sd = DELAY_OF_COMMANDS if lag else DELAY_OF_SPEEDS
    centre = np.array([vehicle.mass, *vehicle.inertia, vehicle.motor_time_constant, delay, 0.0, 0.0, 0.0])
    cold = mass is not None or inertia is not None
    start = centre.copy()
    if mass is not None:
        start[0] = mass
    if inertia is not None:
        start[1:4] = inertia
    has_lag = lag and vehicle.motor_time_constant > 0
    timed = has_lag or not lag  # a wrench as it acts has neither lag nor delay
    if not has_lag:
        start[4] = 0.0
    if not timed:
        start[5] = 0.0
    noise = Noise(START_IMPULSE.copy(), START_MEASUREMENT.copy())
    lag_sd = SPREAD_OF_LAG if vehicle.motor_time_constant_sd is None else vehicle.motor_time_constant_sd
    # The prior of a cold start is centred on the start, and so wide that 4 s of data outweigh it.
    prior = Prior(
        centre=np.append(np.where(start > 0, start if cold else centre, 1.0)[:5], start[5:]),
        sd=np.array([*(COLD_SPREAD if cold else _spread(vehicle)), lag_sd, delay_sd / DELAY_UNIT, 1.0, 1.0, 1.0]),
        noise=Noise(np.array([0.02, 0.02, 0.05, 0.5, 0.5, 0.5]), TYPICAL_MEASUREMENT.copy()),
    )
    free = np.array([True, True, True, True, has_lag, timed, timed, timed, timed])
    offset = max(TRIM_SD * vehicle.mass * GRAVITY * max(vehicle.arm), 1e-9)
    unit = np.array([1.0, 1.0, 1.0, 1.0, 1.0, DELAY_UNIT, offset, offset, offset])
    begin = Parameters(start, noise, vehicle.inertia_products)
    setup = Setup(begin, prior, free, unit, INTEGRATION[integration], known_noise)
    return replace(setup, start=replace(setup.start, noise=setup.noise_at(start, noise.logs)))
