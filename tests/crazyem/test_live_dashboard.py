"""The live view: what it shows of made snapshots, what keys do, and that it never takes a flight with it."""

import io
import itertools
import os
import pty
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fake_drone import FakeEstimator, FakeLink, until
from fake_flight import Recorder
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from crazyem.live import dashboard
from crazyem.live.dashboard import BARS, Dashboard, Keys, picture, sparkline
from crazyem.live.session import Session
from crazyem.live.views import LinkView, Observer, ParameterView, SessionControls, Snapshot
from crazyem.vehicle import load_vehicle

MASS = ParameterView("mass", "g", 36.02, 35.9, 36.14, True, "", (34.0, 35.0, 36.0))
IZZ = ParameterView("Izz", "10⁻⁶ kg m²", 41.0, 11.0, 71.0, False, "yaw is hardly moved", (40.0, 41.0))
DRONE = Snapshot(
    name="alpha", uri="udp://127.0.0.1:19850", phase="figure8", seconds=12.4, parameters=(MASS, IZZ), updates=300,
    converged=True, airborne=True,
    link=LinkView(rate=398.0, loss=0.012, lost=17, late=2, round_trip=0.004, delay=0.001, outages=1),
    guard="push", decision="mass: unchanged", pushes=((4.0, "ctrlLee.mass", 0.036, True, "push"),
                                                      (5.0, "ctrlLee.J_x", 2e-5, False, "undo")),
    writes=12, alarms=("the link is lost and being brought back", "an older notice"), voltage=3.21, height=1.02,
)  # fmt: skip


def shown(snapshots, *, width=150, height=60, **options):
    """The view as a terminal of that size has it, without colours."""
    console = Console(file=io.StringIO(), width=width, height=height, record=True, force_terminal=True)
    console.print(picture(snapshots, height=height, **options))
    return console.export_text()


def test_one_drone_shows_values_intervals_reasons_link_guard_writes_and_alarms():
    text = shown([DRONE])
    for expected in (
        "alpha  udp://127.0.0.1:19850", "figure8 12 s", "in the air", "height 1.02 m", "3.21 V",
        "300 updates, converged",
        "36.02", "± 0.12", "▁▅█", "41.00", "± 30.00", "yaw is hardly moved",
        "398 packets/s, lost 1.2 % (17 in all), late 2, echo 4 ms, delay 1 ms, 1 outages",
        "push: mass: unchanged", "writes 12", "ctrlLee.mass = 0.036", "ctrlLee.J_x = 2e-05 (undo)",
        "the link is lost and being brought back", "an older notice", dashboard.HELP,
    ):  # fmt: skip
        assert expected in text, expected
    assert text.index("ctrlLee.J_x") < text.index("ctrlLee.mass")  # newest first
    assert "next drone" not in text
    assert "no drone yet" in shown([])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"guard": ""}, "no guard: nothing is written"),
        ({"stopped": "flew worse"}, "stopped: flew worse"),
        ({"paused": True}, "switched off by you"),
        ({"decision": ""}, "waits for estimates"),
        ({"link": LinkView(gone=True)}, "link lost"),
        ({"link": LinkView()}, "- packets/s, lost - (0 in all)"),
        ({"parameters": ()}, "no estimate yet"), ({"skipped": 31}, "31 left out"), ({"behind": 2.5}, "2.5 s behind"),
        ({"ended": "landed on request"}, "landed on request"),
        ({"marks": 3}, "3 marks"), ({"height": float("nan")}, "height - m"),
    ],
)  # fmt: skip
def test_each_state_has_its_words(change, says):
    assert says in shown([replace(DRONE, **change)])


def test_many_drones_are_rows_and_the_selected_one_is_shown_in_full():
    many = [replace(DRONE, name=f"d{i}", alarms=(), uri=f"udp://h:{i}") for i in range(12)]
    many[3] = replace(many[3], alarms=("it has crashed",))
    many[4] = replace(many[4], ended="landed")
    many[5] = replace(many[5], paused=True)
    text = shown(many, selected=7, height=80, message="d7: landing.")
    rows = [line.split()[0] for line in text.splitlines() if line.startswith("d")]
    assert rows[:13] == ["drone", *(f"d{i}" for i in range(12))]
    assert "udp://h:7" in text
    assert "udp://h:6" not in text
    for expected in ("it has crashed", "landed", "push off", "d7: landing.", "next drone"):
        assert expected in text


