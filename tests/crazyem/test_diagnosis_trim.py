"""Real drones: trims as part of the vehicle file, commands sampled too coarsely, rotors relabelled by symmetry."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, data_of, start_point
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.candidates import TRIM, Candidate, candidates_for
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import Noise, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, without, without_unobservable
from crazyem.diagnosis.fitting.sampling import fast_share, mean_torque, with_zero_trim
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming.balance import balance_of, explanations
from crazyem.diagnosis.naming.evidence import usual_gusts
from crazyem.diagnosis.naming.steady import with_baseline
from crazyem.diagnosis.settings import FITTING
from crazyem.recordings import open_recording
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import cut
from crazyem.vehicle import Vehicle, load_vehicle, parse_vehicle

TRIMMED = replace(DRONE, effects={TRIM: {"x": 1e-4, "y": -2e-4, "z": 3e-4}, "linear_drag": {"x": 0.01}})
NOISE = Noise(np.full(6, 0.3), np.full(4, 1e-2))


def point_of(vehicle: Vehicle) -> Point:
    return Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, NOISE)


def test_neutral_is_what_the_vehicle_file_says() -> None:
    point = point_of(TRIMMED)
    assert Candidate(TRIM, (), ("x", "y", "z")).neutral(point) == TRIMMED.effects[TRIM]
    assert Candidate("linear_drag", (), ("x",)).neutral(point) == {"x": 0.01, "y": 0.0, "z": 0.0}
    faulty = point_of(replace(DRONE, effects={"rotor_fault": {"rotor": 3, "scale": 0.7}}))
    scales = [Candidate("rotor_fault", (("rotor", r),), ("scale",)).neutral(faulty)["scale"] for r in (1, 2, 3, 4)]
    assert scales == [1.0, 1.0, 0.7, 1.0]


def test_an_effect_is_taken_back_to_the_file_and_not_to_nothing() -> None:
    moved = point_of(TRIMMED).with_effects({TRIM: {"x": 9e-4}, "wind": {"x": 3.0}})
    back = without(without(moved, TRIM), "wind")
    assert back.effects == point_of(TRIMMED).effects


def test_a_day_is_free_only_where_the_file_has_a_trim() -> None:
    data = data_of(fly(seconds=6.0))
    for vehicle, there in ((DRONE, False), (TRIMMED, True)):
        free = {c.effect for c, _ in nuisances(data, point_of(vehicle), ())}
        assert ({TRIM, "thrust_scale", "velocity_moment"} <= free) is there
        assert usual_gusts(Point(vehicle, {}, start_noise())) == (
            1.0 if there else 0.4
        )  # m/s: weather of a drone that flew, air of a room
    stormy = replace(TRIMMED, effects={**TRIMMED.effects, "gusts": {"standard_deviation": 2.0}})
    assert usual_gusts(Point(stormy, {}, start_noise())) == pytest.approx(4.0)


@pytest.mark.slow
def test_a_trim_is_free_where_no_centre_of_mass_is_asked_for() -> None:
    """Rotors on the left weaker by 3 %, on the right stronger: thrust acts 3 % of the arm right of the middle."""
    lopsided = Hidden(thrust=(1.03, 1.03, 0.97, 0.97), drag=(0.02, 0.02, 0.0))
    flights = [replace(flight_of(fly(lopsided, seed=s, seconds=12.0), DRONE), coarse=True) for s in range(2)]
    drag = DRAG
    for vehicle, there in ((DRONE, True), (replace(DRONE, effects={TRIM: {"x": 0.0, "y": 0.0, "z": 0.0}}), False)):
        free = {c.effect: p for c, p in nuisances(Data(flights), point_of(vehicle), ())}
        sd = np.array(free["center_of_mass"]) ** -0.5
        assert sd[:2] == pytest.approx(0.05 * DRONE.arm[0] if there else 2e-5)
    data = Data(flights)
    start = nominal(data, start_point()).with_effects({"linear_drag": {"x": 0.01, "y": 0.01, "z": 0.0}})
    found = refine_base(data, start, [drag]).point.effects
    assert found["center_of_mass"]["y"] == pytest.approx(0.03 * DRONE.arm[1], rel=0.05)
    assert found["center_of_mass"]["x"] == pytest.approx(0.0, abs=1e-4)
    assert found["linear_drag"]["x"] == pytest.approx(0.02, abs=1e-3)


def test_a_trim_is_looked_for_only_if_asked_for() -> None:
    signals = frozenset({"position", "velocity", "attitude", "body_rate", "motor_command"})
    for wanted, there in (((), False), ((TRIM, "wind"), True)):
        found, _ = candidates_for(point_of(DRONE), signals, measured_speeds=False, wanted=wanted)
        assert any(c.effect == TRIM for c in found) is there


@pytest.mark.parametrize("white", [False, True])
def test_a_trim_is_assumed_where_commands_shake_and_hold_a_steady_torque(white: bool) -> None:
    flight = flight_of(fly(seconds=8.0), DRONE)
    rotor = flight.inputs
    rng = np.random.default_rng(1)
    if white:
        rotor = replace(rotor, thrust=0.08 + 0.01 * rng.standard_normal(rotor.thrust.shape))
    flights = [replace(flight, inputs=rotor)]
    share = fast_share(flights[0], DRONE)
    assert share == pytest.approx(0.5, abs=0.1) if white else share < 0.15
    assert with_zero_trim(flights, DRONE) is DRONE  # whatever shakes: nothing steady is held against
    twisted = rotor.thrust * np.array([1.1, 0.9, 1.1, 0.9])
    held_against = [replace(flight, inputs=replace(rotor, thrust=twisted))]
    assert mean_torque(held_against[0], DRONE)[2] == pytest.approx(-0.1 * DRONE.torque_per_thrust, rel=0.1)
    assumed = with_zero_trim(held_against, DRONE)
    assert (assumed.effects.get(TRIM) == {"x": 0.0, "y": 0.0, "z": 0.0}) is white
    assert with_zero_trim(flights, TRIMMED) is TRIMMED


@pytest.mark.parametrize("coarse", [False, True])
def test_without_torques_the_height_of_a_load_is_not_told(coarse: bool) -> None:
    data, point = Data([replace(flight_of(fly(seconds=8.0), DRONE), coarse=coarse)]), point_of(TRIMMED)
    candidates, _ = candidates_for(point, data.signals, measured_speeds=False)
    left, reasons = without_unobservable(data, point, candidates, {"gusts": "why not"})
    assert ("inertia" in reasons) is coarse
    load = [c for c in left if c.effect == "payload"]
    assert [c.free for c in load] == ([] if coarse else [("mass", "x", "y", "z")])
    assert reasons["gusts"] == "why not"


def test_the_firmware_on_a_pc_shakes_and_is_no_real_drone(shared_recordings) -> None:
    """Its motors are equal and upright, so its commands hold no steady torque."""
    name = "real_firmware/lee_34g_mass_pushed_midflight.csv.gz"
    vehicle = load_vehicle("cf2")
    flight = flight_of(open_recording(shared_recordings / name), vehicle)
    assert fast_share(flight, vehicle) > 0.3
    assert with_zero_trim([flight], vehicle) is vehicle


# -- symmetry ----------------------------------------------------------------------------------------------------------

# World and body turned or mirrored together: what polar vectors are multiplied by, and which rotor comes to which place
# (M1 front right, M2 rear right, M3 rear left, M4 front left; a mirror turns clockwise into counter-clockwise).
SYMMETRIES = {
    "half a turn": (np.array([-1.0, -1.0, 1.0]), (3, 4, 1, 2)),
    "left and right": (np.array([1.0, -1.0, 1.0]), (4, 3, 2, 1)),
}
ROTORS = ("motor_command", "motor_request")


def relabelled(recording: Recording, polar: NDArray, to: tuple[int, ...]) -> Recording:
    """The recording as the same flight of the drone with its rotors relabelled."""
    axial = np.prod(polar) * polar
    signals = dict(recording.signals)
    for name, array in signals.items():
        value = array.value
        if name in ROTORS:
            value = np.empty_like(array.value)
            value[:, np.array(to) - 1] = array.value
        elif name in ("position", "velocity", "acceleration"):
            value = array.value * polar
        elif name == "body_rate":
            value = array.value * axial
        elif name == "attitude":
            turn = Rotation.from_quat(array.value).as_matrix()
            value = Rotation.from_matrix(polar[:, None] * turn * polar).as_quat()
        elif name.endswith(".yaw"):
            value = array.value * axial[2]
        signals[name] = replace(array, value=value)
    return replace(recording, signals=signals)


def turned_file(vehicle: Vehicle, polar: NDArray) -> Vehicle:
    """The vehicle with the torques of its trim turned likewise."""
    axial = np.prod(polar) * polar
    trim = {n: float(v * s) for (n, v), s in zip(vehicle.effects[TRIM].items(), axial, strict=True)}
    return replace(vehicle, effects={**vehicle.effects, TRIM: trim})


def odds(recording: Recording, vehicle: Vehicle) -> NDArray:
    """(4,) nats by which the balance prefers a fault of each rotor to none."""
    data = data_of(recording, vehicle=vehicle)
    found = explanations([balance_of(data, nominal(data, replace(point_of(vehicle), noise=start_noise())))])
    return np.array([found["rotor", r][0] - found["", 0][0] for r in (1, 2, 3, 4)])


@pytest.mark.parametrize("name", SYMMETRIES)
def test_rotors_relabelled_by_symmetry_give_the_relabelled_odds(name: str) -> None:
    polar, to = SYMMETRIES[name]
    flown = fly(Hidden(thrust=(1.0, 1.0, 0.8, 1.0)), seconds=6.0, seed=3)
    vehicle = replace(DRONE, effects={TRIM: {"x": 1e-4, "y": -2e-4, "z": 3e-4}})
    one, other = odds(flown, vehicle), odds(relabelled(flown, polar, to), turned_file(vehicle, polar))
    assert np.argmax(one) == 2
    either = 2.0 * FITTING.min_round_gain  # nats; both fits may end so early
    np.testing.assert_allclose(other[np.array(to) - 1], one, atol=either)


@pytest.fixture
def flown_by(shared_recordings) -> Callable[..., Recording]:
    """The first seconds of 26 s of a flight of drone E8."""

    def begun(name: str, seconds: float = 26.0) -> Recording:
        whole = open_recording(shared_recordings / "crazypad" / name)
        return cut(whole, None, whole.signals["position"].time[0] + seconds)

    return begun


@pytest.fixture(scope="module")
def healthy(shared_recordings, made_once) -> Vehicle:
    """The file of drone E8 by a flight with whole propellers, as a user would make it: a preset and nothing named."""
    flight = shared_recordings / "crazypad" / "motor__normal_flight__E8_log00"

    def text() -> str:
        return diagnose([open_recording(flight)], load_vehicle("cf2-legacy")).fitted_vehicle.to_toml()

    return parse_vehicle(made_once("E8.toml", text))


@pytest.mark.slow
def test_a_cut_propeller_is_named_with_what_it_lacks_also_where_rotors_are_relabelled(flown_by, healthy) -> None:
    """Rotor 3 of a real drone has 3.5 mm less on each blade; the file is of a flight with whole propellers.

    Flights logged in different tables, one of them relabelled. Cuts of 1.5 mm are within days.
    """
    polar, to = SYMMETRIES["left and right"]
    motor, controller = (
        flown_by(f"{table}__cut_propeller_M3_3.5mm_3.5mm_40mm__E8_log00") for table in ("motor", "controller")
    )
    values = []
    for flown, vehicle, rotor in (
        (relabelled(motor, polar, to), turned_file(healthy, polar), to[2]),
        (controller, healthy, 3),
    ):
        effect = diagnose([flown], vehicle).effects[0]
        assert (effect.name, effect.chosen["rotor"]) == ("rotor_fault", rotor)
        assert effect.confidence > 0.8
        values.append(effect.parameters["scale"])
    assert values[0].value == pytest.approx(values[1].value, abs=0.06)  # the day, or the log
    assert all(0.7 < v.value < 0.9 and v.ci95[1] < 0.85 for v in values)


@pytest.mark.slow
def test_healthy_flights_tell_a_smaller_cut(flown_by) -> None:
    """2.5 mm, by three healthy flights of other days; the rotor that is cut, and about as much as others say."""
    flights = [flown_by(f"motor__normal_flight__E8_log0{i}", 17.0) for i in (0, 1, 3)]
    vehicle = with_baseline(load_vehicle("cf2-legacy"), flights)
    assert vehicle.days.flights == 3
    damaged = flown_by("motor__cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00", 17.0)
    effect = next(e for e in diagnose([damaged], vehicle).effects if e.name == "rotor_fault")
    assert effect.chosen["rotor"] == 3
    assert effect.parameters["scale"].value == pytest.approx(0.82, abs=0.05)


@pytest.mark.slow
def test_another_day_of_a_healthy_drone_is_no_finding(flown_by, healthy) -> None:
    """Torques of one rotor at random are at the limit of being told (11.5 nats, by the rounding of the machine)."""
    found = diagnose([flown_by("controller__normal_flight__E8_log00")], healthy)
    assert not found.effects
    assert all(f.signal == "torque" and f.nats < 15.0 for f in found.unexplained.findings)


@pytest.mark.slow
def test_tape_on_a_propeller_is_no_effect_of_the_catalogue(flown_by, healthy) -> None:
    """A tilt of 15 mrad in the second half, made from accelerations, may stay unexplained (28 nats; 25 are told)."""
    found = diagnose([flown_by("motor__tape_on_propeller_M3__E8_log00")], healthy)
    assert not found.effects
    assert all(f.signal == "attitude" for f in found.unexplained.findings)


@pytest.mark.slow
def test_a_weight_by_two_rotors_is_one_or_those_are_weak(flown_by, healthy) -> None:
    """Taped between rotors 3 and 4, on the left; in steady flight two weak rotors there do the same."""
    found = diagnose([flown_by("controller__add_weight_W1_near_M3_M4__E8_log00", 17.0)], healthy)
    load = found.effects[0]
    assert load.name == "payload"
    assert load.parameters["y"].value > 0.01
    assert load.confidence > 0.7
    assert any({"payload", "rotor_fault"} <= set(group) for group in found.indistinguishable)
