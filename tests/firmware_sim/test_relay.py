"""The fault relay with plain sockets: what is sent on one side against what arrives on the other, and its schedules."""

import json
import re
import signal
import socket
import time

import pytest
from fake_peer import FakePeer
from hypothesis import given
from hypothesis import strategies as st
from processes import running
from relayed import relayed

from firmware_sim.errors import FirmwareSimError
from firmware_sim.relay.__main__ import main
from firmware_sim.relay.faults import DOWN, UP, Engine, Fault
from firmware_sim.relay.kinds import KIND_NAMES, kind_of
from firmware_sim.relay.relay import Relay, parse_target
from firmware_sim.relay.schedule import load_schedule

LOG_DATA, WRITE, ECHO = b"\x5e\x01", b"\x2e\x01", b"\xfc\x00"


def through(faults, datagrams, *, direction=DOWN, seed=0, gap=0.01, began=True):
    """What comes out of an engine, packet by packet `gap` s apart: list of (time, datagram)."""
    engine, out = Engine(faults, seed), []
    if began:
        engine.began = 0.0
    for n, datagram in enumerate(datagrams):
        engine.take(n * gap, "host", direction, datagram)
        for step in range(max(1, round(gap / 0.001))):
            now = n * gap + 0.001 * step
            out += [(now, d) for _, _, d in engine.due(now)]
    for extra in range(1, 500):
        now = (len(datagrams) - 1) * gap + extra * 0.001
        out += [(now, d) for _, _, d in engine.due(now)]
    assert engine.next_time() is None
    return out, engine


def numbered(count, head=LOG_DATA):
    return [head + n.to_bytes(3, "little") for n in range(count)]


# --- the engine, against counting by hand ---------------------------------------------------------------------------


def test_without_faults_everything_passes_in_order():
    sent = numbered(100)
    out, engine = through([], sent)
    assert [d for _, d in out] == sent
    assert engine.counts.fates[DOWN] == {"received": 100, "forwarded": 100}


def test_the_kth_reply_alone_is_dropped():
    for k in range(5):
        sent = [LOG_DATA + b"x", *numbered(5, WRITE)]
        out, _ = through([Fault("drop", direction=DOWN, kinds=frozenset({"param.write"}), skip=k, count=1)], sent)
        assert [d for _, d in out] == [d for d in sent if d != sent[1 + k]]


@pytest.mark.parametrize(("rate", "burst"), [(0.1, 1.0), (0.3, 1.0), (0.2, 5.0), (0.5, 20.0)])
def test_share_and_burst_of_losses(rate, burst):
    sent = numbered(20_000)
    out, _ = through([Fault("drop", rate=rate, burst=burst)], sent, gap=0.0, seed=3)
    arrived = {d for _, d in out}
    lost = [d not in arrived for d in sent]
    runs = [len(run) for run in re.findall("1+", "".join("01"[x] for x in lost))]
    assert sum(lost) / len(sent) == pytest.approx(rate, rel=0.15 if burst > 1 else 0.06)
    expected = burst if burst > 1 else 1 / (1 - rate)
    assert sum(runs) / len(runs) == pytest.approx(expected, rel=0.1)


def test_duplicates_follow_their_packet():
    sent = numbered(3)
    out, _ = through([Fault("duplicate", copies=2)], sent)
    assert [d for _, d in out] == [d for d in sent for _ in range(3)]


def test_reordering_lets_the_next_ones_overtake():
    out, _ = through([Fault("reorder", skip=1, count=1, distance=2)], numbered(5))
    assert [d[2] for _, d in out] == [0, 2, 3, 1, 4]


def test_a_packet_held_back_goes_out_though_nothing_follows():
    out, _ = through([Fault("reorder", distance=50)], numbered(1))
    ((when, _),) = out
    assert when == pytest.approx(0.1, abs=0.002)


def test_delay_keeps_order_and_stays_in_its_bounds():
    fault = Fault("delay", ms=20.0, jitter_ms=50.0)
    close, _ = through([fault], numbered(200), seed=5)
    assert [d for _, d in close] == numbered(200)
    out, _ = through([fault], numbered(200), seed=5, gap=0.1)  # far apart, none waits for the one before
    waits = [when - 0.1 * int.from_bytes(d[2:], "little") for when, d in out]
    assert 0.0199 <= min(waits) < 0.025
    assert 0.065 < max(waits) <= 0.0711


def test_corruption_flips_so_many_bits():
    sent = numbered(200)
    out, _ = through([Fault("corrupt", bits=3)], sent)
    for before, (_, after) in zip(sent, out, strict=True):
        assert len(after) == len(before)
        assert sum((a ^ b).bit_count() for a, b in zip(before, after, strict=True)) == 3


