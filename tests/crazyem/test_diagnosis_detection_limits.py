"""From what size on an effect is a finding, and which sizes stand for something else."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from diagnosis_parts import (
    DRAG,
    INERTIA,
    LOAD,
    QUADRATIC_DRAG,
    THRUST,
    TORQUE,
    WIND,
    ZERO_TRIM,
    data_of,
    rotor,
    start_point,
)

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.nuisances import is_nonphysical
from crazyem.diagnosis.naming.evidence import exceeds_limit, is_implausible
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.prior import Conditions

SLOPE = Candidate("thrust_curve", (), ("slope_error",))
SPUN = Candidate("rotor_inertia", (), ("inertia",))
MOMENT = Candidate("velocity_moment", (), ("roll_per_vy", "pitch_per_vx"))
LIFT = Candidate("ground_effect", (), ("strength", "height"))
SWUNG = Candidate("suspended_load", (), ("mass", "length"))
DAMPING = Candidate("rate_damping", (), ("x", "y", "z"))
FLATTEST, STRONGEST = SLOPE.range_of("slope_error")[0], rotor(2).range_of("scale")[1]
LOADED, LOADED_TRIM = (
    replace(v, effects={**v.effects, "payload": {"mass": 2e-3, "x": 0.01, "y": 0.0}}) for v in (DRONE, ZERO_TRIM)
)

# effect and its file; sizes that are findings; sizes that are not
FINDINGS = {
    "a slope, but not at the end of its range": (SLOPE, DRONE, [(FLATTEST + 1e-6,)], [(FLATTEST,), (0.02,)]),
    "a rotor no lighter than any propeller": (SPUN, DRONE, [(5e-9,)], [(1.9e-9,)]),
    "a drag along one axis of three": (
        DRAG, DRONE, [(0, 0.01, 0), (0, 1.2e-3, 0), (0, 0, 4e-3)], [(0, 0.8e-3, 0), (0, 0, 2e-3)],
    ),
    # air on rotors above the centre of mass tips the drone back; what tips it onward is feigned where it is small
    "a moment, from a larger size on where no rotor makes it": (
        MOMENT, DRONE, [(4e-6, -1e-6), (4e-6, 9e-6), (-2e-5, 1e-6)], [(2e-6, -2e-6), (-7e-6, 9e-6), (-1.2e-5, 5e-6)],
    ),
    "a rotor that is hardly stronger than the others": (rotor(2), DRONE, [(0.8,), (1.05,)], [(STRONGEST,)]),
    "a wind that does not only sink": (
        WIND, DRONE, [(0.2, 0, 0), (1, 1, 1.7), (0.5, 0, 0)], [(0.05, 0.05, 3), (-0.11, 0.03, 1.7)],
    ),
    "a wind that is no draft of the room": (WIND, ZERO_TRIM, [(0.9, 0.9, 0)], [(0.2, 0, 0), (0.5, 0, 0)]),
    "a ground effect that fades with height": (LIFT, DRONE, [(0.09, 0.1), (0.09, 0.5)], [(0.09, 10)]),
    "a thrust of any drone": (THRUST, DRONE, [(1.03,), (0.95,), (1.05,)], []),
    "a thrust beyond what days differ by": (THRUST, ZERO_TRIM, [(0.95,), (1.05,)], [(1.03,)]),
    "a share of the drone's mass on a string of any length": (SWUNG, DRONE, [(4e-4, 1.5)], [(2.5e-4, 1.5)]),
    "a load by its weight alone": (LOAD, DRONE, [(3e-4, 0, 0)], [(1e-4, 0.03, 0)]),
    "a load beyond what days differ by": (LOAD, ZERO_TRIM, [(9e-4, 0.01, 0)], [(5e-4, 0.01, 0)]),
    "a load that is not where the file has it": (LOAD, LOADED, [(2e-3, 0.02, 0)], [(2e-3, 0.01, 0)]),
    "a load that moved by more than a day": (LOAD, LOADED_TRIM, [(2e-3, 0.03, 0.02)], [(2e-3, 0.02, 0)]),
    "a drag that air has": (DRAG, DRONE, [(0.01, 4 * DRONE.mass, 0)], [(0.01, 6 * DRONE.mass, 0)]),
    "a quadratic drag that air has": (
        QUADRATIC_DRAG, DRONE, [(0.01, 2.5 * DRONE.mass, 0)], [(0.01, 3.5 * DRONE.mass, 0)],
    ),
}  # fmt: skip


def with_sizes(candidate, sizes, vehicle=DRONE):
    """The model of the vehicle with the first parameters of an effect of these sizes."""
    point = start_point(vehicle)
    return point.with_effects({candidate.effect: {**candidate.neutral(point), **dict(zip(candidate.free, sizes))}})


@pytest.mark.parametrize(("candidate", "vehicle", "findings", "others"), FINDINGS.values(), ids=FINDINGS)
def test_what_is_a_finding(candidate, vehicle, findings, others):
    assert all(exceeds_limit(with_sizes(candidate, sizes, vehicle), candidate) for sizes in findings)
    assert not any(exceeds_limit(with_sizes(candidate, sizes, vehicle), candidate) for sizes in others)


@pytest.mark.parametrize("name", ["a drag that air has", "a quadratic drag that air has"])
def test_a_drag_that_no_air_has_stands_for_something_else(name):
    candidate, _, (right,), (wrong,) = FINDINGS[name]
    assert [is_implausible(with_sizes(candidate, sizes), candidate) for sizes in (right, wrong)] == [False, True]


def test_no_faulty_rotor_is_much_stronger_and_none_gets_stronger_in_flight():
    assert rotor(2).range_of("scale") == (0.0, pytest.approx(1.1, abs=0.1))
    assert rotor(2, onset=11.0).range_of("scale") == (0.0, 1.0)


def test_a_scale_of_velocities_must_be_more_than_the_jitter_of_the_estimate():
    """20 % of the 7 mm/s of a hover are 1 mm/s, and any onboard estimate is as wrong; 20 % of 0.7 m/s are more."""
    for speed, counts in ((0.005, False), (0.5, True)):
        facts = Conditions(speed=np.full(3, speed), onboard=False)
        least = CATALOGUE["velocity_scale"].prior.detection_limit_in({}, facts)
        assert (least["x"][1] < 1.2 - 1.0) == counts


@pytest.mark.parametrize(
    ("candidate", "size", "counts"),
    [(THRUST, 0.993, False), (THRUST, 0.98, True), (LOAD, 0.006 * DRONE.mass, False), (LOAD, 0.02 * DRONE.mass, True)],
)
def test_beside_a_load_less_thrust_than_its_swing_leaves_open_of_its_weight_is_none(candidate, size, counts):
    data, alone = data_of(fly(seconds=6.0)), with_sizes(candidate, (size,))
    assert exceeds_limit(alone, candidate, data)
    beside = alone.with_effects({"suspended_load": {"mass": 0.001, "length": 0.3}})
    assert exceeds_limit(beside, candidate, data) == counts


REACH = 2 * np.hypot(*DRONE.arm)  # m: no part of a drone is further out
HEAVIEST = DRONE.mass * REACH**2  # kg m^2


@pytest.mark.parametrize(
    ("candidate", "possible", "impossible"),
    [
        # 27 g, a tenth of a metre out at most, are 3e-5 kg m^2
        (INERTIA, (2e-5, 2e-5, 0.9 * HEAVIEST), (2e-5, 2e-5, 1.1 * HEAVIEST)),
        (TORQUE, (1.1 * max(DRONE.inertia) / HEAVIEST,), (0.9 * max(DRONE.inertia) / HEAVIEST,)),
        # N m s: rates of a drone of 27 g would fall by 1/e within 30 ms, as in honey
        (DAMPING, (0, 5e-5, 0), (0, 5.6e-4, 0)),
    ],
    ids=["too heavy to turn", "torques too weak for a body", "turning as in honey"],
)
def test_what_no_drone_is(candidate, possible, impossible):
    assert not is_nonphysical(with_sizes(candidate, possible), [candidate])
    assert is_nonphysical(with_sizes(candidate, impossible), [candidate])
    assert not is_nonphysical(with_sizes(candidate, impossible), [])  # free, and no finding
