"""Whole flights under the guard's rules, against a drone of a few lines: written, taken back, kept, restored."""

from dataclasses import replace

import fake_drone as fake
import pytest
from fake_flight import FakeFlight

from crazyem.errors import CrazyemError
from crazyem.estimation.steps import LATEST_DECISION
from crazyem.live.policy import EndRules, HealthLimits, MonitorLimits, Policy, WriteRules
from crazyem.live.telemetry import CRASHED, FLYING, LOCKED, TUMBLED, Telemetry
from crazyem.live.write_gate import WriteGate
from crazyem.signals.sample import Sample

WRONG = {"mass": 0.045}  # believed with confidence, within every bound: what a stuck or biased sensor does


def trimmed():
    """A drone that believes its true mass and hovers where it should."""
    link = fake.FakeLink()
    link.values["ctrlLee.mass"] = 0.036
    return link


def complete(flown):
    """Every write to the controller is in the recording, in the history and, as a decision, in the account."""
    recorded = [(w.name, w.verified) for w in flown.recorder.all("parameter_write")]
    assert recorded == [(p.parameter, p.verified) for p in flown.history.pushes]
    told = [e for e in flown.recorder.all("event") if e.startswith("guard ")]
    return len(told) == len(flown.history.guard["decisions"])


def test_good_writes_are_judged_good_and_kept():
    flown = FakeFlight(fake.FakeLink()).fly()
    assert flown.error is None
    assert flown.link.values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.005)
    assert "judged good" in flown.actions()
    assert complete(flown)
    guard = flown.history.guard
    assert guard["mode"] == "push"
    assert guard["stopped"] == ""
    assert guard["at_connect"]["ctrlLee.mass"] == 0.029
    assert guard["in_drone"]["ctrlLee.mass"] == pytest.approx(0.036, rel=0.005)


def test_a_wrong_mass_is_taken_back_and_pushing_ends():
    flown = FakeFlight(trimmed(), fake.FakeEstimator(WRONG), duration=14.0).fly()
    assert flown.error is None
    assert max(p.value for p in flown.history.pushes if p.parameter == "ctrlLee.mass") > 0.0413
    assert flown.link.values["ctrlLee.mass"] == pytest.approx(0.036)
    assert flown.link.values["ctrlLee.KR_x"] == pytest.approx(0.007)
    assert "revert" in flown.actions()
    after = flown.history.guard["decisions"][flown.actions().index("revert") + 1 :]
    assert not [d for d in after if d["action"] == "write"]
    assert any("flew worse after" in n and "m before" in n for n in flown.history.notices)
    assert "flew worse" in flown.history.guard["stopped"]
    assert complete(flown)
    assert "taken back at" in flown.text()


def test_without_the_watch_it_stays():
    """The scenario above tests something: nothing else in the guard would have noticed."""
    rules = WriteRules(Policy(watch=MonitorLimits(enabled=False)))
    flown = FakeFlight(trimmed(), fake.FakeEstimator(WRONG), rules=rules, duration=14.0).fly()
    assert flown.link.values["ctrlLee.mass"] == pytest.approx(WRONG["mass"], rel=0.01)


def test_a_stalled_estimator_does_not_blind_the_watch():
    """It hangs right after its first wrong values were written."""
    link = trimmed()
    estimator = fake.FakeEstimator(WRONG)
    write = link.write_parameter

    def stall_after_mass(name, value, timeout=1.0):
        if name == "ctrlLee.mass" and value > 0.04:
            estimator.stall_at = 0
        return write(name, value, timeout)

    link.write_parameter = stall_after_mass
    flown = FakeFlight(link, estimator, duration=16.0).fly()
    assert estimator.stall_at == 0
    assert flown.link.values["ctrlLee.mass"] == pytest.approx(0.036)
    assert complete(flown)


def test_a_dry_run_decides_and_writes_nothing():
    flown = FakeFlight(fake.FakeLink(), rules=WriteRules(dry_run=True)).fly()
    assert flown.link.writes == 0
    assert flown.history.pushes == []
    would = [d for d in flown.history.guard["decisions"] if d["action"] == "would write"]
    assert dict(map(tuple, would[0]["writes"]))["ctrlLee.mass"] == pytest.approx(0.029 * 1.15)
    assert any(e.startswith("guard would write") for e in flown.recorder.all("event"))
    assert "dry run: nothing was written; would have ended with ctrlLee.mass" in flown.text()


@pytest.mark.parametrize("answer", [True, False])
def test_confirmation_is_asked_for_once(answer):
    questions = []

    def confirm(question, ended):
        questions.append(question)
        return answer

    flown = FakeFlight(fake.FakeLink(), rules=WriteRules(confirm=confirm)).fly()
    assert len(questions) == 1
    assert "ctrlLee.mass = 0.03335" in questions[0]
    assert bool(flown.link.writes) is answer
    assert ("confirmed" if answer else "declined") in flown.actions()
    if answer:
        assert flown.link.values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.005)


