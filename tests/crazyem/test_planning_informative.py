"""A trajectory that is planned while it is flown: segments at rest at both ends, goal, time, planners that are late."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from crazyem import cli
from crazyem.control.harmonics import Axis, Harmonics
from crazyem.control.named_trajectories import trajectory_maker
from crazyem.control.trajectories import Reference, Trajectory, after_hover
from crazyem.errors import CrazyemError, UsageError
from crazyem.estimation.result import Estimate, ParameterEstimate
from crazyem.planning.closed_loop import fly
from crazyem.planning.information import Expectation
from crazyem.planning.informative import SEGMENT, WANTED, Informative, Request, segment
from crazyem.planning.limits import Limits
from crazyem.vehicle import load_vehicle

VEHICLE = load_vehicle("cf2")
WAVE = Harmonics(SEGMENT, 1.0, (Axis((1.0,), (0.03,), (0.0,)), Axis(), Axis(), Axis((1.2,), (0.1,), (0.0,))))
NAMES = ("force_x", "force_y", "thrust", "torque_x", "torque_y", "torque_z", "position", "velocity", "attitude",
         "body_rate")  # fmt: skip


@dataclass
class Made:
    """A planner that answers each request after some looks, or with nothing after some segments."""

    late: int = 0
    answers: int = 1000
    requests: list[Request] = field(default_factory=list)
    looks: int = 0
    closed: bool = False

    def ask(self, request: Request) -> None:
        self.requests.append(request)
        self.looks = 0

    def answer(self, timeout: float = 0.0) -> tuple[bool, Harmonics | None]:
        self.looks += 1
        if timeout == 0.0 and self.looks <= self.late:
            return False, None
        return True, WAVE if len(self.requests) <= self.answers else None

    def close(self) -> None:
        self.closed = True


def estimate(sd: float, *, identifiable: bool = True) -> Estimate:
    body = dict(zip(WANTED, (0.03, *VEHICLE.inertia)))
    said = {n: ParameterEstimate(v, sd * v, (0.0, 1.0), "", identifiable, "") for n, v in body.items()}
    return Estimate(time=1.0, parameters=said, noise=dict.fromkeys(NAMES, 1e-3))


def started(**settings: Any) -> tuple[Informative, Trajectory]:
    """A started trajectory, and its path from one metre above the origin."""
    made = Informative(VEHICLE, **{"planner": Made(), **settings})
    made.start()
    return made, made((0.0, 0.0, 1.0), 0.0)


def flown(trajectory: Trajectory, *, step: float = 0.01) -> list[Reference]:
    references, time = [], 0.0
    while not trajectory.finished() and time < trajectory.duration:
        references.append(trajectory.at(time))
        time += step
    return references


def test_segments_follow_one_another_until_time_is_up_and_all_is_at_rest_then() -> None:
    made = Informative(VEHICLE, duration=17.0, planner=Made())
    made.start()
    path = made((1.0, 2.0, 1.5), 0.4)
    seen = flown(path)
    assert made.segments == 3
    steps = np.diff([r.position for r in seen], axis=0)
    assert np.abs(steps).max() < 0.01 * 0.6  # m/s: no leap between segments
    assert path.finished()
    last = path.at(16.9)
    assert last.position == pytest.approx((1.0, 2.0, 1.5))
    assert last.velocity == (0.0, 0.0, 0.0)
    assert last.yaw == pytest.approx(0.4)


def test_before_its_begin_it_hovers() -> None:
    made, path = started()
    path = after_hover(path, seconds=2.0)
    assert path.at(1.0).position == (0.0, 0.0, 1.0)
    assert made.segments == 0
    assert not path.finished()


def test_the_goal_ends_the_flight_at_the_end_of_a_segment() -> None:
    made, path = started(duration=60.0, goal=0.05)
    made.estimate = lambda: estimate(0.02)
    seen = flown(path)
    assert made.segments == 1
    assert len(seen) == pytest.approx(SEGMENT / 0.01, abs=2)
    assert seen[-1].position == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)


@pytest.mark.parametrize("said", [estimate(0.05), estimate(0.01, identifiable=False), None])
def test_a_goal_that_is_not_met_is_flown_for_on(said: Estimate | None) -> None:
    made, path = started(duration=12.0, goal=0.05)
    made.estimate = lambda: said
    flown(path)
    assert made.segments == 2


def test_a_late_plan_is_waited_for_in_hover() -> None:
    made, path = started(duration=12.0, planner=Made(late=100))
    seen = flown(path)
    waiting = seen[round(SEGMENT / 0.01) + 5 : round(SEGMENT / 0.01) + 90]
    assert all(r.position == (0.0, 0.0, 1.0) and r.velocity == (0.0, 0.0, 0.0) for r in waiting)
    assert made.segments == 2


def test_without_a_further_plan_the_flight_ends() -> None:
    made, path = started(duration=60.0, planner=Made(answers=1))
    flown(path)
    assert made.segments == 1
    assert path.finished()


def test_what_is_known_goes_into_the_next_request() -> None:
    planner = Made()
    made, path = started(planner=planner)
    assert all(math.isinf(s) for s in planner.requests[0].spread)
    assert planner.requests[0].noise is None
    made.estimate = lambda: estimate(0.04)
    path.at(0.0)
    request = planner.requests[1]
    assert request.vehicle.mass == pytest.approx(0.03)
    assert request.spread == pytest.approx((0.04,) * 4)
    assert request.noise is not None
    assert request.noise.impulse[2] == pytest.approx(1e-3 / 0.03)


def test_an_estimate_far_from_the_file_is_not_planned_by() -> None:
    planner = Made()
    made, path = started(planner=planner)
    wrong = ParameterEstimate(5.0 * VEHICLE.inertia[0], 1e-6, (0.0, 1.0), "", True, "")
    said = estimate(0.04)
    made.estimate = lambda: Estimate(time=1.0, parameters={**said.parameters, "Ixx": wrong}, noise=said.noise)
    path.at(0.0)
    assert planner.requests[1].vehicle.inertia == VEHICLE.inertia


def test_nothing_spins_without_a_first_plan() -> None:
    with pytest.raises(CrazyemError, match="no informative manoeuvre"):
        Informative(VEHICLE, planner=Made(answers=0)).start()


@pytest.mark.slow
def test_a_segment_is_aimed_at_what_is_still_wide() -> None:
    """What is known to 0.1 % is left to others: each of two segments tells more of what it was planned for."""
    expectation = Expectation(VEHICLE)

    def spread(known: tuple[float, ...]) -> np.ndarray:
        found = segment(Request(VEHICLE, None, known, Limits(), 1))
        assert found is not None
        return expectation.of(fly(found, VEHICLE)).sd

    tilt, yaw = spread((1e-3, 0.3, 0.3, 1e-3)), spread((1e-3, 1e-3, 1e-3, 0.3))
    assert tilt[1] * tilt[2] < yaw[1] * yaw[2]  # D-optimal: the volume of the joint interval
    assert yaw[3] < tilt[3]


def test_the_command_refuses_what_has_no_room(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fly", "--trajectory", "informative", "--duration", "3"]) == 2
    assert "at least 5 s" in capsys.readouterr().err
    assert cli.main(["fly", "--trajectory", "informative", "twice"]) == 2
    with pytest.raises(UsageError, match="one drone"):
        trajectory_maker(("informative",), 20.0)
