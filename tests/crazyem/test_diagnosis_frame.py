"""Pose frames that lie differently on the drone, and where the floor is under flights that do not show it."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from made_flight import changed, made_flight
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.document import document_of
from crazyem.diagnosis.flights.flight import Flight, flight_of
from crazyem.diagnosis.flights.frame import in_mean_frame, tilt_of
from crazyem.diagnosis.flights.recording_nuisances import nuisances_of_recordings, with_common_floor
from crazyem.recordings.recording import Recording

DRAG = Hidden(drag=(0.02, 0.015, 0.0))


def turned(recording: Recording, roll: float, pitch: float) -> Recording:
    """What a pose shows whose frame is turned in the body by (roll, pitch) [rad]: rolled by +a it shows roll + a."""
    pose = Rotation.from_quat(recording.signals["attitude"].value)
    return changed(recording, "attitude", value=(pose * Rotation.from_rotvec([roll, pitch, 0.0])).as_quat())


def flight(seed: int, roll: float = 0.0, pitch: float = 0.0, hidden: Hidden = DRAG) -> Flight:
    return flight_of(turned(fly(hidden, seed=seed, seconds=12.0), roll, pitch), DRONE)


def test_a_tilt_is_found_with_an_error_as_told() -> None:
    """Twelve flights with drag, which no file knows of: both angles of each, over what is said of their errors."""
    away = []
    for seed in range(12):
        truth = np.random.default_rng(seed).normal(scale=0.02, size=2)
        found = tilt_of(flight(seed, *truth))
        assert (found[1] < 4e-3).all()
        away.append((found[0] - truth) / found[1])
    assert 0.5 < float(np.sqrt(np.mean(np.square(away)))) < 1.6
    assert np.abs(away).max() < 4.0


def test_frames_that_lie_alike_are_left_alone() -> None:
    flights = [flight(seed, 0.02, -0.01) for seed in range(4)]
    fitted, apart = in_mean_frame(flights[:3], flights[3:])
    assert all(a is b for a, b in zip([*fitted, *apart], flights, strict=True))


def test_frames_are_turned_to_the_mean_of_those_fitted() -> None:
    truth = [(0.01, -0.01), (0.03, 0.01), (-0.01, 0.0), (0.06, 0.05)]
    flights = [flight(seed, *t) for seed, t in enumerate(truth)]
    fitted, apart = in_mean_frame(flights[:3], flights[3:])
    after = [found[0] for f in [*fitted, *apart] if (found := tilt_of(f)) is not None]
    assert np.ptp(after, axis=0) == pytest.approx(0.0, abs=2e-3)
    assert np.mean(after, axis=0) == pytest.approx([0.01, 0.0], abs=3e-3)  # of the first three: stays, to be named
    frame = apart[0].frame
    assert (frame.roll, frame.pitch) == pytest.approx((0.05, 0.05), abs=4e-3)
    assert np.array_equal(apart[0].y[:, :6], flights[3].y[:, :6])


def test_one_flight_or_a_filter_on_board_tells_nothing() -> None:
    alone = flight(0, 0.05, 0.0)
    assert in_mean_frame([alone], []) == ([alone], [])
    onboard = replace(alone, fused=True)
    assert tilt_of(onboard) is None
    still = replace(flight(1), signals=frozenset({"attitude", "velocity"}))
    assert tilt_of(still) is None


def test_a_drone_that_never_moves_is_upright() -> None:
    still = [flight(seed) for seed in range(2)]
    for f in still:
        f.y[:, :3], f.y[:, 6:10] = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)
    assert tilt_of(still[0]) == (pytest.approx([0.0, 0.0], abs=1e-9), pytest.approx([1e-5, 1e-5]))
    assert in_mean_frame(still, []) == (still, [])


@pytest.mark.slow
def test_a_diagnosis_tells_whose_frame_it_turned_and_names_no_tilt() -> None:
    """Flights of one healthy drone whose frames lie 30 mrad apart, about a mean of nothing."""
    flown = (turned(fly(seed=s, seconds=12.0), roll, 0.0) for s, roll in enumerate((0.015, -0.015, 0.03)))
    recordings = [replace(recording, path=f"{s}.csv") for s, recording in enumerate(flown)]
    found = diagnose(recordings[:2], DRONE, held_out=recordings[2:], wanted=["attitude_misalignment", "wind"])
    assert not found.mismatch
    document, _ = document_of(found, recordings[:2], recordings[2:])
    for own, roll in zip(document["of_recordings"], (0.015, -0.015, 0.03), strict=True):
        assert own["pose_frame"]["roll"] == pytest.approx(roll, abs=3e-3)
    assert [own["held_out"] for own in document["of_recordings"]] == [False, False, True]
    assert any("2.csv" in text and "tilted" in text for text in document["notices"])


# -- where the floor is ------------------------------------------------------------------------------------------------


FLOORS = (0.05, 0.056, 0.06)


def above(seed: int, ground: float, *, grounded: bool = True, above: float = 0.5) -> Flight:
    made = flight_of(fly(Hidden(), seed=seed, seconds=12.0), DRONE)
    y = made.y.copy()
    y[:, 2] += ground + above - y[:, 2].min()
    return replace(made, y=y, ground=ground if grounded else 0.0, grounded=grounded)


def test_a_recording_says_whether_it_shows_the_floor() -> None:
    whole = made_flight(seconds=12.0, seed=1)
    shown = flight_of(whole, DRONE)
    assert shown.grounded
    assert shown.ground == pytest.approx(whole.signals["position"].value[:50, 2].mean(), abs=1e-3)
    inside = {n: (a.time > 4.0) & (a.time < 9.0) for n, a in whole.signals.items()}
    cut = {
        n: replace(
            a, time=a.time[k], value=a.value[k], marked=a.marked[k], host_time=a.host_time[k], order=np.arange(k.sum())
        )
        for n, a in whole.signals.items() for k in (inside[n],)
    }  # fmt: skip
    assert not flight_of(replace(whole, signals=cut), DRONE).grounded


def test_a_flight_that_never_rests_stands_where_the_others_do() -> None:
    flights, unknown = [above(k, g) for k, g in enumerate(FLOORS)], above(3, 0.0, grounded=False)
    fitted, apart = with_common_floor(flights, [unknown])
    assert all(a is b for a, b in zip(fitted, flights, strict=True))
    assert apart[0].ground == pytest.approx(0.056)
    assert np.array_equal(apart[0].y, unknown.y)
    assert any("z = 0.056 m" in n for n in nuisances_of_recordings(fitted, apart)[-1].notices)
    (first, *_), _ = with_common_floor([unknown, *flights], [])
    assert first.ground == pytest.approx(0.056)


@pytest.mark.parametrize(
    "others", [(0.05,), (0.05, 0.3), (1.0, 1.01)], ids=["one alone", "floors that differ", "a floor above the above"]
)
def test_where_the_others_do_not_tell_it_stays(others: tuple[float, ...]) -> None:
    unknown = above(3, 0.0, grounded=False)
    _, apart = with_common_floor([above(k, g) for k, g in enumerate(others)], [unknown])
    assert apart[0] is unknown


def test_without_positions_there_is_no_floor() -> None:
    blind = above(3, 0.0, grounded=False)
    blind = replace(blind, y=np.where(np.arange(13) < 6, np.nan, blind.y))
    _, apart = with_common_floor([above(k, g) for k, g in enumerate(FLOORS)], [blind])
    assert apart[0] is blind