def test_a_question_nobody_answers_writes_nothing_and_holds_up_nothing():
    def confirm(question, ended):
        ended.wait(60.0)
        return True  # too late

    flown = FakeFlight(fake.FakeLink(), rules=WriteRules(confirm=confirm)).fly()
    assert flown.error is None
    assert flown.link.writes == 0


def test_an_empty_battery_is_left_alone():
    class Empty(fake.FakeLink):
        def value(self, name):
            return 3100.0 if name == "pm.vbatMV" else super().value(name)

    flown = FakeFlight(Empty()).fly()
    assert flown.link.writes == 0
    assert any("3.10 V, below 3.2 V" in d["reason"] for d in flown.history.guard["decisions"])


@pytest.mark.parametrize(("rule", "mass"), [("restore", 0.029), ("good", 0.036), ("keep", 0.036)])
def test_after_a_failure_the_policy_decides_what_stays(rule, mass):
    rules = WriteRules(Policy(end=EndRules(failed=rule)))
    flown = FakeFlight(fake.FakeLink(), fake.FakeEstimator(fail_at=1300), rules=rules, duration=60.0).fly()
    assert isinstance(flown.error, CrazyemError)
    assert not [p for p in flown.history.pushes if not p.verified]
    assert "judged good" in flown.actions()
    assert flown.link.values["ctrlLee.mass"] == pytest.approx(mass, rel=0.005)
    assert any("put back (failed: restore)" in n for n in flown.history.notices) is (rule == "restore")
    assert complete(flown)


def test_nothing_is_put_back_that_was_never_pushed():
    flown = FakeFlight(
        fake.FakeLink(), interrupt=(3000,), duration=60.0, rules=WriteRules(Policy(end=EndRules("restore", "restore")))
    ).fly()
    assert flown.link.writes == 0
    assert "restore" not in flown.actions()


# --- health ---------------------------------------------------------------------------------------------------------


def healthy(**limits):
    telemetry = Telemetry(info=FLYING)
    health = WriteGate(telemetry, replace(HealthLimits(), **limits))
    health.take(Sample("voltage", 0.0, (3.9,)))
    health.take(Sample("attitude", 0.0, (0.0, 0.0, 0.0, 1.0)))
    return health, telemetry


@pytest.mark.parametrize(
    ("info", "says"),
    [(None, "said nothing"), (0, "does not say that the drone flies"), (FLYING | TUMBLED, "tumbled"),
     (FLYING | LOCKED, "locked"), (FLYING | CRASHED, "crashed")],
)  # fmt: skip
def test_the_supervisor_has_a_say(info, says):
    health, telemetry = healthy()
    telemetry.info = info
    assert says in health.health_objection(age=0.0)
    health, telemetry = healthy(supervisor=False)
    telemetry.info = info
    assert health.health_objection(age=0.0) == ""


def test_the_battery_is_averaged_and_has_to_recover():
    health, _ = healthy()
    for i in range(1, 101):
        health.take(Sample("voltage", 0.1 * i, (2.9 if i == 50 else 3.3,)))
        assert health.health_objection(age=0.0) == ""  # a dip of a tenth of a second is none
    for i in range(101, 120):
        health.take(Sample("voltage", 0.1 * i, (3.1,)))
    assert "3.10 V" in health.health_objection(age=0.0)
    for i in range(120, 140):
        health.take(Sample("voltage", 0.1 * i, (3.22,)))
    assert "3.22 V" in health.health_objection(age=0.0)
    for i in range(140, 160):
        health.take(Sample("voltage", 0.1 * i, (3.3,)))
    assert health.health_objection(age=0.0) == ""
    unknown = WriteGate(Telemetry(info=FLYING), HealthLimits())
    assert "not known" in unknown.health_objection(age=0.0)
    assert WriteGate(Telemetry(info=FLYING), HealthLimits(battery=0.0)).health_objection(age=0.0) == ""


def test_old_estimates_and_leaning_drones():
    """An estimate from before a payload could be noticed is too old."""
    health, _ = healthy()
    for age, objection in ((0.1, ""), (LATEST_DECISION, ""), (LATEST_DECISION + 0.1, "1.1 s old"), (4.0, "4.0 s old")):
        said = health.health_objection(age=age)
        assert objection in said
        assert bool(said) is bool(objection)
    health.take(Sample("attitude", 0.0, (0.71, 0.0, 0.0, 0.71)))
    assert "leans 90 degrees" in health.health_objection(age=0.0)
