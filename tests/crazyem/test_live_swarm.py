"""Several drones: whole commands, with made-up drones and with the simulator."""

import io
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_drone import FakeEstimator, FakeLink
from rich.console import Console

from crazyem.cli import main, parser
from crazyem.commands import flights
from crazyem.commands import swarm as command
from crazyem.errors import CrazyemError, DataError, LinkError, UsageError
from crazyem.live import flight, runner
from crazyem.live.flight import Flight, Interrupts
from crazyem.live.swarm import members_of
from crazyem.recordings import open_recording

REPOSITORY = Path(__file__).resolve().parents[2]


# whole commands
@pytest.fixture
def fake(monkeypatch, tmp_path):
    """`crazyem` with drones of a few lines at fake://0, fake://1, ...; yields the links by URI."""
    links = {}

    def open_link(uri):
        link = links[uri]
        if isinstance(link, Exception):
            raise link
        return link

    for i in range(4):
        link = FakeLink(speed=20.0)
        link.uri, link.wanted = f"fake://{i}", (float(i), 0.0, 0.0)
        links[link.uri] = link
    monkeypatch.setattr(runner, "open_link", open_link)
    monkeypatch.setattr(command, "compile_kernels", lambda vehicle: None)
    monkeypatch.setattr(command, "new_estimator", lambda vehicle, arguments, **_: FakeEstimator())
    monkeypatch.setattr(command, "Flight", flight_of)
    monkeypatch.chdir(tmp_path)
    return links


def flight_of(session, plan, **options):
    """A flight that its made-up drone waits for, however busy the machine is."""
    begun = Flight(session, plan, **options)
    session.link.follow(session, begun)
    return begun


def flown(*arguments):
    code = main(["fly", "--duration", "4", "--json", "out.json", *arguments])
    with open("out.json") as file:
        return code, json.load(file)


URIS = ["--uri", "fake://0", "--uri", "fake://1", "--uri", "fake://2"]


def test_drones_fly_side_by_side_with_a_recording_and_a_row_each(fake, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(flight, "REPORT_EVERY", 0.05)  # made-up drones fly for a second or less
    code, said = flown(*URIS, "--push", "--record", "f.mcap", "--duration", "6")
    assert code == 0
    assert [d["name"] for d in said["drones"]] == ["drone0", "drone1", "drone2"]
    for i, drone in enumerate(said["drones"]):
        assert drone["outcome"] == "landed"
        assert drone["uri"] == f"fake://{i}"
        assert drone["estimates"]["mass"]["value"] == pytest.approx(0.036)
        assert drone["log"] == f"f.drone{i}.mcap"
        recording = open_recording(tmp_path / drone["log"])
        assert recording.metadata["estimator"] == {"updates_left_out": str(drone["updates_left_out"])}
        assert recording.metadata["configuration"]["drone"] == f'"drone{i}"'
        assert any(p["parameter"] == "ctrlLee.mass" for p in drone["pushes"])
        assert fake[f"fake://{i}"].values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.01)
    captured = capsys.readouterr()
    assert captured.out.count("landed") == 3
    assert re.search(r"^drone1   \w+ +\d+\.\d s  mass", captured.err, re.MULTILINE)


def lost_in_flight(link):
    """Lose a made-up drone four seconds after its first setpoint: a busy machine may land it before a given time."""
    send = link.send_full_state

    def sent(*setpoint):
        link.lost_at = link.lost_at or link.fm + 4000
        send(*setpoint)

    link.send_full_state = sent


def test_what_happens_to_one_drone_does_not_stop_the_others(fake):
    lost_in_flight(fake["fake://0"])
    fake["fake://1"] = LinkError("nothing answers at fake://1")
    fake["fake://3"].controllers = (1,)
    code, said = flown(*URIS, "--uri", "fake://3", "--duration", "6")
    lost, absent, good, refused = said["drones"]
    assert code == 4
    assert "was lost" in lost["error"]
    assert lost["estimates"]["mass"]["value"] == pytest.approx(0.036)
    assert absent["error"] == "nothing answers at fake://1"
    assert "estimates" not in absent
    assert good["outcome"] == "landed"
    assert "error" not in good
    assert "does not have the controller" in refused["error"]
    assert "take_off" not in fake["fake://3"].calls


