"""The guard over the real link: a wrong mass pushed to the simulated firmware in flight is taken back.

The rest of the rules: test_live_write_supervisor.py, over a link that waits for the session.
"""

from dataclasses import replace

import pytest

from crazyem.control.trajectories import hover
from crazyem.estimation.online import OnlineEstimator
from crazyem.links import open_link
from crazyem.live.controllers import LEE
from crazyem.live.flight import Flight, FlightPlan
from crazyem.live.recorder import open_recorder
from crazyem.live.session import Session
from crazyem.live.warm_up import warm_up
from crazyem.live.write_supervisor import WriteRules
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle

pytestmark = pytest.mark.slow


class Biased:
    """The estimator as if a sensor lied: its mass times `factor`, everything else as it is."""

    def __init__(self, vehicle, factor):
        self.inner, self.factor = OnlineEstimator(vehicle), factor

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def _lie(self, estimate):
        if estimate is None:
            return None
        p = estimate["mass"]
        low, high = (self.factor * x for x in p.ci95)
        wrong = replace(p, value=self.factor * p.value, sd=self.factor * p.sd, ci95=(low, high))
        return replace(estimate, parameters={**estimate.parameters, "mass": wrong})

    def feed(self, sample):
        return self._lie(self.inner.feed(sample))

    def finish(self):
        return self._lie(self.inner.finish())


def fly(uri, path, factor=1.3):
    """12 s of hover with lies about the mass; session and link's last belief."""
    vehicle = load_vehicle("cf2")
    warm_up(vehicle)  # as every command does: an estimator that compiles in flight is late, and the guard waits for it
    link = open_link(uri)
    try:
        link.connect(30.0)
        recorder = open_recorder(str(path), configuration={}, vehicle=vehicle, link=link)
        session = Session(link, vehicle=vehicle, estimator=Biased(vehicle, factor), recorder=recorder)
        plan = FlightPlan(
            trajectory=lambda position, yaw: hover(position=position, yaw=yaw, duration=12.0),
            controller=LEE, rules=WriteRules(),
        )  # fmt: skip
        try:
            session.start()
            Flight(session, plan).fly()
        finally:
            session.close()
            recorder.close()
        return session, link.read_parameter("ctrlLee.mass")
    finally:
        link.close()


def test_a_lie_about_the_mass_is_taken_back_in_flight(tmp_path, simulator):
    session, mass = fly(simulator("--speed", "2").uri, tmp_path / "f.mcap")
    history = session.history
    pushed = [p.value for p in history.pushes if p.parameter == "ctrlLee.mass" and p.purpose == "push"]
    assert pushed, history.guard["decisions"]
    assert max(pushed) > 0.033  # it was believed
    assert mass == pytest.approx(0.029, rel=0.01)
    assert any("flew worse after" in n for n in history.notices)
    recording = open_recording(tmp_path / "f.mcap")
    written = [e.data for e in recording.events if e.kind == "parameter_write"]
    ours = [w for w in written if str(w["name"]).startswith("ctrlLee.")]
    assert len(ours) == len(history.pushes)
    lines = [str(e.data.get("message", "")) for e in recording.events if e.kind == "log"]
    for action in ("write", "revert"):
        assert any(line.startswith(f"guard {action} at") for line in lines)
    assert len([line for line in lines if line.startswith("guard ")]) == len(history.guard["decisions"])
