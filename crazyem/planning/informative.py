"""A trajectory that is planned in flight from the newest estimate, segment by segment, until a goal is met.

The segments start and end in hover at the same point. During a segment, a separate process plans the next one from the
newest estimate, so that no setpoint is late. If the plan is not ready, the drone hovers. Every segment keeps the
limits, whatever the estimate.
"""

import math
import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

import numpy as np

from crazyem.control.harmonics import Harmonics
from crazyem.control.trajectories import Reference, Trajectory, Vector, hover
from crazyem.errors import CrazyemError
from crazyem.estimation.model import GROUPS, NAMES, Noise, setup_for
from crazyem.estimation.result import Estimate
from crazyem.planning.limits import Limits
from crazyem.planning.plan import INTERVAL, plan_parameters
from crazyem.vehicle import Vehicle

SEGMENT = 5.0  # s, duration of a segment
GOAL = 0.05  # relative half width of the 95 % intervals of mass, Ixx, Iyy and Izz
WANTED = NAMES[:4]
PROCESS = ("force_x", "force_y", "thrust", "torque_x", "torque_y", "torque_z")
FIRST_WITHIN = 120.0  # s of host time for the first plan, with compilation
FAR = 0.3  # largest difference of logarithms of an estimate and the vehicle file, for use in a plan


@dataclass(frozen=True)
class Request:
    """Data for the plan of a segment: newest vehicle constants, noise (None: usual), relative standard deviations of
    `WANTED` (infinite if unknown), limits, seed."""

    vehicle: Vehicle
    noise: Noise | None
    spread: tuple[float, ...]
    limits: Limits
    seed: int


def segment(request: Request) -> Harmonics | None:
    """The segment that gives the smallest intervals together with earlier information; None if there is none."""
    known = np.zeros((len(NAMES), len(NAMES)))
    for i, sd in enumerate(request.spread):
        known[i, i] = 0.0 if math.isinf(sd) else sd**-2.0
    plan = plan_parameters(
        WANTED, request.vehicle, request.limits, duration=SEGMENT, criterion="A", noise=request.noise, known=known,
        starts=1, seed=request.seed, iterations=6, foretold=False,
    )  # fmt: skip
    return plan.manoeuvre


class PlannerProcess:
    """A planner in a separate process, which ends with this process."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._mine, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,), daemon=True, name="crazyem-planner")
        self._process.start()
        other.close()

    def ask(self, request: Request) -> None:
        self._mine.send(request)

    def answer(self, timeout: float = 0.0) -> tuple[bool, Harmonics | None]:
        """Whether there is an answer to the last request, and the answer."""
        try:
            if not self._mine.poll(timeout):
                return False, None
            found = self._mine.recv()
        except (EOFError, OSError):  # the process has ended: no more plans
            return True, None
        return True, found if isinstance(found, Harmonics) else None

    def close(self) -> None:
        self._process.terminate()
        self._process.join(2.0)
        self._mine.close()


def _serve(connection: "Connection[Harmonics | None, Request]") -> None:
    while True:
        try:
            request = connection.recv()
        except (EOFError, KeyboardInterrupt):
            return
        try:
            found = segment(request)
        except (CrazyemError, ValueError, ArithmeticError, np.linalg.LinAlgError):
            found = None
        connection.send(found)


class Informative:
    """A trajectory that is planned in flight.

    Args:
        vehicle: nominal constants. limits: of every segment.
        duration: s, at most.
        goal: relative half width of the 95 % intervals at which the flight ends.
        seed: of the plans. planner: None: a `PlannerProcess`.

    Attributes:
        estimate: function that returns the newest estimate, or None.
        segments: number of segments so far.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        limits: Limits | None = None,
        duration: float = 20.0,
        goal: float = GOAL,
        seed: int = 0,
        planner: PlannerProcess | None = None,
    ) -> None:
        self.vehicle, self.limits = vehicle, limits or Limits()
        self.duration, self.goal, self.seed = duration, goal, seed
        self.estimate: Callable[[], Estimate | None] = lambda: None
        self.segments = 0
        self._planner = planner or PlannerProcess()
        self._finished = False
        self._path: Trajectory | None = None
        self._begin = 0.0

    def start(self) -> None:
        """Plan the first segment, before the rotors start.

        Raises:
            CrazyemError: there is no segment within the limits.
        """
        self.limits.rotor_range(self.vehicle)
        self._planner.ask(self._request(None))
        ready, self._next = self._planner.answer(FIRST_WITHIN)
        if not ready or self._next is None:
            raise CrazyemError(f"no informative manoeuvre was found for {self.vehicle.name}.")
        self._asked = False

    def close(self) -> None:
        """End the planner."""
        self._planner.close()

    def __call__(self, position: Vector, yaw: float) -> Trajectory:
        """The trajectory from the hover point; its times must increase from call to call."""
        rest = hover(position=position, yaw=yaw).at(0.0)

        def at(time: float) -> Reference:
            if self._path is not None and time - self._begin >= self._path.duration:
                self._path = None
                self._finished = self._finished or self.reached()
            if self._path is None and time >= 0.0 and not self._finished:
                self._go_on(time, position, yaw)
            return rest if self._path is None else self._path.at(time - self._begin)

        return Trajectory("informative", self.duration, at, finished=lambda: self._finished)

    def _go_on(self, time: float, position: Vector, yaw: float) -> None:
        """Begin the next segment if it is planned and there is time for it."""
        if time + SEGMENT > self.duration:
            self._finished = True
            return
        if self._asked:
            ready, self._next = self._planner.answer()
            if not ready:
                return
            self._asked = False
        if self._next is None:  # there is no useful segment
            self._finished = True
            return
        self._path, self._begin = self._next.trajectory(position, yaw), time
        self.segments += 1
        self._planner.ask(self._request(self.estimate()))
        self._asked = True

    def reached(self) -> bool:
        """Whether the goal is met."""
        estimate = self.estimate()
        if estimate is None:
            return False
        return all(
            estimate[n].identifiable and INTERVAL * estimate[n].sd <= self.goal * estimate[n].value for n in WANTED
        )

    def _request(self, estimate: Estimate | None) -> Request:
        vehicle, noise, spread = self.vehicle, None, [math.inf] * len(WANTED)
        if estimate is not None:
            found = [estimate[n] for n in WANTED]
            spread = [p.sd / p.value if p.value > 0 else math.inf for p in found]
            body = [vehicle.mass, *vehicle.inertia]
            good = [p.identifiable and abs(math.log(p.value / b)) < FAR for p, b in zip(found, body)]
            body = [p.value if g else b for p, b, g in zip(found, body, good)]
            vehicle = replace(vehicle, mass=body[0], inertia=(body[1], body[2], body[3]))
            noise = noise_in(estimate.noise, vehicle)
        return Request(vehicle, noise, tuple(spread), self.limits, self.seed + self.segments)


def noise_in(table: "dict[str, float] | object", vehicle: Vehicle) -> Noise | None:
    """Noise scales of an estimate (N sqrt(s), N m sqrt(s), SI) in units of acceleration; None if one is missing."""
    keys = (*PROCESS, *GROUPS[:4])
    values = [table.get(k) for k in keys] if isinstance(table, dict) else []
    good = [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool) and 0 < v < math.inf]
    if len(good) != len(keys):
        return None
    body = np.array([vehicle.mass] * 3 + list(vehicle.inertia))
    rest = setup_for(vehicle).prior.noise.measurement[4]
    return Noise(np.array(good[:6]) / body, np.array([*good[6:], rest]))
