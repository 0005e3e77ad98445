"""What is too small to be told of an effect, or more than there can be of it."""

from collections.abc import Mapping

import numpy as np

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.days import day_sd
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import HANGING_SD, ONBOARD_LAG_SD, jittery, usual_wind

# Smaller than this, these are not told from what filters, sampling and the air of a room do: s, s, s, 1, rad, rad/s, 1,
# 1, N m s/m. And no rotor is lighter, kg m^2: a rod of 0.1 g and 46 mm has 1.8e-8, and this is a sixth of it.
LEAST = {"measurement_delay": 3e-3, "input_delay": 4e-3, "motor_lag": 7.5e-3, "velocity_scale": 0.035,
         "attitude_misalignment": 2e-3, "gyro_bias": 3e-3, "torque_scale": 0.08, "thrust_curve": 0.06,
         "velocity_moment": 3e-6, "rotor_inertia": 3e-9}  # fmt: skip
LEAST_ONBOARD_DELAY = 3.0 * ONBOARD_LAG_SD  # s: no filter on board makes states so late
# N m s/m, of a moment that tips the drone further towards where it flies; air on rotors above the centre of mass tips
# it back. Five that were told of simulated drones with none (seeds 2046 to 2048) were such about both axes, of 4e-6 to
# 1.2e-5: more than that may be of a body below which the air finds more hold.
LEAST_ONWARD = 1.5e-5
BACK = {"roll_per_vy": 1.0, "pitch_per_vx": -1.0}  # signs
# s: where no gyro was late, rates were 1.2 ms later than usual at most in 51 simulated flights.
GYRO_LEAST = 2e-3
VELOCITY_LEAST = 2.0  # times what the jitter of an onboard estimate looks like
STEEP = 3.0  # vertical over horizontal wind
HIGHEST = 1.0  # m: a floor is felt by some rotor radii, Crazyflies have 23 to 28 mm
LEAST_INERTIA = 0.08  # relative, the same
LEAST_LOAD = 0.005  # of the drone's mass, the same
DRAWN = 2.0  # standard deviations of the day's trim
LEAST_DRAG = {"x": 1e-3, "y": 1e-3, "z": 3e-3}  # N s/m or N s^2/m^2; along z thrust is a little wrong (see SYSTEMATIC)
DRAG_MOST = {"linear_drag": 5.0, "quadratic_drag": 3.0}  # 1/s, 1/m, times the mass: more than air has
LIFTING = ("battery_sag", "payload", "thrust_curve", "thrust_scale")
# Standard deviations to which a swing weighs a load: less is none, nor is, beside one, less thrust than that. Beside
# payloads far off the middle 0.19 and 0.25 g on 0.14 m were told (2042/0084, 0317).
WEIGHED = 3.0
LEAST_CENTRE = {"x": 1e-4, "y": 1e-4, "z": 1e-3}  # m; z shows in lateral accelerations of O alone


def at_the_end(point: Point, candidate: Candidate) -> bool:
    """Whether an effect of one number is where nothing more of it is admitted, or a drag is none that air has."""
    here = candidate.values(point)
    if candidate.effect in DRAG_MOST:
        most = DRAG_MOST[candidate.effect] * point.vehicle.mass
        return any(here[n] > most for n in candidate.free)
    if len(candidate.free) != 1:
        return False
    name = candidate.free[0]
    return here[name] in candidate.range_of(name) and here[name] != candidate.neutral(point)[name]


def _other_load(point: Point, here: Mapping[str, float], filed: Mapping[str, float]) -> bool:
    """Whether a load is another than the file's by more than is told: in weight, or in where it draws the centre.

    With a trim in the file by more than differs from day to day; that of no load is told by its weight alone.
    """
    daily = TRIM in point.vehicle.effects
    heavier = abs(here["mass"] - filed["mass"])
    least = WEIGHED * HANGING_SD["mass"] if "length" in here else LEAST_LOAD
    if heavier > (day_sd(point.vehicle)[0] if daily else least) * point.vehicle.mass:
        return True
    if "x" not in here or not (daily or filed["mass"] > 0.0):
        return False
    along_x, along_y = (here["mass"] * here[n] - filed["mass"] * filed[n] for n in "xy")
    drawn = float(np.hypot(along_x, along_y)) / point.vehicle.mass
    return drawn > (DRAWN * day_sd(point.vehicle)[1] if daily else LEAST_CENTRE["x"])


def _outweighs(point: Point, candidate: Candidate, data: Data) -> bool:
    """Whether an effect that lifts does so by more than what the swing of a load on a string leaves open of its weight.

    Lateral forces of flights that shake come out 1 % too small: attitudes of onboard filters lag. A load of 1 g was
    told as one of 0.9 g, and what was left of its weight as a sag.
    """
    if candidate.effect not in LIFTING or "suspended_load" not in point.effects:
        return True
    without = point.with_effects({candidate.effect: candidate.neutral(point)})
    up, before = (np.concatenate([model.accelerations(p)[0][:, 2] for model in data.models]) for p in (point, without))
    lifted = float(np.sqrt(np.mean((up - before) ** 2) / np.mean(before**2)))
    return lifted > WEIGHED * HANGING_SD["mass"]


def matters(point: Point, candidate: Candidate, data: Data | None = None) -> bool:
    """Whether the effect is larger than what onboard filters or the sampling of a log look like, and within its range.

    One number that ends where nothing more is admitted would be more: it stands for something else. With the flights it
    was fitted to, a scale of velocities must be more than the jitter of the estimate in them, too.
    """
    least = GYRO_LEAST if dict(candidate.fixed).get("streams") == ("gyro",) else LEAST.get(candidate.effect)
    here, neutral = candidate.values(point), candidate.neutral(point)
    if at_the_end(point, candidate) or (data is not None and not _outweighs(point, candidate, data)):
        return False
    by_axis = {"center_of_mass": LEAST_CENTRE, "linear_drag": LEAST_DRAG, "quadratic_drag": LEAST_DRAG}
    if candidate.effect in by_axis:
        return any(abs(here[n] - neutral[n]) > by_axis[candidate.effect][n] for n in candidate.free)
    if (
        candidate.effect == "wind"
    ):  # what rises or sinks is thrust that is a little wrong: no air blows through the floor
        along = float(np.hypot(here["x"], here["y"]))
        return along > usual_wind(point.vehicle) and abs(here["z"]) < STEEP * along
    if candidate.effect == "ground_effect":  # what does not fade with height is thrust that is a little wrong
        return here["height"] < HIGHEST
    if candidate.effect in ("payload", "suspended_load"):
        return _other_load(point, here, neutral)
    if candidate.effect == "inertia":
        return any(abs(here[n] / neutral[n] - 1.0) > LEAST_INERTIA for n in candidate.free)
    if candidate.effect == "measurement_delay" and data is not None and any(f.fused for f in data.flights):
        least = LEAST_ONBOARD_DELAY
    if candidate.effect == "velocity_scale" and data is not None:
        jitter = np.maximum(VELOCITY_LEAST * jittery(data), least or 0.0)
        return any(abs(here[n] - neutral[n]) > j for n, j in zip("xyz", jitter, strict=True) if n in candidate.free)
    if candidate.effect == "velocity_moment":
        back = [BACK[n] * (here[n] - neutral[n]) for n in candidate.free]
        return max(back) > LEAST[candidate.effect] or min(back) < -LEAST_ONWARD
    if least is None:
        return True
    return any(abs(here[n] - neutral[n]) > least for n in candidate.free)
