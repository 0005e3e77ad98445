"""The check onboard_drag: parameters of the onboard filter, as recorded at connect or written in flight."""

from dataclasses import replace

import pytest
from doctor_checks import run
from made_flight import made_flight

from crazyem.recordings.finding import Grade
from crazyem.recordings.recording import Event, Recording


@pytest.fixture(scope="module")
def flown() -> Recording:
    return made_flight(seconds=6.0, seed=3)


def told(flown: Recording, **values: str) -> Recording:
    return replace(flown, metadata={"parameter_values": {f"kalman.{name}": text for name, text in values.items()}})


def test_a_drag_that_the_onboard_filter_was_told_of_is_said(flown):
    (finding,) = run("onboard_drag", told(flown, dragB_x="0.35", dragB_y="0.3", dragB_z="0.0", cop_z="0.01"))
    assert finding.grade is Grade.HARMLESS
    assert "kalman.dragB_x 0.35" in finding.text
    assert "kalman.cop_z 0.01" in finding.text
    assert finding.evidence == {"dragB_x_per_s": 0.35, "dragB_y_per_s": 0.3, "dragB_z_per_s": 0.0}


@pytest.mark.parametrize("values", [{}, {"dragB_x": "0.0"}, {"cop_x": "0.1"}, {"dragB_x": "nan"}, {"dragB_x": "?"}])
def test_without_a_drag_nothing_is_said(flown, values):
    assert run("onboard_drag", flown) == []
    assert run("onboard_drag", told(flown, **values)) == []


def test_a_drag_written_in_flight_counts_too(flown):
    write = Event(3.0, "parameter_write", {"name": "kalman.dragB_y", "value": 0.4})
    (finding,) = run("onboard_drag", replace(told(flown, dragB_y="0.0"), events=(write,)))
    assert finding.evidence["dragB_y_per_s"] == 0.4