def two_drones(folder, offset):
    """The words for a swarm file of a and b."""
    drone = '[[drone]]\nname = "{}"\nuri = "fake://{}"\n'
    (folder / "s.toml").write_text(f"{drone.format('a', 0)}offset = {offset}\n{drone.format('b', 1)}")
    return ["--swarm", "s.toml"]


@pytest.mark.parametrize(
    ("offset", "place", "says"),
    [([0, 0, 0], 0.1, "a and b stand 0.10 m apart"), ([1, 0.1, 0], 1.0, "a and b begin 0.10 m apart")],
)
def test_drones_that_come_too_close_do_not_fly_at_all(fake, tmp_path, capsys, offset, place, says):
    fake["fake://1"].wanted = (place, 0.0, 0.0)
    assert main(["fly", *two_drones(tmp_path, offset)]) == 2
    assert says in capsys.readouterr().err
    assert not any("take_off" in fake[f"fake://{i}"].calls for i in range(2))


def test_an_offset_is_where_the_trajectory_is_flown(fake, tmp_path):
    code, said = flown(*two_drones(tmp_path, [0, 0.5, 0.25]), "--no-push")
    assert code == 0
    assert [d["offset"] for d in said["drones"]] == [[0.0, 0.5, 0.25], [0.0, 0.0, 0.0]]
    assert fake["fake://0"].wanted[:2] == pytest.approx((0.0, 0.5), abs=0.01)
    assert fake["fake://1"].wanted[:2] == pytest.approx((1.0, 0.0), abs=0.01)


def test_landing_by_key_never_cuts_and_control_c_after_it_does_not_either():
    ones = [Interrupts(), Interrupts()]
    everyone = flights.SwarmInterrupts(ones)
    for _ in range(3):
        ones[0].land()
    assert [o.count for o in ones] == [1, 0]
    everyone()
    assert [o.count for o in ones] == [1, 1]
    everyone()
    assert [o.count for o in ones] == [2, 2]


def test_drones_are_watched_together_and_commanded_never(fake):
    for i in range(3):
        link = fake[f"fake://{i}"]
        link.motors, link.wanted = True, (float(i), 0.0, 1.0)
    assert main(["watch", *URIS, "--duration", "3", "--json", "out.json"]) == 0
    with open("out.json") as file:
        said = json.load(file)
    assert [d["outcome"] for d in said["drones"]] == ["watched"] * 3
    assert all(not fake[f"fake://{i}"].calls for i in range(3))


def test_a_drone_that_never_flew_is_a_row_with_its_reason(fake, monkeypatch):
    class Nothing(FakeEstimator):
        def finish(self):
            raise DataError("nothing to estimate from")

    monkeypatch.setattr(command, "new_estimator", lambda vehicle, arguments, **_: Nothing())
    code, said = flown(*URIS, "--no-push")
    assert code == DataError.exit_code
    assert all("nothing to estimate from" in d["error"] for d in said["drones"])


def test_the_table_shows_what_is_not_known():
    mass = {"value": 0.03, "ci95": [0.02, math.inf], "identifiable": False}
    failed = {"name": "a", "outcome": "failed", "notices": ["why", "said"], "error": "said"}
    text = command.table([failed, {"name": "b", "outcome": "landed", "estimates": {"mass": mass}}])
    assert "30.00+->99?" in text
    assert "a: note: why" in text
    assert "note: said" not in text


