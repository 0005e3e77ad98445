"""What the paper leaves unsaid, and says: every setting of its simulation with the reason for its value."""

from dataclasses import dataclass, field, fields
from typing import Any


def _setting(default: Any, unit: str, reason: str) -> Any:
    return field(default=default, metadata={"unit": unit, "reason": reason})


@dataclass(frozen=True)
class Settings:
    """One way to read the paper (SI). `describe` lists every value with its reason.

    The defaults are the reading called p5: what an earlier study of the tables decoded (chosen with Tables II to V in
    view: gains, torque noise, position weights). `LITERAL` is another, which takes what is printed as printed.
    """

    mass: float = _setting(0.18, "kg", "printed (VI-B)")
    inertia: tuple[float, float, float] = _setting((2.5e-4, 3.1e-4, 2.0e-4), "kg m^2", "printed (eq. 57)")
    dt: float = _setting(0.005, "s", "Q0 = 0.0707 = sqrt(h) with h = dt (eq. 119); 800 observations are then 4 s")
    duration: float = _setting(
        20.0, "s", "widths online over offline are 2.2 = sqrt(20 s / 4 s); five waypoints of 4 s each"
    )
    start: tuple[float, float, float] = _setting((0.5, 1.0, 0.0), "m", "printed (XI-A)")
    waypoints: tuple[tuple[float, float, float], ...] = _setting(
        ((4.0, 3.0, 3.0), (3.0, 5.0, 4.0), (6.0, 4.0, 5.0), (4.0, 3.0, 4.0), (2.0, 1.0, 5.0)), "m", "printed (XI-B)"
    )
    smooth: bool = _setting(
        False, "", "not said; smooth references tilt the drone too little for the mass that sensor C finds"
    )
    force_noise: float = _setting(
        0.005, "N sqrt(s)", "n0 ~ N(0, h) held for dt: sqrt(h dt); gives the printed spread of mass"
    )
    torque_noise: float = _setting(
        0.002, "N m sqrt(s)", "h need not hold for torque, too; the tables do not pin it (.002 to .005)"
    )
    position_sd: float = _setting(0.00707, "m", "R0 = 0.00707 (eq. 120)")
    velocity_sd: float = _setting(0.00707, "m/s", "R0 = 0.00707 (eq. 120)")
    attitude_sd: float = _setting(0.00707, "rad", "R0 = 0.00707 (eq. 120)")
    body_rate_sd: float = _setting(0.0707, "rad/s", "Fig. 5 shows errors of 0.15 rad/s; ten times R0 explains them")
    acceleration_sd: float = _setting(0.0707, "m/s^2", "not said; taken like the other inertial sensor's")
    angle_gain: float = _setting(20.0, "1/s", "printed 40 (eq. 19); 20 reproduces the widths of inertia")
    rate_gain: float = _setting(20.0, "1/s", "not said; 20 reproduces the widths of inertia")
    position_weight: float = _setting(
        225.0, "1/s^4", "not said; chosen by sensor C's mass, whose bias is tilt: 16 gives 3.7 %, 400 more than printed"
    )
    velocity_weight: float = _setting(90.0, "1/s^2", "not said; no overshoot at a waypoint")
    acceleration_limit: float = _setting(9.0, "m/s^2", "not said; a step of 5 m would else turn the drone over")
    filter_process: float = _setting(0.0707, "1", "printed Q0 (eq. 119), the same number for every state")
    filter_measurement: float = _setting(0.00707, "1", "printed R0 (eq. 120), the same number for every channel")
    filter_start: float = _setting(1.0, "1", "printed P0 (eq. 118)")
    window: int = _setting(800, "samples", "printed (XI-A2)")
    every: int = _setting(4, "samples", "printed (XI-A2)")
    mass_start: float = _setting(0.001, "kg", "printed (eq. 116)")
    inertia_start: tuple[float, float, float] = _setting((1e-4, 2e-4, 1e-4), "kg m^2", "printed (eq. 117)")
    substeps: int = _setting(1, "", "eq. 56 steps once per dt; more come closer to the differential equation")

    @property
    def steps(self) -> int:
        """Steps of dt in the flight."""
        return round(self.duration / self.dt)

    def describe(self) -> list[dict[str, Any]]:
        """Name, value, unit and reason of every setting."""
        return [{"name": f.name, "value": getattr(self, f.name), **f.metadata} for f in fields(self)]


P5 = Settings()

# What is printed taken literally, and what is not printed from Table I. Sd over mean of its errors is 0.755, that is
# sqrt(pi/2 - 1), so they are of one axis each and Gaussian, 0.0128 m; the printed filter makes that of a sensor of
# 0.0139 m, and of the same number in rad/s the printed angle error. Chosen by looking at Tables II to V are the rate
# gain, the position weights and the acceleration limit (8 of 6 to 11).
LITERAL = Settings(
    torque_noise=0.005,  # n1:3 ~ N(0, h), the same h as thrust: 15 deg rms of tilt
    position_sd=0.0139, velocity_sd=0.0139, attitude_sd=0.0139, body_rate_sd=0.0139, acceleration_sd=0.0139,
    angle_gain=40.0,  # eq. 19
    rate_gain=20.0,  # at 15 some flights turn over, at 40 Izz has half its printed range
    position_weight=16.0, velocity_weight=4.0,
    acceleration_limit=8.0,  # 7 gives a third of the printed range of C's mass offline, 9 gives 2.6 times it online
)  # fmt: skip

READINGS = {"p5": P5, "literal": LITERAL}