def test_rows_that_do_not_fit_are_those_far_from_the_selected_one():
    many = [replace(DRONE, name=f"d{i}") for i in range(50)]
    text = shown(many, selected=49, height=30)
    assert "d49 " in text
    assert "d0 " not in text
    assert "d49 " in shown(many, selected=1000, height=30)  # a drone that has gone


@pytest.mark.parametrize("width", [30, 60, 80, 200])
def test_narrow_terminals_get_narrow_pictures(width):
    assert max(map(len, shown([DRONE, DRONE], width=width).splitlines())) <= width


def test_nothing_that_is_shown_steers_the_terminal_or_is_taken_for_markup():
    nasty = "[bold]\x1b[2J\x07\x9b[/nothing]"
    text = shown([replace(DRONE, name=nasty, alarms=(nasty,), decision=nasty, phase=nasty, ended=nasty)] * 2)
    assert "[bold]�[2J��[/nothing]" in text
    assert not set("\x1b\x07\x9b") & set(text)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=60))
def test_a_sparkline_shows_the_newest_values_in_their_order(values):
    line = sparkline(values, width=24)
    finite = [v for v in values if np.isfinite(v)][-24:]
    assert len(line) == len(finite)
    assert set(line) <= set(BARS)
    if finite and max(finite) - min(finite) > 1e-2 * max(map(abs, finite)) and max(map(abs, finite)) < 1e300:
        assert line[int(np.argmax(finite))] == BARS[-1]
        assert line[int(np.argmin(finite))] == BARS[0]
        levels = [BARS.index(c) for c in line]
        order = np.argsort(finite, kind="stable")
        assert all(levels[a] <= levels[b] for a, b in itertools.pairwise(order))


# the thread


class Recorded:
    """Controls that remember what was asked."""

    def __init__(self):
        self.asked = []

    def __getattr__(self, name):
        def confirm():
            self.asked.append(name)
            if name == "revert":
                raise RuntimeError("no")
            return f"did {name}"

        return confirm


@pytest.fixture
def keyboard():
    master, slave = pty.openpty()
    yield lambda text: os.write(master, text.encode()), slave
    os.close(master)
    os.close(slave)


def screen(file=None):
    return Console(file=file or io.StringIO(), width=120, height=50, force_terminal=True)


def test_keys_act_on_the_selected_drone_and_q_ends_the_view(keyboard):
    press, slave = keyboard
    drones = [Recorded(), Recorded()]
    many = [DRONE, replace(DRONE, name="beta")]
    console = screen()
    with Dashboard(lambda: many, lambda: drones, console=console, keys=Keys(slave)) as view:
        until(console.file.getvalue)
        for keys, drone, asked in (("p", 0, "toggle_push"), ("M", 0, "mark"), ("\tl", 1, "land")):
            for key in keys:
                press(key)
                time.sleep(0.02)
            until(lambda d=drone, a=asked: d < 2 and drones[d].asked[-1:] == [a])
        press("x")
        press("r")
        until(lambda: "that failed: RuntimeError" in view.message)
        assert view.showing
        press("q")
        until(lambda: not view.showing)
    assert view.failure == ""
    assert drones[0].asked == ["toggle_push", "mark"]
    assert drones[1].asked == ["land", "revert"]
    written = console.file.getvalue()
    assert written.count("\x1b[?1049h") == written.count("\x1b[?1049l") == 1  # the other screen: entered and left


def test_a_view_that_fails_ends_alone(keyboard):
    _, slave = keyboard

    def broken():
        raise ValueError("a fault of ours")

    with Dashboard(broken, console=screen(), keys=Keys(slave)) as view:
        until(lambda: not view.showing)
    assert "a fault of ours" in view.failure


