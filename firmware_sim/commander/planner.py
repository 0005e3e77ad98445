"""The high-level commander's planner: take-off, land, go-to, spiral, and uploaded trajectories.

Source: crazyflie-firmware planner.c and crtp_commander_high_level.c. Times in s since boot.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

from firmware_sim.commander.polynomials import (
    Evaluation,
    Piece,
    Vector,
    evaluate,
    reversed_piece,
    seventh_order,
    stretched,
)

_ZERO = (0.0, 0.0, 0.0)


class PlannerState(IntEnum):
    """States of the planner; the FLYING bit is also set while landing."""

    IDLE = 0
    FLYING = 1
    DISABLED = 2
    LANDING = 3


@dataclass(frozen=True)
class Trajectory:
    """Pieces flown one after the other from begin [s], turned by `turn` [rad] about the origin, then shifted [m]."""

    pieces: tuple[Piece, ...]
    begin: float
    shift: Vector = _ZERO
    turn: float = 0.0

    @property
    def duration(self) -> float:
        """Total duration [s]."""
        return sum(piece.duration for piece in self.pieces)

    def at(self, time: float) -> Evaluation:
        """The trajectory at a time [s]; after its end, its last point at rest."""
        t = max(time - self.begin, 0.0)
        for piece in self.pieces:
            if t <= piece.duration:
                return self._moved(evaluate(piece, t))
            t -= piece.duration
        last = self._moved(evaluate(self.pieces[-1], self.pieces[-1].duration))
        return replace(last, velocity=_ZERO, acceleration=_ZERO, jerk=_ZERO, omega=_ZERO, yaw_rate=0.0)

    def _moved(self, e: Evaluation) -> Evaluation:
        c, s = math.cos(self.turn), math.sin(self.turn)

        def rotate(v: Vector) -> Vector:
            return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])

        p = rotate(e.position)
        return replace(
            e,
            position=(p[0] + self.shift[0], p[1] + self.shift[1], p[2] + self.shift[2]),
            velocity=rotate(e.velocity),
            acceleration=rotate(e.acceleration),
            jerk=rotate(e.jerk),
            yaw=e.yaw + self.turn,
        )


def wrap(angle: float) -> float:
    """The angle [rad] in -pi..pi."""
    return math.remainder(angle, 2.0 * math.pi)


def _segment(duration: float, start: Evaluation, end: Evaluation) -> Piece:
    """A seventh-order piece from start to end: position, velocity, acceleration; yaw and its rate."""

    def axis(n: int) -> tuple[float, ...]:
        return seventh_order(
            duration,
            (start.position[n], start.velocity[n], start.acceleration[n]),
            (end.position[n], end.velocity[n], end.acceleration[n]),
        )

    yaw = seventh_order(duration, (start.yaw, start.yaw_rate, 0.0), (end.yaw, end.yaw_rate, 0.0))
    return Piece((axis(0), axis(1), axis(2), yaw), duration)


def at_rest(position: Vector, yaw: float, velocity: Vector = _ZERO) -> Evaluation:
    """A point without acceleration or rotation."""
    return Evaluation(position, velocity, _ZERO, _ZERO, yaw, 0.0, _ZERO)


class Planner:
    """The current plan. `last` is where the next one starts: the last setpoint, or the estimated state when idle."""

    def __init__(self) -> None:
        self.state = PlannerState.IDLE
        self.trajectory: Trajectory | None = None
        self.last = at_rest(_ZERO, 0.0)

    def set_state(self, position: Vector, velocity: Vector, yaw: float) -> None:
        """Set the estimated state [m, m/s, rad], where a plan starts unless another is being flown."""
        self.last = at_rest(position, yaw, velocity)

    def stop(self) -> None:
        """Motors off."""
        self.state = PlannerState.IDLE

    def disable(self) -> None:
        """Delete the plan and give no setpoints (after an evaluation that is not a number)."""
        self.state = PlannerState.DISABLED

    @property
    def active(self) -> bool:
        """True while the planner has a trajectory to give setpoints from."""
        return self.state in {PlannerState.FLYING, PlannerState.LANDING}

    def finished(self, time: float) -> bool:
        """True when the latest trajectory has ended (or there never was one)."""
        return self.trajectory is None or time - self.trajectory.begin >= self.trajectory.duration

    def goal(self, time: float) -> Evaluation | None:
        """Where the drone should be at a time [s]; None when idle or disabled. A landing ends in idle, motors off."""
        if not self.active or self.trajectory is None:
            return None
        if self.state == PlannerState.LANDING and self.finished(time):
            self.state = PlannerState.IDLE
        self.last = self.trajectory.at(time)
        return self.last

    # Commands; each returns 0, or the firmware's error code.

    def takeoff(self, height: float, yaw: float | None, duration: float, time: float) -> int:
        """Straight up (or down) to a height [m], turning to yaw [rad] (None: as it is) in duration [s]."""
        if self.active:
            return 1
        return self._vertical(height, yaw, duration, time, PlannerState.FLYING)

    def land(self, height: float, yaw: float | None, duration: float, time: float) -> int:
        """Straight to a height [m]; motors off at the end."""
        if self.state == PlannerState.LANDING:
            return 1
        return self._vertical(height, yaw, duration, time, PlannerState.LANDING)

    def _vertical(self, height: float, yaw: float | None, duration: float, time: float, state: PlannerState) -> int:
        here = wrap(self.last.yaw)
        goal_yaw = here if yaw is None else here + wrap(yaw - here)
        x, y, _ = self.last.position
        start, end = at_rest(self.last.position, here), at_rest((x, y, height), goal_yaw)
        return self._fly((_segment(duration, start, end),), time, state)

    def go_to(
        self, goal: Vector, yaw: float, duration: float, time: float, *, relative: bool = False, linear: bool = False
    ) -> int:
        """To a point [m] and yaw [rad] in duration [s], from the present motion; linear: at constant velocity."""
        now = self.goal(time) or self.last
        if relative:
            goal = (goal[0] + now.position[0], goal[1] + now.position[1], goal[2] + now.position[2])
            yaw += now.yaw
        here = wrap(now.yaw)
        turn = wrap(yaw - here)
        start, end = replace(now, yaw=here, yaw_rate=now.omega[2]), at_rest(goal, here + turn)
        if linear and duration > 0.0:
            v = tuple((b - a) / duration for a, b in zip(now.position, goal, strict=True))
            steady: Vector = (v[0], v[1], v[2])
            start = replace(start, velocity=steady, acceleration=_ZERO, yaw_rate=turn / duration)
            end = replace(end, velocity=steady, yaw_rate=turn / duration)
        return self._fly((_segment(duration, start, end),), time, PlannerState.FLYING)

    def spiral(
        self,
        angle: float,
        radii: tuple[float, float],
        ascent: float,
        duration: float,
        time: float,
        *,
        sideways: bool = False,
        clockwise: bool = False,
    ) -> int:
        """A spiral about a point beside (or, sideways, ahead of) the drone.

        angle [rad, at most a turn], radii at start and end [m], ascent [m].
        One polynomial between the exact states at both ends: r(t) and phi(t) linear in time, yaw following phi.
        """
        if duration <= 0.0:
            return 0
        angle = max(-2.0 * math.pi, min(2.0 * math.pi, angle))
        r0, r1 = max(radii[0], 0.0), max(radii[1], 0.0)
        now = self.goal(time) or self.last
        sense = 1.0 if clockwise else -1.0
        rate, growth = -sense * angle / duration, (r1 - r0) / duration
        phi0 = wrap(now.yaw)

        def end(r: float, phi: float) -> tuple[Vector, Vector, Vector]:
            """Offset from the centre, velocity and acceleration; e is the direction from the centre, n its normal."""
            c, s = math.cos(phi), math.sin(phi)
            e, n = (
                ((-sense * c, -sense * s), (sense * s, -sense * c))
                if sideways
                else ((-sense * s, sense * c), (-sense * c, -sense * s))
            )
            offset = (r * e[0], r * e[1], 0.0)
            vx, vy = (growth * e[k] + r * rate * n[k] for k in (0, 1))
            ax, ay = (2.0 * growth * rate * n[k] - r * rate**2 * e[k] for k in (0, 1))
            return offset, (vx, vy, ascent / duration), (ax, ay, 0.0)

        offset0, v0, a0 = end(r0, phi0)
        offset1, v1, a1 = end(r1, phi0 - sense * angle)
        p0 = now.position
        p1 = (p0[0] - offset0[0] + offset1[0], p0[1] - offset0[1] + offset1[1], p0[2] + ascent)
        start = Evaluation(p0, v0, a0, _ZERO, phi0, rate, _ZERO)
        finish = Evaluation(p1, v1, a1, _ZERO, phi0 - sense * angle, rate, _ZERO)
        return self._fly((_segment(duration, start, finish),), time, PlannerState.FLYING)

    def start_trajectory(
        self,
        pieces: list[Piece],
        time: float,
        *,
        timescale: float = 1.0,
        backwards: bool = False,
        relative_position: bool = False,
        relative_yaw: bool = False,
    ) -> int:
        """Fly uploaded pieces; timescale > 1 is slower; relative: from the last setpoint (and its yaw)."""
        flown = [stretched(piece, timescale) for piece in pieces]
        if backwards:
            flown = [reversed_piece(piece) for piece in reversed(flown)]
        trajectory = Trajectory(tuple(flown), time)
        if relative_position:
            # As in the firmware: the shift is computed before the turn, which is about the origin of the trajectory.
            begin = trajectory.at(time)
            shift = tuple(a - b for a, b in zip(self.last.position, begin.position, strict=True))
            turn = wrap(self.last.yaw - begin.yaw) if relative_yaw else 0.0
            trajectory = replace(trajectory, shift=(shift[0], shift[1], shift[2]), turn=turn)
        self.trajectory, self.state = trajectory, PlannerState.FLYING
        return 0

    def _fly(self, pieces: tuple[Piece, ...], time: float, state: PlannerState) -> int:
        self.trajectory, self.state = Trajectory(pieces, time), state
        return 0