# views
@pytest.mark.parametrize(
    ("given", "out", "err", "expected"),
    [
        ([], True, True, True), ([], False, True, False), ([], True, False, False), (["--no-live"], True, True, False),
        (["--live"], False, True, True), (["--confirm"], True, True, False),
    ],
)  # fmt: skip
def test_a_live_view_is_for_terminals(monkeypatch, given, out, err, expected):
    streams = {"stdout": SimpleNamespace(isatty=lambda: out), "stderr": SimpleNamespace(isatty=lambda: err)}
    monkeypatch.setattr(flights, "sys", SimpleNamespace(**streams))
    monkeypatch.setenv("TERM", "dumb")
    if given != ["--live"]:
        assert flights.wants_view(parser().parse_args(["fly", *given])) is False
    monkeypatch.setenv("TERM", "xterm")
    assert flights.wants_view(parser().parse_args(["fly", *given])) is expected


def test_the_view_takes_the_place_of_the_lines_and_leaves_the_summary(fake, monkeypatch, capsys):
    drawn = io.StringIO()
    monkeypatch.setattr(command, "wants_view", lambda arguments: True)
    monkeypatch.setattr(
        "crazyem.live.dashboard.terminal_console",
        lambda stream: Console(file=drawn, width=140, height=40, force_terminal=True),
    )
    code, said = flown(*URIS, "--no-push", "--duration", "12")
    assert code == 0
    picture = drawn.getvalue()
    assert picture.count("\x1b[?1049h") == picture.count("\x1b[?1049l") == 1
    assert "drone2" in picture
    assert "no guard: nothing is written" in picture
    captured = capsys.readouterr()
    assert "drone0   hover" not in captured.err  # no plain line while it shows
    assert captured.out.count("landed") == 3
    assert len(said["drones"]) == 3


def test_live_and_confirm_do_not_go_together(monkeypatch):
    monkeypatch.setattr(flights, "_terminal", lambda stream: True)
    monkeypatch.setenv("TERM", "xterm")
    with pytest.raises(UsageError, match="plain lines"):
        flights.wants_view(parser().parse_args(["fly", "--live", "--confirm"]))


def test_errors_of_one_drone_keep_their_exit_code():
    drone = command.Drone(members_of(["u"], vehicle="cf2", trajectory=["hover"])[0], None, [])
    drone.failed(LinkError("gone."))
    drone.failed(CrazyemError("and later."))
    assert drone.problem == {"error": "gone.", "exit_code": 4}


@pytest.mark.slow
def test_two_simulated_drones_of_one_process_are_flown_by_one_process(tmp_path, capsys):
    arguments = [sys.executable, "-m", "firmware_sim", "--swarm", "2", "--port", "0", "--seed", "3"]
    scenario = ["--scenario", str(REPOSITORY / "firmware_sim" / "scenarios" / "payload.toml")]
    with subprocess.Popen([*arguments, *scenario], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as simulator:
        try:
            uris = [simulator.stdout.readline().split()[1] for _ in range(2)]
            given = [word for uri in uris for word in ("--uri", uri)]
            out = tmp_path / "out.json"
            log = tmp_path / "f.mcap"
            assert main(["fly", *given, "--duration", "6", "--json", str(out), "--record", str(log)]) == 0
            drones = json.loads(out.read_text())["drones"]
        finally:
            simulator.terminate()
    assert capsys.readouterr().out.count("landed") == 2
    for drone in drones:
        assert drone["estimates"]["mass"]["value"] == pytest.approx(0.036, rel=0.03)
        # the recording has every sample: its replay estimates as much, whatever was left out in flight
        again = tmp_path / "again.json"
        assert main(["replay", drone["log"], "--json", str(again), "--plot", str(tmp_path / "p.png")]) == 0
        replayed = json.loads(again.read_text())["estimates"]["mass"]
        assert abs(replayed["value"] - drone["estimates"]["mass"]["value"]) < replayed["sd"]


@pytest.mark.slow
def test_the_benchmark_of_many_drones_runs(tmp_path):
    script = REPOSITORY / "benchmarks" / "swarm.py"
    out = tmp_path / "s.json"
    command_line = [sys.executable, str(script), "--drones", "2", "--seconds", "1", "--json", str(out)]
    done = subprocess.run(command_line, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text())["rows"]
    assert row["drones"] == 2
    assert row["updates_per_s_and_drone"] > 0
    assert "| 2 |" in done.stdout