def test_silence_is_one_way_and_has_its_time():
    fault = Fault("silence", direction=UP, start=0.2, end=0.5)
    up, _ = through([fault], numbered(100), direction=UP)
    down, _ = through([fault], numbered(100), direction=DOWN)
    assert [d[2] for _, d in up] == [n for n in range(100) if not 20 <= n < 50]
    assert len(down) == 100


def test_time_begins_with_the_first_packet():
    engine = Engine([Fault("silence", start=1.0), Fault("die", start=2.0, end=3.0)])
    assert not engine.dead(1e6)
    engine.take(500.0, "host", UP, WRITE)
    assert len(engine.due(500.0)) == 1
    assert [engine.dead(t) for t in (501.9, 502.0, 502.9, 503.0)] == [False, True, True, False]


def test_kinds_aim():
    out, engine = through([Fault("drop", kinds=frozenset({"log"}))], [LOG_DATA, WRITE, b"\x5d\x06", ECHO])
    assert [d for _, d in out] == [WRITE, ECHO]
    assert engine.counts.harmed[DOWN] == {"log.data": 1, "log.control": 1}


def test_another_fault_beside_it_changes_nothing_about_the_first():
    """Each fault has random numbers of its own, so experiments can be compared."""
    sent = numbered(500)
    drop = Fault("drop", rate=0.2)
    alone, _ = through([drop], sent, seed=9)
    beside, _ = through([drop, Fault("corrupt", rate=0.0)], sent, seed=9)
    assert alone == beside
    other, _ = through([drop], sent, seed=10)
    assert alone != other


FAULTS = st.builds(
    Fault,
    st.sampled_from(["drop", "duplicate", "reorder", "delay", "corrupt", "silence"]),
    rate=st.floats(0.0, 1.0),
    direction=st.sampled_from([UP, DOWN, "both"]),
    start=st.floats(0.0, 0.5), end=st.floats(0.6, 5.0), skip=st.integers(0, 5), count=st.integers(0, 20),
    ms=st.floats(0.0, 30.0), jitter_ms=st.floats(0.0, 30.0), distance=st.integers(1, 5), bits=st.integers(1, 8),
    copies=st.integers(1, 4),
)  # fmt: skip


@given(st.lists(FAULTS, max_size=4), st.integers(0, 2**31), st.lists(st.binary(min_size=1, max_size=40), max_size=60))
def test_every_packet_is_accounted_for(faults, seed, sent):
    out, engine = through(faults, sent, seed=seed)
    fates = engine.counts.fates[DOWN]
    assert fates["received"] == len(sent)
    assert fates["forwarded"] == len(out)
    gone = fates["dropped"] + fates["silenced"]
    # A packet duplicated and then dropped takes its copies along.
    assert len(sent) - gone <= len(out) <= len(sent) - gone + fates["duplicated"]
    again, _ = through(faults, sent, seed=seed)
    assert again == out
    assert {len(d) for _, d in out} <= {len(d) for d in sent}


@given(st.binary(max_size=40))
def test_any_datagram_has_a_kind(datagram):
    assert kind_of(datagram)


def test_kinds_are_told_by_port_and_channel():
    for (port, channel), name in KIND_NAMES.items():
        assert kind_of(bytes([port << 4 | 0x0C | channel, 1])) == name
    assert kind_of(b"\xff") == "link.null"
    assert kind_of(b"\x9f\x00") == "port9.3"
    assert kind_of(b"") == kind_of(bytes(40)) == "other"


# --- sockets --------------------------------------------------------------------------------------------------------


@pytest.fixture
def drone():
    """Answers every datagram with itself."""
    peer = FakePeer()
    peer._answer = lambda datagram: [datagram]
    yield peer
    peer.close()


def host(address):
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.settimeout(60.0)
    sock.connect(address)
    return sock


def test_packets_pass_both_ways_and_hosts_are_kept_apart(drone):
    with relayed(drone.uri) as relay, host(relay.address) as one, host(relay.address) as other:
        assert relay.address[0] == "127.0.0.1"
        for n in range(50):
            one.send(b"\x2e" + bytes([n]))
            other.send(b"\x2f" + bytes([n]))
            assert one.recv(64) == b"\x2e" + bytes([n])
            assert other.recv(64) == b"\x2f" + bytes([n])
        assert len(relay._drones) == 2


def test_a_dead_peer_refuses_and_comes_back(drone):
    with relayed(drone.uri, Fault("die", start=0.2, end=1.2)) as relay, host(relay.address) as sock:
        sock.settimeout(0.2)
        began = time.monotonic()
        refused, alive = 0, 0
        while alive < 5 and time.monotonic() - began < 60:
            try:
                sock.send(b"\x2e1")
                sock.recv(64)
                alive += bool(refused)
            except ConnectionRefusedError:
                refused += 1
                time.sleep(0.02)
            except TimeoutError:  # sent into the moment of closing
                pass
        assert refused
        assert alive == 5


