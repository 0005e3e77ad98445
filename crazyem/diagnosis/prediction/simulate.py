"""Open-loop simulation of many starts at once: a rigid body with effects, driven by recorded inputs.

Integration is by the explicit midpoint rule, with sub-steps of at most `PREDICTION.substep`. The mean thrust over each
is exact for a lag between commands. Start states and predicted states are as a recording shows them: effects on sensors
(misalignment, velocity scale, bias, delay) are removed from the start state and added to every predicted one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.inputs import Inputs
from crazyem.diagnosis.prediction.bias_correction import Weights
from crazyem.diagnosis.prediction.course import ThrustCourse
from crazyem.diagnosis.settings import PREDICTION
from crazyem.physics.effects.effect import LONGEST_STEP, Effects, Situation
from crazyem.physics.effects.external_force import WIND
from crazyem.physics.effects.onboard_estimate import MEMORY_SECONDS, disturbs_attitude
from crazyem.physics.effects.pendulum import swing_along, swing_on, watched_along
from crazyem.physics.effects.suspended_load import SUSPENDED_LOAD
from crazyem.physics.motion import Motion, active, body_of, measured, motion
from crazyem.physics.rotations import (
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_product,
    rotation_matrix,
)
from crazyem.vehicle import GRAVITY, Vehicle


@dataclass
class _Body:
    """True states of n simulations, without the effects on sensors; a suspended load is part of the state.

    position, velocity (n, 3) world, attitude (n, 4), rate (n, 3) body, swing (n, 6) of a suspended load or None.
    With corrections of the rotation: since (n,) s from the start, gained (n, 3) rad/s, integral of the angular
    acceleration by the model since then.
    """

    position: NDArray
    velocity: NDArray
    attitude: NDArray
    rate: NDArray
    swing: NDArray | None = None
    since: NDArray | None = None
    gained: NDArray | None = None

    @staticmethod
    def of(state: NDArray) -> "_Body":
        return _Body(state[:, 0:3], state[:, 3:6], state[:, 6:10], state[:, 10:13])

    def array(self) -> NDArray:
        return np.concatenate([self.position, self.velocity, self.attitude, self.rate], axis=1)

    def displaced(self, offset: NDArray) -> "_Body":
        """The states displaced by (n, 12); the attitude is multiplied by exp of its part, in the body."""
        return _Body(
            self.position + offset[:, 0:3],
            self.velocity + offset[:, 3:6],
            turned(self.attitude, offset[:, 6:9]),
            self.rate + offset[:, 9:12],
            self.swing,
        )


def turned(attitude: NDArray, by: NDArray) -> NDArray:
    """attitude (n, 4) * exp(by (n, 3) rad), normalised."""
    q = quaternion_product(attitude, quaternion_from_rotation_vector(by))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class _Row:
    """A true state, and the accelerations and the situation of the step before it."""

    body: _Body
    moved: Motion
    situation: Situation


class Simulator:
    """The model of a vehicle with effects, driven by recorded inputs.

    Args:
        inputs: of the recording.
        effects: None: those of the vehicle.
        vehicle: other constants than those of the inputs (mass, inertia, arm, lag; not the thrust curve, which is part
            of the inputs).
    """

    def __init__(self, inputs: Inputs, effects: Effects | None = None, *, vehicle: Vehicle | None = None) -> None:
        self.vehicle = inputs.vehicle if vehicle is None else vehicle
        self.effects: Effects = self.vehicle.effects if effects is None else effects
        self.inputs = inputs
        self.course = ThrustCourse(inputs.rotor, vehicle=self.vehicle, effects=self.effects)
        sensors = [values for effect, values in active(self.effects, self.vehicle) if effect.measured is not None]
        self._shows = bool(sensors)
        self._weights: Weights | None = None
        self._begun = np.zeros((0, 3))
        self._late: NDArray | float = 0.0  # s, delay as known at each start less the final one
        back = max((float(values.get("delay", 0.0)) for values in sensors), default=0.0)  # s
        forgotten = MEMORY_SECONDS if inputs.fused and any(disturbs_attitude(values) for values in sensors) else 0.0
        self._looks_back = back + forgotten
        values = {effect.name: found for effect, found in active(self.effects, self.vehicle)}
        load = values.get(SUSPENDED_LOAD.name, {"mass": 0.0, "length": None})
        self._load: float = load["mass"]
        self._length: float | None = load["length"]
        self._air = np.array([values.get(WIND.name, {}).get(axis, 0.0) for axis in "xyz"])
        constant = self.vehicle.rotor_constant
        self._rotor_constant = float("nan") if constant is None else constant

    def swings(self, time: NDArray, state: NDArray, airborne: NDArray) -> NDArray | None:
        """(r, 6) swing of a suspended load along a recorded path, each row from rows up to it; None without a load.

        time: (r,) s, increasing; state: (r, 13), NaN where not known; airborne: (r,) bool, rows at which the recorded
        force shows the pull of the load. At the first row, and after gaps, the load hangs at rest.
        """
        if self._length is None:
            return None
        gap = np.diff(time, prepend=time[:1])
        known = np.isfinite(state).all(axis=1)
        broken = (gap <= 0.0) | (gap > LONGEST_STEP) | ~known
        broken[1:] |= ~known[:-1]
        velocity = state[:, 3:6]
        air = np.broadcast_to(self._air, velocity.shape)
        hanging = {"gap": gap, "broken": broken, "velocity": velocity, "air": air, "length": self._length}
        rows = 1 + np.flatnonzero(~broken[1:] & airborne[1:] & airborne[:-1])
        share = self._load / (body_of(self.vehicle, self.effects).mass + self._load)
        if rows.size < 3 or share <= 0.0:
            return swing_along(**hanging)
        free, seen = np.zeros_like(velocity), np.full_like(velocity, np.nan)
        rotation = np.broadcast_to(np.eye(3), (time.size, 3, 3)).copy()
        free[rows], seen[rows], rotation[rows] = self._forces(time, state, rows)
        bend = np.diff((seen - free)[rows], n=2, axis=0)  # the pull of a load is nearly linear over three rows
        noise = np.sqrt(np.median(gap[rows])) * np.median(np.abs(bend), axis=0) / (0.6745 * np.sqrt(6.0))
        return watched_along(
            **hanging,
            share=share,
            rotation=rotation,
            free=free,
            shown=seen,
            noise=np.maximum(noise, PREDICTION.min_unrest),
        )

    def _forces(self, time: NDArray, state: NDArray, rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Specific force by the model without a load, and as recorded, (m, 3) m/s^2, body, over the steps that end at
        rows (m,) of a path; and attitudes (m, 3, 3) in the middle of the steps."""
        effects = {name: values for name, values in self.effects.items() if name != SUSPENDED_LOAD.name}
        begin, end = time[rows - 1], time[rows]
        last = self.course.newest(begin)
        step = end - begin
        thrust, rate = self.course.over(begin, end, last=last)
        before, after = state[rows - 1], state[rows]
        middle = _Body.of(0.5 * (before + after))
        middle.attitude = turned(before[:, 6:10], 0.5 * step[:, None] * middle.rate)
        situation = self._situation(middle, end, step, thrust, rate, last)
        free = motion(situation, vehicle=self.vehicle, effects=effects).specific_force
        world = (after[:, 3:6] - before[:, 3:6]) / step[:, None] + np.array([0.0, 0.0, GRAVITY])
        return free, situation.to_body(world), situation.rotation

    def run(
        self,
        state: NDArray,
        times: NDArray,
        *,
        swing: NDArray | None = None,
        attitude: Callable[[NDArray], tuple[NDArray, NDArray]] | None = None,
        given: NDArray | None = None,
        substep: float = PREDICTION.substep,
        weights: Weights | None = None,
    ) -> NDArray:
        """Predicted states at times[:, 1:].

        Args:
            state: (n, 13) as shown by the recording at times[:, 0].
            times: (n, N + 1) s, increasing along each row.
            swing: (n, 6) of a suspended load at times[:, 0], see `swings`; None: it hangs at rest.
            attitude: function of (n,) s that gives recorded attitudes (n, 4) and body rates (n, 3). They replace the
                predicted ones, so that only forces are tested; the result is then no prediction.
            given: (n,) s, end of the known inputs, after which the last is held; None: the start of the last step.
            substep: largest step of the integration [s].
            weights: corrections of each start (see `bias_correction.py`); None: the model alone.

        Returns: (n, N, 13), as the recording would show them.
        """
        known_so_far = self.inputs.alignment
        self._late = 0.0 if known_so_far is None else known_so_far.known_at(times[:, 0]) - known_so_far.delay
        last = self.course.newest(times[:, -2] if given is None else given)
        known = np.minimum(last, self.course.newest(times[:, 0]))
        start = _Body.of(state)
        if self._length is not None:
            start.swing = np.tile([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], (len(state), 1)) if swing is None else swing
        path: list[_Row] = []
        self._weights = weights
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            body, before = self._true(start, times[:, 0], known)
            turn = quaternion_product(quaternion_conjugate(start.attitude), body.attitude)
            bias = body.rate - start.rate
            if weights is not None:
                body = replace(body, since=np.zeros(len(state)), gained=np.zeros((len(state), 3)))
                self._begun = body.rate
            for k in range(times.shape[1] - 1):
                begin, span = times[:, k], times[:, k + 1] - times[:, k]
                pieces = max(1, int(np.ceil(float(span.max(initial=0.0)) / substep - 1e-6)))
                for j in range(pieces):
                    now = begin + span * (j / pieces)
                    if attitude is not None:
                        shown, rate = attitude(now)
                        body = replace(body, attitude=quaternion_product(shown, turn), rate=rate + bias)
                    body, moved, situation = self._step(body, now, begin + span * ((j + 1) / pieces), last)
                path.append(_Row(body, moved, situation))
            return self._shown([*before, *path])[:, -len(path) :]

    def _step(self, body: _Body, begin: NDArray, end: NDArray, last: NDArray) -> tuple[_Body, Motion, Situation]:
        """One step by the explicit midpoint rule, with the mean thrust over it; backwards if `end` is earlier."""
        thrust, rate = self.course.over(begin, end, last=last, late=self._late)
        step = end - begin
        before = self._situation(body, end, step, thrust, rate, last)
        moved = motion(before, vehicle=self.vehicle, effects=self.effects)
        middle = self._advanced(body, before.rotation, moved, 0.5 * step)
        situation = self._situation(middle, end, step, thrust, rate, last, moved)
        moved = motion(situation, vehicle=self.vehicle, effects=self.effects)
        return self._advanced(body, situation.rotation, moved, step), moved, situation

    def _advanced(self, body: _Body, rotation: NDArray, moved: Motion, step: NDArray) -> _Body:
        """The state one step later with constant accelerations; `rotation` (n, 3, 3) turns the force to the world."""
        h = step[:, None]
        force = moved.specific_force
        if self._weights is not None:  # also before the start, where the measurements of late sensors begin
            force = force + self._weights.force
        acceleration = np.einsum("nij,nj->ni", rotation, force) - np.array([0.0, 0.0, GRAVITY])
        velocity = body.velocity + h * acceleration
        rate, since, gained = body.rate + h * moved.angular_acceleration, body.since, body.gained
        if since is not None and gained is not None and self._weights is not None:
            since, gained = since + step, gained + h * moved.angular_acceleration
            rate = self._begun + self._weights.changed(since, gained)
        swing = body.swing
        if swing is not None and self._length is not None and (step > 0).all():  # constant in backward steps
            air = np.broadcast_to(self._air, velocity.shape)
            swing = swing_on(
                swing, acceleration=acceleration, velocity=body.velocity, air=air, step=step, length=self._length
            )
        return _Body(
            body.position + 0.5 * h * (body.velocity + velocity),
            velocity,
            turned(body.attitude, 0.5 * h * (body.rate + rate)),
            rate,
            swing,
            since,
            gained,
        )

    def _situation(
        self, body: _Body, time: NDArray, step: NDArray, thrust: NDArray, rate: NDArray, last: NDArray,
        moved: Motion | None = None,
    ) -> Situation:  # fmt: skip
        rotor = self.inputs.rotor
        at = np.clip(self.course.newest(time), 0, np.maximum(last, 0))
        zero = np.zeros((time.size, 3))
        return Situation(
            time=time,
            flown=np.maximum(time - self.inputs.took_off, 0.0),
            step=np.abs(step),
            position=body.position,
            height=np.maximum(body.position[:, 2] - self.inputs.ground, 0.0),
            velocity=body.velocity,
            rotation=rotation_matrix(body.attitude),
            body_rate=body.rate,
            specific_force=zero if moved is None else moved.specific_force,
            angular_acceleration=zero if moved is None else moved.angular_acceleration,
            thrust=thrust,
            thrust_rate=rate,
            voltage=rotor.voltage[at],
            rotor_constant=self._rotor_constant,
            air=zero,
            swing=body.swing,
            fused=self.inputs.fused,
        )

    # effects on sensors: they depend on the path, because some sensors show the past

    def _true(self, shown: _Body, time: NDArray, known: NDArray) -> tuple[_Body, list[_Row]]:
        """The true state of a recorded one, and the path before it as far as sensors look back.

        The offsets of sensors depend on the true state, so they are removed by fixed-point iteration.
        """
        if not self._shows:
            return shown, []
        body = shown
        for _ in range(4):
            rows = self._led_to(body, time, known)
            offset = self._offsets(rows)[:, -1]
            body = shown.displaced(-offset)
        return body, self._led_to(body, time, known)

    def _led_to(self, body: _Body, time: NDArray, known: NDArray) -> list[_Row]:
        """The path to a state by integration back in time, oldest row first; the state itself is the last row."""
        count = int(np.ceil(self._looks_back / PREDICTION.back)) + 1
        rows = []
        for j in range(count):
            now = time - PREDICTION.back * j
            before, moved, situation = self._step(body, now, now - PREDICTION.back, known)
            rows.append(_Row(body, moved, replace(situation, time=now)))
            body = before
        return rows[::-1]

    def _offsets(self, rows: list[_Row]) -> NDArray:
        """(n, m, 12) offsets of sensors from the true state, along the m rows of a path."""
        n, m = rows[0].body.position.shape[0], len(rows)

        def along(values: list[NDArray]) -> NDArray:
            joined = np.stack(values, axis=1)
            return joined.reshape(n * m, *joined.shape[2:])

        time = along([row.situation.time for row in rows])
        step = np.diff(time.reshape(n, m), axis=1, prepend=time.reshape(n, m)[:, :1])  # 0: a path begins
        end = self._situation(
            _Body.of(along([row.body.array() for row in rows])),
            time,
            step.reshape(-1),
            along([row.situation.thrust for row in rows]),
            along([row.situation.thrust_rate for row in rows]),
            np.full(n * m, len(self.course.time) - 1),
            Motion(
                along([row.moved.specific_force for row in rows]),
                along([row.moved.angular_acceleration for row in rows]),
            ),
        )
        return measured(end, vehicle=self.vehicle, effects=self.effects).state.reshape(n, m, 12)

    def _shown(self, rows: list[_Row]) -> NDArray:
        """(n, m, 13) states as the recording would show them."""
        states = np.stack([row.body.array() for row in rows], axis=1)
        if not self._shows:
            return states
        n, m = states.shape[:2]
        shown = _Body.of(states.reshape(n * m, 13)).displaced(self._offsets(rows).reshape(n * m, 12))
        return shown.array().reshape(n, m, 13)
