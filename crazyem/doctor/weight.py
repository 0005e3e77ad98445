"""Check: the mass that the rotors carry by the known thrust laws, against a mass that the publisher claims.

Thrust over specific force along body z is a mass, but only as exact as the thrust law: a law that is 20 % too strong
looks like a drone that is 20 % too heavy. So a finding gives the ratio, never "the mass".
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from crazyem.doctor.kinematics import GRAVITY, GRID_STEP, Grid, Track, grid_of, measurements, track
from crazyem.doctor.regression import FEWEST_BLOCKS, block_sums, blocks
from crazyem.physics.rotors import thrust_from_command, thrust_from_speed
from crazyem.recordings.airborne import airtime
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.thrust import carried, vehicle_for, weight_objection
from crazyem.vehicle import Vehicle, load_vehicle, preset_names

REPORTED_MASS_DEVIATION = 0.15  # smallest reported relative deviation of the claimed mass from the nearest law
LIFTING_THRUST_RATIO = 0.6  # least thrust in flight over the median thrust: less is take-off, landing or the ground
THRUST_BRIDGED_SECONDS = 0.15  # s, longest gap in thrust and force to interpolate
FEWEST_BLOCK_ROWS = 25  # fewest rows of a block (0.25 s)


@dataclass(frozen=True, slots=True)
class Carried:
    """Mass that a flight shows by a thrust law."""

    mass: float  # kg, mean thrust over mean specific force along body z
    low: float  # kg, 95 % interval, without the error of the thrust law
    high: float
    sag: float  # 1/V, relative change of this mass per volt of battery; NaN if the voltage hardly changes
    seconds: float  # of flight used


def check(recording: Recording) -> list[Finding]:
    """Finding if no known thrust law gives the claimed mass; without a claim, if the vehicle does not fit."""
    claim = claimed_mass(recording)
    if claim is None:
        return _unlike(recording)
    by_law = {name: found for name in preset_names() if (found := apparent_mass(recording, load_vehicle(name)))}
    if not by_law:
        return []
    nearest = min(by_law, key=lambda name: abs(math.log(by_law[name].mass / claim)))
    best = by_law[nearest]
    ratio = best.mass / claim
    if abs(math.log(ratio)) < math.log(1.0 + REPORTED_MASS_DEVIATION) or best.low <= claim <= best.high:
        return []
    evidence = {"claimed_kg": claim, "ratio": ratio, "ratio_low": best.low / claim, "ratio_high": best.high / claim}
    for name, one in by_law.items():
        key = name.replace("-", "_")
        evidence |= {f"mass_{key}_kg": one.mass, f"mass_{key}_low_kg": one.low, f"mass_{key}_high_kg": one.high}
        evidence |= {f"sag_{key}_per_V": one.sag, "seconds": one.seconds}
    listed = ", ".join(f"{1e3 * one.mass:.1f} g by {name}" for name, one in by_law.items())
    bound = "at least" if ratio > 1.0 else "at most"
    text = (
        f"{1e3 * claim:.1f} g are claimed, but the rotors carry {listed} (thrust laws of known drones): {bound} "
        f"{ratio:.2f} times the claim. Only the ratio of thrust scale to mass can be observed."
    )
    advice = "Weigh the drone as it flew, or give the vehicle a thrust law of its own."
    return [Finding("weight", Grade.DEGRADES, text, "", (), evidence, advice)]


def _unlike(recording: Recording) -> list[Finding]:
    """Finding if the thrust of the rotors does not fit the weight of the vehicle that commands would use."""
    vehicle, air = vehicle_for(recording), airtime(recording)
    why = weight_objection(recording, vehicle, air)
    if not why:
        return []
    text = f"{why[:1].upper()}{why[1:]}"
    advice = "Name the vehicle that flew (--vehicle), or weigh it and write a vehicle file."
    evidence = {"ratio": carried(recording, vehicle, air)}
    return [Finding("weight", Grade.DEGRADES, text, evidence=evidence, advice=advice)]


def claimed_mass(recording: Recording) -> float | None:
    """Mass [kg] that the source claims (metadata "claims", "mass_kg"); None if it claims none."""
    try:
        mass = float(recording.metadata.get("claims", {}).get("mass_kg", "nan"))
    except ValueError:
        return None
    return mass if 0.0 < mass < math.inf else None


def apparent_mass(recording: Recording, vehicle: Vehicle) -> Carried | None:
    """Mean thrust by a vehicle's law over mean specific force along body z, in flight; None without enough data.

    Without an accelerometer the mean force is assumed to be the weight.
    """
    made = _thrust(recording, vehicle)
    if made is None:
        return None
    grid, thrust, volts = made
    lift, valid = np.full(grid.size, GRAVITY), thrust.valid
    force = _first(recording, "specific_force")
    if force is not None:
        felt = track(force, grid, bridge=THRUST_BRIDGED_SECONDS)
        lift, valid = felt.value[:, 2], valid & felt.valid
    total = thrust.value[:, 0]
    turning = valid & (total > 1e-3)
    if turning.sum() < FEWEST_BLOCKS * FEWEST_BLOCK_ROWS:
        return None
    flying = turning & (total > LIFTING_THRUST_RATIO * float(np.median(total[turning]))) & (lift > 0.2 * GRAVITY)
    rows = np.flatnonzero(flying)
    if rows.size < FEWEST_BLOCKS * FEWEST_BLOCK_ROWS:
        return None
    sums = block_sums(blocks(grid.time[rows]), total[rows], lift[rows], volts.value[rows, 0], np.ones(rows.size))
    sums = sums[sums[:, 3] >= FEWEST_BLOCK_ROWS]
    if len(sums) < FEWEST_BLOCKS or not 0.5 * GRAVITY < sums[:, 1].sum() / sums[:, 3].sum() < 2.0 * GRAVITY:
        return None
    mass = float(sums[:, 0].sum() / sums[:, 1].sum())
    each = sums[:, 0] / sums[:, 1]
    wide = float(stats.t.ppf(0.975, len(sums) - 1)) * float(each.std(ddof=1)) / math.sqrt(len(sums))
    voltage = sums[:, 2] / sums[:, 3]
    sag = float(np.polyfit(voltage - voltage.mean(), each / mass, 1)[0]) if np.ptp(voltage) > 0.1 else math.nan
    return Carried(mass, mass - wide, mass + wide, sag, float(sums[:, 3].sum()) * GRID_STEP)


def _thrust(recording: Recording, vehicle: Vehicle) -> tuple[Grid, Track, Track] | None:
    """Total thrust (m, 1) [N] and voltage (m, 1) on a grid, from rotor speeds if possible, else from the duty."""
    speed, voltage = _first(recording, "rotor_speed"), _first(recording, "voltage")
    if speed is not None and vehicle.rotor_constant is not None:
        grid = grid_of(speed)
        rotor = track(speed, grid, bridge=THRUST_BRIDGED_SECONDS)
        force = thrust_from_speed(rotor.value, rotor_constant=vehicle.rotor_constant).sum(axis=1)
        unknown = Track(np.zeros((grid.size, 1)), rotor.valid)
        volts = unknown if voltage is None else track(voltage, grid, bridge=2.0)
        return grid, Track(force[:, None], rotor.valid), volts
    command = _first(recording, "motor_command")
    if command is None or voltage is None or not vehicle.thrust_curve:
        return None
    grid = grid_of(command, voltage)
    duty, volts = track(command, grid, bridge=THRUST_BRIDGED_SECONDS), track(voltage, grid, bridge=2.0)
    ratio = np.clip(duty.value, 0.0, 1.0)
    force = thrust_from_command(ratio, volts.value[:, 0], thrust_curve=vehicle.thrust_curve).sum(axis=1)
    return grid, Track(force[:, None], duty.valid & volts.valid), volts


def _first(recording: Recording, quantity: str) -> SignalArray | None:
    return next(iter(measurements(recording, quantity).values()), None)