def test_the_port_of_a_dead_peer_stays_its_own(drone):
    with relayed(drone.uri, Fault("die")) as relay, host(relay.address) as sock:

        def ask_until_refused(seconds=60.0):
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                sock.send(b"\x2e1")
                time.sleep(0.02)

        for _ in range(2):
            with pytest.raises(ConnectionRefusedError):
                ask_until_refused()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other, pytest.raises(OSError, match="in use"):
            other.bind(relay.address)


def test_many_scans_do_not_pile_up(drone):
    with relayed(drone.uri) as relay:
        for _ in range(100):
            with host(relay.address) as sock:
                sock.send(b"\xff")
                assert sock.recv(64) == b"\xff"
        assert len(relay._drones) <= 64


def test_a_port_in_use_is_one_sentence(drone):
    with pytest.raises(FirmwareSimError, match="cannot listen on udp"):
        Relay(("127.0.0.1", 1), Engine(), port=drone.socket.getsockname()[1])


@pytest.mark.parametrize(
    "text", ["", "udp://", "127.0.0.1", "udp://127.0.0.1:0", "x:99999", "udp://no.such.host.invalid:1"]
)
def test_targets_that_are_none(text):
    with pytest.raises(FirmwareSimError):
        parse_target(text)


# --- schedules and the command --------------------------------------------------------------------------------------


def test_a_schedule(tmp_path):
    path = tmp_path / "faults.toml"
    path.write_text(
        'seed = 7\n[[fault]]\nwhat = "drop"\nrate = 0.2\nburst = 3\nkinds = ["log.data", "param"]\n'
        'direction = "down"\nfrom = 2\nuntil = 3.5\n[[fault]]\nwhat = "die"\nfrom = 9\n'
    )
    faults, seed = load_schedule(path)
    assert seed == 7
    assert faults == [
        Fault("drop", rate=0.2, burst=3, kinds=frozenset({"log.data", "param"}), direction=DOWN, start=2, end=3.5),
        Fault("die", start=9),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[fault]]\nrate = 1\n", '"what" is missing'),
        ('[[fault]]\nwhat = "explode"\n', 'no fault "explode"'),
        ('[[fault]]\nwhat = "drop"\nrate = 2\n', "rate = 2 is not between"),
        ('[[fault]]\nwhat = "drop"\nrate = nan\n', "rate must be a number"),
        ('[[fault]]\nwhat = "drop"\nskip = 1.5\n', "skip must be a whole number"),
        ('[[fault]]\nwhat = "drop"\nkinds = ["logs"]\n', 'no kind of packet "logs"'),
        ('[[fault]]\nwhat = "drop"\nstart = 1\n', 'unknown key "start"'),
        ('[[fault]]\nwhat = "drop"\nfrom = 3\nuntil = 2\n', "ends at 2 s, before it starts"),
        ('[[fault]]\nwhat = "delay"\nburst = 2\n', "only drop comes in bursts"),
        ('[[fault]]\nwhat = "drop"\ndirection = "sideways"\n', "none of up, down, both"),
        ("fault = 1\n", "tables"),
        ("seed = -1\n", "seed must be"),
        ("speed = 1\n", 'unknown key "speed"'),
        ("= =", "no TOML file"),
    ],
)
def test_schedules_that_cannot_be_used(tmp_path, text, message):
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(FirmwareSimError, match=re.escape(message)) as caught:
        load_schedule(path)
    assert "faults.toml" in str(caught.value)


def test_a_schedule_that_is_not_there_or_no_text(tmp_path):
    with pytest.raises(FirmwareSimError, match="cannot read"):
        load_schedule(tmp_path / "none.toml")
    (tmp_path / "zeros.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(FirmwareSimError, match="no TOML file"):
        load_schedule(tmp_path / "zeros.toml")


def test_the_command_relays_and_counts(drone):
    options = ("--drop", "1", "--kinds", "log.data", "--seed", "4", "--json")
    with running("firmware_sim.relay", drone.uri, *options) as (process, uri):
        with host(parse_target(uri)) as sock:
            for datagram in (LOG_DATA, LOG_DATA, ECHO):
                sock.send(datagram)
            assert sock.recv(64) == ECHO
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    counts = json.loads(out)
    assert counts["seed"] == 4
    assert counts["up"]["received"] == 3
    assert counts["up"]["dropped"] == 2
    assert counts["up"]["forwarded"] == counts["down"]["forwarded"] == 1
    assert counts["harmed"] == {"up": {"log.data": 2}, "down": {}}


@pytest.mark.parametrize(
    "arguments", [["nonsense"], ["127.0.0.1:9", "--drop", "7"], ["127.0.0.1:9", "--kinds", "x", "--drop", "0.1"]]
)
def test_the_command_refuses_in_one_sentence(capsys, arguments):
    assert main(arguments) == 2
    errors = capsys.readouterr().err
    assert len(errors.strip().splitlines()) == 1
    assert errors.startswith("relay: ")
