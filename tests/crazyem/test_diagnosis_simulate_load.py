"""Open-loop predictions of a drone with a load on a string, which is where it was seen to pull before a start."""

from dataclasses import replace

import numpy as np
import pytest
from flown import DRONE, G, recording_of
from hanging_load import Array, hang, tilted

from crazyem.diagnosis.prediction.predict import Prediction, Recorded, predict, recorded
from crazyem.diagnosis.prediction.simulate import Simulator
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

LOAD, LENGTH = 0.004, 0.3
WEIGHT = (DRONE.mass + LOAD) * G
TIME = np.arange(0.0, 5.0, 0.01)
HANGING = replace(DRONE, effects={"suspended_load": {"mass": LOAD, "length": LENGTH}})


def level(angle: float) -> tuple[Recording, Array, Array]:
    """A level drone that carries itself, with a load that starts `angle` rad aside: recording, states, swing."""
    truth = hang(
        lambda t: np.array([0, 0, WEIGHT]), TIME, drone=DRONE.mass, load=LOAD, length=LENGTH, start=tilted(angle)
    )
    states = np.zeros((TIME.size, 13))
    states[:, :3], states[:, 3:6], states[:, 9] = truth.position, truth.velocity, 1.0
    speed = np.full((TIME.size, 4), np.sqrt(WEIGHT / 4 / 4e-8))
    return recording_of(TIME, states, rotor_speed=(TIME, speed)), states, truth.swing


def missed(found: Prediction, states: Array) -> Array:
    """(n, N, 13) of starts after 3 s."""
    late = found.start_time > 3.0
    truth = np.stack([states[i + 1 : i + 51] for i in found.start_index[late]])
    return found.prediction[late] - truth


def predicted(recording: Recording, vehicle: Vehicle) -> Prediction:
    return predict(recorded(recording, vehicle), horizon=50, plain=True)


def test_a_load_at_rest_below_a_hovering_drone_stays_there() -> None:
    recording, states, _ = level(0.0)
    assert np.abs(missed(predicted(recording, HANGING), states)).max() < 1e-9


def test_a_load_is_where_it_was_seen_to_pull() -> None:
    """It began to swing before anything was recorded: the path alone does not say where it is."""
    recording, states, _ = level(0.5)
    error = missed(predicted(recording, HANGING), states)
    assert np.abs(error[..., :3]).max() < 3e-3
    assert np.abs(error[..., 3:6]).max() < 0.015
    without = missed(predicted(recording, replace(DRONE, effects={"payload": {"mass": LOAD}})), states)
    assert np.abs(without[..., 3:6]).max() > 0.1


def swings(shown: Recorded, airborne: Array, state: Array | None = None) -> Array:
    found = Simulator(shown.inputs).swings(shown.time, shown.state if state is None else state, airborne)
    assert found is not None
    return found


def test_what_a_floor_does_to_a_drone_is_no_pull() -> None:
    """While it is not in the air the swing is as by a path that nobody watched."""
    shown = recorded(level(0.5)[0], HANGING)
    aground = shown.time < 2.0
    nothing = np.zeros(shown.time.size, bool)
    seen, unseen = swings(shown, ~nothing), swings(shown, nothing)
    late = swings(shown, ~aground)
    np.testing.assert_allclose(late[aground], unseen[aground], atol=1e-12)
    assert np.abs(seen[aground] - unseen[aground]).max() > 0.1
    assert np.abs(late - seen)[-50:].max() < 0.1  # once it flies, the load is found
    assert np.abs(unseen - seen)[-50:].max() > 0.2


@pytest.mark.parametrize("gone", [slice(100, 101), slice(100, 130)])
def test_after_rows_that_are_not_known_it_hangs_at_rest(gone: slice) -> None:
    shown = recorded(level(0.5)[0], HANGING)
    state = shown.state.copy()
    state[gone] = np.nan
    found = swings(shown, np.ones(shown.time.size, bool), state)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[gone.stop], [0, 0, -1, 0, 0, 0])