def test_a_terminal_that_takes_nothing_holds_up_only_the_view():
    gate, freed = threading.Event(), []

    class Stuck(io.StringIO):
        def write(self, text):
            freed.append(gate.wait(60))
            return super().write(text)

    with Dashboard(lambda: [DRONE], console=screen(Stuck()), keys=Keys(-1)):
        gate.set()
    assert all(freed)  # by the flight that went on, not by patience


# from a session


@pytest.fixture
def session():
    link = FakeLink(speed=20.0)
    link.motors, link.wanted = True, (0.2, 0.1, 1.0)
    one = Session(link, vehicle=load_vehicle("cf2"), estimator=FakeEstimator())
    one.start()
    yield one
    one.close()
    link.close()


def test_snapshots_of_a_session_are_what_it_knows(session):
    observer = Observer(session, name="a", phase=lambda: ("hover", 2.0))
    first = observer.snapshot()
    assert (first.name, first.uri, first.phase, first.guard) == ("a", "fake://0", "hover", "")
    until(lambda: len(session.history.estimates) > 30)
    s = observer.snapshot()
    assert s.airborne
    assert s.parameters[0].label == "mass"
    assert s.parameters[0].value == pytest.approx(36.0)
    assert s.parameters[0].low < 36.0 < s.parameters[0].high
    assert 1 < len(s.parameters[0].trend) <= 24
    assert s.voltage == pytest.approx(3.9005)
    session.history.notice("look here")
    assert "look here" in observer.snapshot().alarms
    assert "36.00" in shown([s])


def test_marks_go_into_the_recording_and_the_summary(session):
    controls = SessionControls(session, name="a")
    until(lambda: session.clock.newest > 0)
    assert "no recording" in controls.mark()
    session.recorder = recorder = Recorder()
    assert "mark 2 at" in controls.mark()
    assert f"mark user_2 {session.history.marks['user_2']!r}" in recorder.all("event")
    assert Observer(session, name="a", phase=lambda: ("", 0.0)).snapshot().marks == 2
    session.recorder = None


def test_what_cannot_be_done_is_said(session):
    controls = SessionControls(session, name="a")
    assert "nothing is pushed" in controls.toggle_push()
    assert "nothing was written" in controls.revert()
    assert "somebody else" in controls.land()
    landed = []
    assert SessionControls(session, name="a", land=lambda: landed.append(1)).land() == "a: landing."
    assert landed == [1]


def pushing(session):
    session.link.values["stabilizer.controller"] = 5.0
    session.push_to_controller()
    session.pipeline.push_from = -1.0


def test_p_holds_writes_back_and_lets_them_go_again(session):
    controls = SessionControls(session, name="a")
    pushing(session)
    assert controls.toggle_push() == "a: pushing is off."

    def pushes_after_a_while():
        count = len(session.history.estimates)
        until(lambda: len(session.history.estimates) > count + 40)
        return len(session.history.pushes)

    held, begun = pushes_after_a_while(), len(session.history.pushes)
    assert held <= begun + 10  # what was being written is completed
    assert pushes_after_a_while() == held
    assert Observer(session, name="a", phase=lambda: ("", 0.0)).snapshot().paused
    assert controls.toggle_push() == "a: pushing is on."
    until(lambda: len(session.history.pushes) > held)


def test_r_puts_everything_back_and_ends_pushing(session):
    controls = SessionControls(session, name="a")
    original = dict(session.link.values)
    pushing(session)
    assert "nothing to take back" in controls.revert()
    until(lambda: session.link.values["ctrlLee.mass"] != original["ctrlLee.mass"])
    until(lambda: not session.pusher.busy)
    assert "taken back as asked" in controls.revert()
    until(lambda: not session.pusher.busy)
    written = {n: v for n, v in session.link.values.items() if n.startswith("ctrl")}
    assert written == pytest.approx({n: v for n, v in original.items() if n.startswith("ctrl")}, rel=1e-6)
    assert "already" in controls.revert()
    s = Observer(session, name="a", phase=lambda: ("", 0.0)).snapshot()
    assert s.pushes[-1][4] == "revert"
    assert "taken back as asked" in s.stopped
    reverts = [d for d in session.history.guard["decisions"] if d["action"] == "revert"]
    assert reverts[0]["reason"] == "asked for by the user"
