"""From parameters and information to the reported estimate: values, intervals, and whether the data support them."""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.em import Information, displaced, offset
from crazyem.estimation.kernels import DELAY, LAG
from crazyem.estimation.marginal import Marginal
from crazyem.estimation.model import GROUPS, NAMES, Parameters, Setup
from crazyem.estimation.result import PARAMETER_UNITS, Estimate, ParameterEstimate
from crazyem.vehicle import Vehicle

IDENTIFIABLE = 0.15  # largest standard deviation of a logarithm that counts as identified
IMPLAUSIBLE_SD = 3.0  # prior standard deviations from the centre, beyond which an inertia is implausible
FEWEST_SAMPLES = 20  # samples in flight before anything counts as identified
NOT_CONVERGED = "not converged yet"  # reason of an estimate whose passes have not reached the maximum
ROTATION_UNEXPLAINED = (
    "the data ask for an inertia far from any such drone's: the logged commands do not explain its rotation"
)
_INERTIA = (np.arange(len(NAMES)) > 0) & (np.arange(len(NAMES)) < LAG)
_LOGARITHMIC = np.arange(len(NAMES)) < DELAY


def estimate_of(
    parameters: Parameters,
    setup: Setup,
    information: Information,
    *,
    time: float,
    samples: int,
    updates: int,
    converged: bool,
    marginal: Marginal | None = None,
) -> Estimate:
    """The estimate: every parameter with its standard deviation, 95 % interval and verdict.

    Args:
        information: of the last full pass.
        time: of the newest sample [s].
        samples, updates: number in the window, and so far.
        converged: whether the score test was passed.
        marginal: posterior with weakly determined noise scales integrated out; None: no such scale.
    """
    prior, unit = setup.prior, setup.unit
    theta, sd, below, above = _interval(parameters, information, unit, marginal)
    deviation = np.abs(offset(theta, prior.centre, unit))
    distrusted = implausible_inertia(theta, setup)
    if distrusted.any():
        sd = np.where(distrusted, np.maximum(sd, deviation), sd)
        below, above = np.where(distrusted, -1.96 * sd, below), np.where(distrusted, 1.96 * sd, above)
    low, high = displaced(theta, below, unit), displaced(theta, above, unit)
    absolute = sd * np.where(_LOGARITHMIC, theta, unit)
    if not setup.free[LAG]:  # the inputs contain the lag, so the data carry no information on it
        absolute[LAG], low[LAG], high[LAG] = math.inf, 0.0, math.inf
    said = {}
    columns = (v.tolist() for v in (theta, sd, absolute, low, high, distrusted))
    for i, (name, value, spread, of_value, least, most, odd) in enumerate(zip(NAMES, *columns, strict=True)):
        reason = _objection(i, spread, setup, information, samples=samples, converged=converged, implausible=odd)
        said[name] = ParameterEstimate(value, of_value, (least, most), PARAMETER_UNITS[name], not reason, reason)
    noise = parameters.noise
    intensities = noise.impulse * np.concatenate([np.full(3, theta[0]), theta[1:4]])
    names = ("force_x", "force_y", "thrust", "torque_x", "torque_y", "torque_z")
    return Estimate(
        time=time,
        parameters=said,
        noise={**dict(zip(names, intensities.tolist())), **dict(zip(GROUPS[:4], noise.measurement.tolist()))},
        samples=samples,
        updates=updates,
        converged=converged,
    )


def implausible_inertia(theta: NDArray, setup: Setup) -> NDArray:
    """(9,) bool, inertias that are very improbable by the prior: the model is wrong, the drone is not unusual.

    theta: (9,) parameters.
    """
    deviation = np.abs(offset(theta, setup.prior.centre, setup.unit))
    found: NDArray = (deviation > IMPLAUSIBLE_SD * setup.prior.sd) & _INERTIA
    return found


def _interval(
    parameters: Parameters, information: Information, unit: NDArray, marginal: Marginal | None
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Values (9,), standard deviations, and ends of the 95 % intervals less the values (logarithms, units)."""
    if marginal is None:
        theta, sd = parameters.theta, information.sd
        below, above = -1.96 * sd, 1.96 * sd
    else:
        theta, sd = displaced(parameters.theta, marginal.shift, unit), marginal.sd
        below, above = marginal.low - marginal.shift, marginal.high - marginal.shift
    if information.shift is not None and information.open_sd is not None:
        theta = displaced(theta, information.shift, unit)
        wider = information.open_sd
        sd, below, above = np.hypot(sd, wider), -np.hypot(below, 1.96 * wider), np.hypot(above, 1.96 * wider)
    return theta, sd, below, above


def _objection(
    i: int, sd: float, setup: Setup, information: Information, *, samples: int, converged: bool, implausible: bool
) -> str:
    """Why parameter i is not identifiable; empty if it is. sd: of its logarithm, or of the parameter in its unit."""
    inertia = 0 < i < LAG
    if not setup.free[i]:
        return "the inputs already include the rotor lag" if i == LAG else "held fixed"
    if i >= DELAY:
        return "" if sd < 0.7 * setup.prior.sd[i] else "the data say no more than the prior does"
    if samples < FEWEST_SAMPLES:
        return f"only {samples} samples in flight"
    if implausible:
        return ROTATION_UNEXPLAINED
    if not sd < IDENTIFIABLE:
        if inertia and abs(information.bias[i]) > IDENTIFIABLE:
            return (
                f"the logged commands are mostly noise between their stamps: torque about {'xyz'[i - 1]} that acted "
                "cannot be told from them at this logging rate"
            )
        what = ("thrust", "torque about x", "torque about y", "torque about z", "commands")[i]
        return f"too little excitation: {what} determines it only within {196 * sd:.0f} % (95 %)"
    return "" if converged else NOT_CONVERGED


def nothing_known(vehicle: Vehicle, *, reason: str, time: float, updates: int) -> Estimate:
    """The estimate before any flight: nominal values with infinite standard deviations."""
    values = (vehicle.mass, *vehicle.inertia, vehicle.motor_time_constant, 0.0, 0.0, 0.0, 0.0)
    return Estimate(
        time=time,
        parameters={
            name: ParameterEstimate(
                value, math.inf, (0.0 if i <= LAG else -math.inf, math.inf), PARAMETER_UNITS[name], False, reason
            )
            for i, (name, value) in enumerate(zip(NAMES, values))
        },
        updates=updates,
    )
