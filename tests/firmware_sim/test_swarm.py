"""A swarm of simulated drones: its file, its grid, independent flights, and every drone answering on its own port."""

import contextlib
import itertools
import math
import socket
import subprocess
import sys
import threading

import pytest

from firmware_sim import __main__ as command
from firmware_sim import swarm
from firmware_sim.errors import ScenarioError

ECHO = bytes([0xFC, 1, 2, 3])  # port 15, channel 0
NOTHING_SENT = 1 << 30


def drones(tmp_path, text, **options):
    path = tmp_path / "swarm.toml"
    path.write_text(text)
    return swarm.of_file(path, **{"port": 19850, "seed": 7, **options})


def test_a_number_gives_ports_seeds_and_places_in_a_row():
    many = swarm.of_number(5, port=20000, seed=3)
    assert [d.port for d in many] == [20000, 20001, 20002, 20003, 20004]
    assert [d.seed for d in many] == [3, 4, 5, 6, 7]
    assert len({d.name for d in many}) == 5
    assert [d.port for d in swarm.of_number(3, port=0, seed=0)] == [0, 0, 0]
    assert swarm.of_number(1, port=1, seed=0)[0].position is None  # one drone is where its scenario puts it


@pytest.mark.parametrize("count", [2, 5, 9, 20, 100])
def test_places_on_the_grid_are_apart_and_around_the_origin(count):
    places = [swarm.grid(i, count) for i in range(count)]
    assert min(math.dist(a, b) for a, b in itertools.combinations(places, 2)) == pytest.approx(swarm.GRID_SPACING)
    assert all(abs(v) <= 5.0 for place in places for v in place)
    if math.isqrt(count) ** 2 == count:
        assert [sum(axis) for axis in zip(*places)] == pytest.approx([0, 0, 0])


def test_a_file_says_what_differs(tmp_path):
    (tmp_path / "heavy.toml").write_text("[vehicle]\nmass = 0.04\n[start]\nposition = [3.0, 0.0, 0.0]\n")
    a, b, c = drones(
        tmp_path,
        '[[drone]]\nname = "alpha"\nport = 4000\nposition = [1, 2, 0.5]\nyaw = 0.5\n'
        '[[drone]]\nscenario = "heavy.toml"\nseed = 11\n[[drone]]\n',
    )
    assert (a.name, a.port, a.position, a.yaw, a.seed) == ("alpha", 4000, (1.0, 2.0, 0.5), 0.5, 7)
    assert (b.name, b.port, b.seed) == ("drone1", 19851, 11)
    heavy = b.load()
    assert (heavy.vehicle.mass, heavy.start.position) == (0.04, (3.0, 0.0, 0.0))
    assert c.load().start.position == swarm.grid(2, 3)
    assert a.load().start.yaw == 0.5


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "at least one"), ("drone = 3", "at least one"), ("drone = []", "at least one"),
        ("x = 1\n[[drone]]\n", "x is not part of a swarm"),
        ("[[drone]]\nspeed = 2", "drone 0: speed is not a key"),
        ('[[drone]]\nname = "../a"', "drone 0: name must be"),
        ("[[drone]]\nport = 70000", "drone 0: port must be a whole number"),
        ("[[drone]]\nport = true", "drone 0: port"),
        ("[[drone]]\nseed = -1", "drone 0: seed"),
        ("[[drone]]\nposition = [1, 2]", "drone 0: position must be 3 numbers"),
        ("[[drone]]\nposition = [1, 2, nan]", "drone 0: position must be between"),
        ("[[drone]]\nyaw = 7", "drone 0: yaw must be between"),
        ("[[drone]]\nscenario = 3", "drone 0: scenario"),
        ("[[drone]]\nport = 5000\n[[drone]]\nport = 5000", "two drones have the port 5000"),
        ('[[drone]]\nname = "a"\n[[drone]]\nname = "a"', "two drones have the name a"),
        ("[[drone]]\n" * 101, "at most 100"), ("[[drone", "not a TOML file"),
    ],
)  # fmt: skip
def test_wrong_files_are_named(tmp_path, text, says):
    with pytest.raises(ScenarioError, match=r"swarm\.toml") as caught:
        drones(tmp_path, text)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--swarm", "0"], "1 to 100 drones, not 0"),
        (["--swarm", "101"], "not 101"),
        (["--swarm", "no.toml"], "no.toml: cannot be read"),
        (["--swarm", "2", "--port", "65535"], "beyond 65535"),
        (["--swarm", "2", "--truth", "t.csv"], "leave it out"),
        (["--swarm", "2", "--seed", "-1"], "--seed"),
    ],
)
def test_wrong_arguments_are_one_sentence(capsys, arguments, says):
    assert command.main(arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@contextlib.contextmanager
def running(number):
    """A swarm that serves in a thread; yields it and its ports."""
    with contextlib.ExitStack() as stack:
        many = swarm.open_swarm(swarm.of_number(number, port=0, seed=1), stack, host="127.0.0.1", speed=1.0)
        thread = threading.Thread(target=many.run)
        thread.start()
        try:
            yield many, [s.getsockname()[1] for s in many._sockets]
        finally:
            many.stopping = True
            thread.join(60)
            assert not thread.is_alive()


def client(stack, port):
    sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    sock.settimeout(60.0)
    sock.connect(("127.0.0.1", port))
    return sock


def test_every_drone_answers_its_own_client_and_no_other():
    with running(3) as (many, ports), contextlib.ExitStack() as stack:
        clients = [client(stack, port) for port in ports]
        for round_ in range(5):
            for i, one in enumerate(clients):
                one.send(ECHO + bytes([i, round_]))
        for i, one in enumerate(clients):
            echoes = []
            while len(echoes) < 5:
                datagram = one.recv(64)
                if datagram[0] == ECHO[0]:
                    echoes.append(datagram)
            assert echoes == [ECHO + bytes([i, r]) for r in range(5)]
        assert len({server.client for server in many.servers}) == 3


def test_a_drone_with_nothing_to_send_gets_its_turn_all_the_same():
    class Log:
        due = None

        def next_due(self):
            return self.due

    class Firmware:
        class flight:  # noqa: N801
            tick = 100

        log = Log()

    assert swarm._next(Firmware) == 100 + swarm.LONGEST_PAUSE
    Firmware.log.due = 107
    assert swarm._next(Firmware) == 107
    Firmware.log.due = 90
    assert swarm._next(Firmware) == 101
    Firmware.log.due = NOTHING_SENT
    assert swarm._next(Firmware) == 100 + swarm.LONGEST_PAUSE


@pytest.mark.slow
def test_the_command_announces_all_and_ends_when_told():
    arguments = [sys.executable, "-m", "firmware_sim", "--swarm", "3", "--port", "0", "--seed", "5"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        lines = [process.stdout.readline() for _ in range(4)]
        assert [line.split()[5] for line in lines[:3]] == ["5", "6", "7"]
        assert lines[3] == "firmware_sim: 3 drones are ready\n"
        process.terminate()
        assert process.wait(120) == 0
        assert process.stderr.read() == ""
