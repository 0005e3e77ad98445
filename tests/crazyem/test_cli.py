"""The command line: options, exit codes, and one clear sentence for everything a user can get wrong."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest
from mavlink_pilot import free_port
from recording_files import fails

from crazyem.cli import main, parser
from crazyem.commands.output import compile_kernels
from crazyem.control.named_trajectories import trajectory_maker
from crazyem.errors import UsageError
from crazyem.live import runner
from crazyem.vehicle import load_vehicle


def test_help_is_quick_and_imports_nothing_heavy():
    script = (
        "import sys, crazyem.cli as c\n"
        "try: c.main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'numba', 'cflib', 'matplotlib', 'scipy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    words = ("fly", "replay", "watch", "info", "doctor", "import", "export", "recover", "layout")
    assert all(word in done.stdout for word in words)


def test_options_named_in_the_interface_exist():
    words = "fly --vehicle cf2 --controller lqg --trajectory waypoints f.csv --duration 5 --no-push --record a.mcap"
    given = parser().parse_args(f"{words} --scenario s.toml --seed 3 --speed 2 --json - --plot p.png".split())
    assert given.trajectory == ["waypoints", "f.csv"]
    assert given.no_push
    assert (given.window, given.every) == (800, 4)
    assert parser().parse_args(["fly", "udp://127.0.0.1:1", "--trajectory", "hover"]).uri == "udp://127.0.0.1:1"
    given = parser().parse_args(["replay", "f.mcap", "--vehicle", "cf2", "--window", "400", "--every", "2"])
    assert (given.window, given.every) == (400, 2)
    assert parser().parse_args(["watch", "udp://127.0.0.1:1"]).uri


@pytest.mark.parametrize("words", ["{uri} --trajectory hover", "--trajectory hover {uri}"])
def test_nothing_at_the_uri_which_may_follow_the_trajectory(capsys, words):
    uri = f"udp://127.0.0.1:{free_port()}"
    said = fails(capsys, "fly", *words.format(uri=uri).split(), code=4)
    assert "Nothing answers" in said
    assert uri in said


@pytest.mark.slow
def test_reply_lost_while_connecting(capsys, fake_peer):
    fake_peer.lose = lambda request: request[:2] == b"\x5c\x02" and request[2] == 1
    assert "reply was lost" in fails(capsys, "watch", fake_peer.uri, code=4)


def test_unknown_log_variable_is_named(capsys, fake_peer):
    assert "no log variable stateEstimateZ.vx" in fails(capsys, "watch", fake_peer.uri, code=2)


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["fly", "--vehicle", "nimbus"], "unknown vehicle 'nimbus'"),
        (["fly", "--trajectory", "loop"], "unknown trajectory 'loop'"),
        (["fly", "--trajectory", "waypoints"], "needs one FILE"),
        ([], "COMMAND"),
        (["fly", "--unheard-of"], "--unheard-of"),
        (["fly", "--duration", "0"], "--duration"),
        (["fly", "--duration", "nan"], "--duration"),
        (["fly", "--duration", "soon"], "'soon' is not a number between 1 and 3600 seconds"),
        (["watch", "udp://127.0.0.1:1", "--duration", "-1"], "--duration"),
        (["fly", "--window", "3"], "--window"),
        (["fly", "--window", "1000000000000"], "--window"),
        (["fly", "--every", "0"], "--every"),
        (["fly", "--every", "x"], "'x' is not a whole number"),
        (["fly", "--seed", "-1"], "--seed"),
        (["fly", "--json", "/proc/nothing.json"], "cannot write /proc/nothing.json"),
        (["fly", "--record", "."], "cannot write ."),
        (["fly", "--json", "no/such/folder/x.json"], "cannot write"),
        (["fly", "udp://127.0.0.1:1", "--seed", "1"], "leave out the URI"),
        (["fly", "carrier-pigeon://1"], "carrier-pigeon"),
        (["watch", "nonsense"], "nonsense"),
        (["replay", "none.mcap"], "none.mcap"),
        (["fly", "--rate", "1001"], "--rate"),
        (["fly", "--rate", "0"], "--rate"),
        (["fly", "--rate", "nan"], "--rate"),
        (["fly", "--reconnect", "-1"], "--reconnect"),
        (["links", "--ports", "0"], "--ports"),
        (["links", "--ports", "9", "--no-air", "--json", "no/such/folder/x.json"], "cannot write"),
        # what may write
        (["fly", "--push", "--no-push"], "--no-push"),
        (["fly", "--confirm", "--dry-run"], "--dry-run"),
        (["fly", "--policy", "nowhere.toml"], "nowhere.toml"),
        (["watch", "udp://127.0.0.1:1", "--push"], "MAVLink drones only"),
        (["watch", "mavlink:udpin:nowhere"], "needs a host and a port"),
        (["fly", "mavlink:udpin:127.0.0.1:14550"], "use crazyem watch"),
        # several drones
        (["fly", "--uri", "udp://h:1", "--uri", "udp://h:1"], "given twice"),
        (["fly", "--uri", "udp://h:1", "--swarm", "s.toml"], "not both"),
        (["fly", "--swarm", "no.toml"], "cannot read the swarm file no.toml"),
        (["fly", "--uri", "udp://h:1", "--seed", "3"], "built-in simulator"),
        (["fly", "--uri", "mavlink:udpin:h:1"], "ground station"),
        (["watch", "--uri", "udp://h:1", "--push"], "watched only"),
        (["watch"], "needs a URI"),
        (["fly", "--live"], "--live needs a terminal"),
        (["fly", "--uri", "udp://h:1", "--trajectory", "loop"], "unknown trajectory"),
    ],
)
def test_wrong_usage_is_one_sentence(capsys, argv, says):
    assert says in fails(capsys, *argv, code=2)


def test_a_vehicle_file_with_a_mistake_names_the_key(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('name = "x"\nmass = "heavy"\ninertia = [1e-5, 1e-5, 1e-5]\n')
    said = fails(capsys, "fly", "--vehicle", path, code=3)
    assert "mine.toml" in said
    assert "'mass'" in said


@pytest.mark.parametrize("content", [b"", b"hello\n", b"\x89MCAP0\r\n rubbish", b"\x00" * 500, b"a,b\n1,2\n"])
def test_a_file_that_is_no_recording(capsys, tmp_path, content):
    path = tmp_path / "notes.txt"
    path.write_bytes(content)
    assert "notes.txt" in fails(capsys, "replay", path, code=3)


def test_replay_of_a_real_recording(capsys, tmp_path, shared_recordings):
    out, flight = tmp_path / "r.json", shared_recordings / "nanobench" / "B3_figure8_medium_rep1.csv.gz"
    assert main(["replay", str(flight), "--vehicle", "cf2", "--to", "8", "--every", "40", "--json", str(out)]) == 0
    summary = json.loads(out.read_text())
    assert set(summary["estimates"]) >= {"mass", "Ixx", "Iyy", "Izz", "motor_time_constant"}
    assert {"value", "sd", "ci95", "unit", "identifiable", "reason"} <= set(summary["estimates"]["mass"])
    assert any("thrust scale" in n for n in summary["notices"])
    assert (tmp_path / "r.png").stat().st_size > 10_000
    assert "mass" in capsys.readouterr().out


def test_trajectory_maker_reads_the_waypoints_at_once(tmp_path):
    path = tmp_path / "w.csv"
    path.write_text("x,y,z\n1,0,1\n")
    assert trajectory_maker(["waypoints", str(path)], 5.0)((0, 0, 1), 0.0).duration > 2
    with pytest.raises(UsageError):
        trajectory_maker(["hover", "extra"], 5.0)


def test_whole_periods_are_told_in_one_line():
    from crazyem.control.named_trajectories import duration_note

    assert duration_note(["figure8"], 20.0) == (
        "figure8 flies whole periods and ends where it began: 22 s instead of 20 s"
    )
    assert duration_note(["figure8"], 22.0) == ""
    assert duration_note(["excite"], 20.0) == duration_note(["waypoints", "w.csv"], 20.0) == ""


def test_a_plot_is_written_only_beside_a_file_that_was_asked_for():
    from argparse import Namespace

    from crazyem.commands.output import plot_path

    assert plot_path(Namespace(plot=None), None, None) is None
    assert plot_path(Namespace(plot=None), None, "-") is None
    assert plot_path(Namespace(plot=None), "a/f.csv.gz", "b.json") == "a/f.png"
    assert plot_path(Namespace(plot="p.png"), None, "b.json") == "p.png"


# --- whether something was compiled is counted, not told by the clock: a slow start is no compilation ---


def test_a_start_from_the_disk_says_nothing_however_slow(monkeypatch, capsys) -> None:
    vehicle = load_vehicle("cf2")
    runner.warm_up(vehicle)
    clock = iter((0.0, 60.0))
    monkeypatch.setattr(runner, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    compile_kernels(vehicle)
    assert "compiled" not in "".join(capsys.readouterr())


def test_a_compilation_is_told(monkeypatch, capsys) -> None:
    counts = iter((0, 3))
    monkeypatch.setattr(runner, "compilations", lambda: next(counts))
    compile_kernels(load_vehicle("cf2"))
    assert "compiled the estimator in" in "".join(capsys.readouterr())


def test_rates_and_patience_by_default():
    fly = parser().parse_args(["fly"])
    watch = parser().parse_args(["watch", "udp://127.0.0.1:1"])
    assert (fly.rate, fly.reconnect) == (1000.0 / 11.0, 8.0)
    assert (watch.rate, watch.reconnect) == (1000.0 / 11.0, 30.0)
