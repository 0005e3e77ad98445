"""Reference trajectories as pure functions of time: hover, figure 8, and the excitation for the inertia."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

Vector = tuple[float, float, float]
MAX_ACCELERATION = 8.0  # m/s^2; above, the thrust of a Crazyflie or the range of the setpoint is not enough


@dataclass(frozen=True, slots=True)
class Reference:
    """The desired state of the drone at one instant, world frame (z up).

    Attributes:
        position: m. velocity: m/s. acceleration: m/s^2, gravity excluded. jerk: m/s^3.
        yaw: rad about world z. yaw_rate: rad/s.
    """

    position: Vector
    velocity: Vector = (0.0, 0.0, 0.0)
    acceleration: Vector = (0.0, 0.0, 0.0)
    jerk: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Desired heading as a quaternion x y z w, body to world; controllers use only its yaw."""
        return 0.0, 0.0, math.sin(self.yaw / 2), math.cos(self.yaw / 2)


def reference_about(position: Vector, yaw: float, rows: Iterable[tuple[float, ...]]) -> Reference:
    """The reference from displacement, velocity, acceleration, jerk (x, y, z, yaw) about `position` [m] and `yaw`."""
    p, v, a, j = rows
    return Reference(
        position=(position[0] + p[0], position[1] + p[1], position[2] + p[2]),
        velocity=(v[0], v[1], v[2]),
        acceleration=(a[0], a[1], a[2]),
        jerk=(j[0], j[1], j[2]),
        yaw=yaw + p[3],
        yaw_rate=v[3],
    )


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A named function of time.

    Attributes:
        name: for reports.
        duration: s; the reference is at rest at 0 and at `duration`.
        at: time since the start [s] -> Reference; times outside [0, duration] hold the end points.
        finished: whether the trajectory has ended before its duration; the reference is then at rest.
    """

    name: str
    duration: float
    at: Callable[[float], Reference]
    finished: Callable[[], bool] = _never


def step_polynomials(x: Any) -> tuple[Any, Any, Any, Any]:
    """`smooth_step` within [0, 1], of a number or an array."""
    return (
        x**4 * (35 - 84 * x + 70 * x * x - 20 * x**3),
        140 * x**3 * (1 - x) ** 3,
        420 * x**2 * (1 - x) ** 2 * (1 - 2 * x),
        840 * x * (1 - x) * (1 - 5 * x + 5 * x * x),
    )


def smooth_step(x: float) -> tuple[float, float, float, float]:
    """A step from 0 to 1 over x in [0, 1]: value and first three derivatives by x, which are zero at both ends."""
    if x <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    if x >= 1.0:
        return 1.0, 0.0, 0.0, 0.0
    return step_polynomials(x)


def window(t: float, *, duration: float, ramp: float) -> tuple[float, float, float, float]:
    """A weight that rises from 0 to 1 in `ramp` seconds and falls to 0 at `duration`, with three derivatives."""
    ramp = min(ramp, duration / 2)
    if t <= ramp:
        w, sign = smooth_step(t / ramp), 1.0
    else:
        w, sign = smooth_step((duration - t) / ramp), -1.0
    return w[0], sign * w[1] / ramp, w[2] / ramp**2, sign * w[3] / ramp**3


def hover(*, position: Vector, yaw: float = 0.0, duration: float = 20.0) -> Trajectory:
    """Stay at `position` [m, world] with heading `yaw` [rad]."""
    reference = Reference(position=position, yaw=yaw)
    return Trajectory("hover", duration, lambda t: reference)


def after_hover(trajectory: Trajectory, *, seconds: float) -> Trajectory:
    """The same trajectory after `seconds` of hover at its start."""
    return Trajectory(
        trajectory.name, trajectory.duration + seconds, lambda t: trajectory.at(t - seconds), trajectory.finished
    )


def figure8(
    *,
    position: Vector,
    yaw: float = 0.0,
    duration: float = 20.0,
    size: tuple[float, float] = (1.0, 0.5),
    period: float = 5.0,
    ramp: float = 2.0,
) -> Trajectory:
    """A lemniscate x = sx sin p, y = sy sin 2p around `position` [m, world], in whole figures: it ends at its start.

    Args:
        duration: s; rounded to a whole number of figures, at least one.
        size: half widths along x and y, m.
        period: s for one whole figure at full speed.
        ramp: s to reach full speed, and to stop; at most a period.
    """
    rate = 2 * math.pi / period
    ramp = min(ramp, period)
    figures = max(math.floor((duration - ramp) / period + 0.5), 1)
    duration = figures * period + ramp  # the two ramps together cover one ramp's length of the figure

    def phase(t: float) -> tuple[float, float, float, float]:
        # The speed along the figure is ramped, not the size; the phase is the integral of the ramp.
        t = min(max(t, 0.0), duration)
        w, dw, ddw, _ = window(t, duration=duration, ramp=ramp)
        if t <= ramp:
            p = ramp * _smooth_step_integral(t / ramp)
        elif t <= duration - ramp:
            p = ramp / 2 + (t - ramp)
        else:
            p = duration - ramp - ramp * _smooth_step_integral((duration - t) / ramp)
        return rate * p, rate * w, rate * dw, rate * ddw

    def at(t: float) -> Reference:
        p, dp, ddp, dddp = phase(t)
        x = _chain(size[0] * math.sin(p), size[0] * math.cos(p), -size[0] * math.sin(p), -size[0] * math.cos(p),
                   dp, ddp, dddp)  # fmt: skip
        y = _chain(size[1] * math.sin(2 * p), 2 * size[1] * math.cos(2 * p), -4 * size[1] * math.sin(2 * p),
                   -8 * size[1] * math.cos(2 * p), dp, ddp, dddp)  # fmt: skip
        return Reference(
            position=(position[0] + x[0], position[1] + y[0], position[2]),
            velocity=(x[1], y[1], 0.0),
            acceleration=(x[2], y[2], 0.0),
            jerk=(x[3], y[3], 0.0),
            yaw=yaw,
        )

    return Trajectory("figure8", duration, at)


def _smooth_step_integral(x: float) -> float:
    """Integral of `smooth_step` from 0 to x in [0, 1]; 1/2 at 1."""
    return x**5 * (7 - 14 * x + 10 * x * x - 2.5 * x**3)


def _chain(f: float, f1: float, f2: float, f3: float, dp: float, ddp: float, dddp: float) -> tuple[float, ...]:
    """f(p(t)) and its first three time derivatives, by the chain rule."""
    return f, f1 * dp, f2 * dp * dp + f1 * ddp, f3 * dp**3 + 3 * f2 * dp * ddp + f1 * dddp


# Lines of the excitation [Hz]. No two axes share a line, and no line is a multiple of another in the band. A window of
# 8 s resolves the spacing (0.13 Hz and more), so the axes are uncorrelated in every window.
# Lateral lines: full-state setpoints have no jerk. So the Lee controller turns acceleration into torque only around and
# above its attitude bandwidth (about 1 Hz), most of all near its lightly damped resonance with the rotor lag at 5 Hz,
# where noise alone excites enough. Weights that fall with the frequency spread the torque over the lines, because only
# a range of frequencies separates inertia, rotor lag and delay.
EXCITE_X = (1.17, 1.71, 2.33, 3.03, 3.97)
EXCITE_Y = (1.07, 1.57, 2.17, 2.83, 3.67)
EXCITE_Z = (0.53, 0.83, 1.27, 1.87)
EXCITE_YAW = (0.97, 1.43, 2.01, 2.93)


@dataclass(frozen=True, slots=True)
class _Multisine:
    """Sum of sinusoids q = sum a sin(w t + p); Schroeder phases keep the peaks low."""

    amplitude: tuple[float, ...]
    rate: tuple[float, ...]
    phase: tuple[float, ...]

    @classmethod
    def of(cls, lines: tuple[float, ...], rms: float, turn: float, *, slope: float = 0.0) -> "_Multisine":
        """A multisine with `rms` of the second derivative, shared in proportion to frequency to the power `slope`."""
        n = len(lines)
        weights = [f**slope for f in lines]
        scale = rms * math.sqrt(2 / sum(w * w for w in weights))
        rates = tuple(2 * math.pi * f for f in lines)
        phases = tuple(turn - math.pi * i * (i + 1) / n for i in range(n))
        return cls(tuple(scale * k / w**2 for k, w in zip(weights, rates)), rates, phases)

    def derivatives(self, t: float) -> tuple[float, float, float, float]:
        q = dq = ddq = dddq = 0.0
        for a, w, p in zip(self.amplitude, self.rate, self.phase):
            s, c = math.sin(w * t + p), math.cos(w * t + p)
            q += a * s
            dq += a * w * c
            ddq -= a * w * w * s
            dddq -= a * w**3 * c
        return q, dq, ddq, dddq


def excite(
    *,
    position: Vector,
    yaw: float = 0.0,
    duration: float = 20.0,
    lateral: float = 0.45,
    vertical: float = 0.5,
    angular: float = 4.5,
    ramp: float = 1.5,
) -> Trajectory:
    """Hover with multisines on all four axes: the manoeuvre that makes mass, inertia and rotor lag observable.

    Position, velocity, acceleration and yaw are exact derivatives, so feedback and feed-forward agree.

    Args:
        lateral: rms acceleration along world x and along y, m/s^2. The default gives about 2e-4 N m of roll and pitch
            torque with the Lee controller at its default gains. A larger value costs height: the loss of thrust by
            tilt grows with its square.
        vertical: rms acceleration along world z, m/s^2.
        angular: rms yaw acceleration, rad/s^2 (0.05 rad of yaw, 2e-4 N m of torque).
        ramp: s to reach full amplitude, and to stop.
    """
    sines = (
        _Multisine.of(EXCITE_X, lateral, 0.3, slope=-0.5),
        _Multisine.of(EXCITE_Y, lateral, 1.9, slope=-0.5),
        _Multisine.of(EXCITE_Z, vertical, 0.9),
        _Multisine.of(EXCITE_YAW, angular, 2.6),
    )

    def at(t: float) -> Reference:
        t = min(max(t, 0.0), duration)
        w = window(t, duration=duration, ramp=ramp)
        # Product rule: (w q)' = w'q + w q', and so on.
        return reference_about(position, yaw, zip(*(_product(w, s.derivatives(t)) for s in sines)))

    return Trajectory("excite", duration, at)


def _product(w: tuple[float, ...], q: tuple[float, ...]) -> tuple[float, float, float, float]:
    return (
        w[0] * q[0],
        w[1] * q[0] + w[0] * q[1],
        w[2] * q[0] + 2 * w[1] * q[1] + w[0] * q[2],
        w[3] * q[0] + 3 * w[2] * q[1] + 3 * w[1] * q[2] + w[0] * q[3],
    )
