"""Where a flight and a model part, in axes of the body and of the world; a heading that depends on place."""

import numpy as np
import pytest
from closed_loop import Hidden, fly
from diagnosis_parts import data_of, start_point
from made_flight import changed, without
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.fitting.fit import nominal
from crazyem.diagnosis.locating.heading import heading_by_place
from crazyem.diagnosis.locating.locate import Located, locate
from crazyem.recordings.recording import Recording


def located(hidden: Hidden, seed: int) -> Located:
    """Of the nominal model; the drone's yaw swings by 0.8 rad."""
    data = data_of(fly(hidden, seed=seed, seconds=6.0))
    return locate(data, nominal(data, start_point()))


def along_the_world(found: Located) -> dict[str, float]:
    return {f.axis: f.effect_size for f in found.findings if f.axis.startswith("world") and f.variable == ""}


@pytest.mark.parametrize(("axis", "breeze"), [("world x", (0.02, 0.0, 0.0)), ("world y", (0.0, -0.02, 0.0))])
def test_a_breeze_on_a_drone_that_turns_belongs_to_the_world(axis: str, breeze: tuple[float, float, float]) -> None:
    found = along_the_world(located(Hidden(breeze=breeze), seed=1))
    assert found[axis] == pytest.approx(sum(breeze), rel=0.1)


def test_nothing_and_a_weak_rotor_belong_to_no_axis_of_the_world() -> None:
    assert along_the_world(located(Hidden(), seed=2)) == {}
    weak = located(Hidden(thrust=(0.9, 1.0, 1.0, 1.0)), seed=3)
    strongest = max(weak.findings, key=lambda f: f.nats)
    assert not strongest.axis.startswith("world")


# -- a heading that depends on place -----------------------------------------------------------------------------------


def with_attitude(recording, attitude):
    return changed(recording, "attitude", value=attitude.as_quat())


def magnetic(recording: Recording, size: float) -> Recording:
    """Turned about the vertical by size * sin(2 pi x / 1.1 m)."""
    along = recording.signals["position"].value[:, 0]
    turn = Rotation.from_rotvec(np.outer(size * np.sin(2 * np.pi * along / 1.1), [0, 0, 1]))
    return with_attitude(recording, turn * Rotation.from_quat(recording.signals["attitude"].value))


@pytest.fixture(scope="module")
def flights() -> tuple[Recording, Recording]:
    return fly(seconds=16.0, seed=3), fly(seconds=16.0, seed=4)


def test_a_heading_that_goes_with_x_is_found_with_its_size(flights) -> None:
    one, other = (data_of(magnetic(f, 0.1)) for f in flights)
    found = heading_by_place(one, other)
    assert (found.signal, found.axis, found.regime) == ("attitude", "z", "x position")
    true = 0.1 * np.sin(2 * np.pi * flights[0].signals["position"].value[:, 0] / 1.1)
    assert found.effect_size == pytest.approx(true.std(), rel=0.35)
    assert heading_by_place(one, None) is not None


def hovering(recording, share=0.01):
    """As if it had gone no more than this share of its way."""
    return changed(recording, "position", value=share * recording.signals["position"].value + [0.1, 0.2, 1.0])


def test_it_is_found_on_a_flight_held_out_where_the_one_fitted_hovers(flights) -> None:
    calm, there = data_of(hovering(flights[0])), data_of(magnetic(flights[1], 0.1))
    found, same = heading_by_place(calm, there), heading_by_place(there, calm)
    assert found is not None
    assert found == same
    assert found.regime == "x position"
    assert heading_by_place(calm, data_of(flights[1])) is None


@pytest.mark.parametrize(("share", "heard"), [(0.2, False), (0.3, True)])  # 31 and 64 nats expected of 514
def test_a_flight_that_shows_little_of_it_does_not_speak_against_it(flights, share, heard) -> None:
    there, elsewhere = data_of(magnetic(flights[1], 0.1)), data_of(hovering(flights[0], share))
    assert (heading_by_place(there, elsewhere) is None) == heard


def test_what_is_not_so_on_the_other_flight_is_not_named(flights) -> None:
    assert heading_by_place(data_of(magnetic(flights[0], 0.1)), data_of(magnetic(flights[1], -0.1))) is None


def test_nothing_is_found_where_sensors_are_biased_tilted_scaled_or_late(flights) -> None:
    tilt = Rotation.from_euler("xyz", [0.05, -0.04, 0.1])
    for change in ("none", "tilt", "bias", "scale", "late"):
        wrong = []
        for flight in flights:
            f, rate = flight, flight.signals["body_rate"]
            if change == "tilt":
                f = with_attitude(f, Rotation.from_quat(f.signals["attitude"].value) * tilt)
            values = {"bias": rate.value + np.array([0.02, -0.03, 0.05]), "scale": 1.03 * rate.value,
                      "late": np.roll(rate.value, 1, axis=0)}.get(change)  # fmt: skip
            wrong.append(data_of(f if values is None else changed(f, "body_rate", value=values)))
        assert heading_by_place(*wrong) is None, change


def test_without_position_or_attitude_and_where_the_drone_does_not_move_nothing_is_said(flights):
    for name in ("position", "attitude"):
        assert heading_by_place(data_of(without(flights[0], name)), None) is None
    held = data_of(hovering(flights[0], share=0.0))
    assert heading_by_place(held, None) is None
    assert heading_by_place(held, held) is None
