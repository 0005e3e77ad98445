"""The server process over real sockets: who is the client, bursts, errors on the command line, a clean end."""

import collections
import contextlib
import csv
import io
import itertools
import signal
import socket
import struct
import time
import types
from unittest import mock

import pytest
from processes import TIMEOUT, running

from firmware_sim.__main__ import main
from firmware_sim.server import Server


@pytest.fixture(scope="module")
def port():
    with running("firmware_sim", "--port", "0") as (_, uri):
        yield int(uri.rpartition(":")[2])


@pytest.fixture
def connect(port):
    with contextlib.ExitStack() as stack:

        def new():
            sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            sock.settimeout(TIMEOUT)
            sock.connect(("127.0.0.1", port))
            return sock

        yield new


def receive(sock, header, count=1):
    """The next datagrams with that header byte."""
    out = []
    while len(out) < count:
        datagram = sock.recv(64)
        if datagram[0] == header:
            out.append(datagram)
    return out


def ask(sock, request):
    sock.send(request)
    return receive(sock, request[0])[0]


def silent(sock):
    """True when nothing is waiting on the socket (asked after another socket got an answer, so no race)."""
    sock.setblocking(False)
    try:
        return not sock.recv(64)
    except BlockingIOError:
        return True
    finally:
        sock.settimeout(TIMEOUT)


def start_log(sock):
    """One block with one variable, every 10 ms."""
    ask(sock, b"\x5d\x05")
    ask(sock, b"\x5d\x06\x01\x01\x00\x00")
    ask(sock, b"\x5d\x03\x01\x01")


def test_a_scan_is_answered_and_steals_nothing(connect):
    client, scanner = connect(), connect()
    start_log(client)
    scanner.send(b"\xff")
    assert scanner.recv(64) == b"\xff"
    for datagram in (b"\xf3", b"\xf4", b"\xff\x00", b"", bytes(40)):
        scanner.send(datagram)
    receive(client, 0x5E, 20)
    assert silent(scanner)
    client.send(b"\xff")  # the client may scan, too
    receive(client, 0xFF)


def test_the_newest_peer_with_a_packet_is_the_client(connect):
    first, second = connect(), connect()
    start_log(first)
    receive(first, 0x5E, 3)
    assert ask(second, b"\xdd\x00") == b"\xdd\x00\x0c\x00\x00\x00"
    receive(second, 0x5E, 3)  # its block goes on, to whoever is the client now
    assert ask(second, b"\x5d\x05")[:2] == b"\x5d\x05"
    while not silent(first):
        pass
    ask(second, b"\xdd\x00")
    assert silent(first)


def test_a_burst_is_answered_exactly_once_and_in_order(connect):
    client = connect()
    start_log(client)
    for n in range(2000):
        client.send(b"\xfc" + struct.pack("<Q", n))
    replies = receive(client, 0xFC, 2000)
    assert [struct.unpack("<Q", reply[1:])[0] for reply in replies] == list(range(2000))
    ask(client, b"\x5d\x05")


class BusySocket:
    """A socket with room for a number of datagrams."""

    def __init__(self):
        self.room, self.sent = 0, []

    def sendto(self, datagram, _address):
        if not self.room:
            raise BlockingIOError
        self.room -= 1
        self.sent.append(datagram)


def test_when_the_socket_is_full_log_packets_are_dropped_and_replies_wait():
    sock, flight = BusySocket(), types.SimpleNamespace(tick=0)
    firmware = types.SimpleNamespace(outbox=collections.deque(), flight=flight, advance=None)
    server = Server(firmware, sock)
    server.client = ("127.0.0.1", 1)
    firmware.outbox.extend([(b"reply 1", False), (b"log", True), (b"reply 2", False)])
    server._transmit()
    assert (sock.sent, server.dropped) == ([], 1)
    sock.room = 1
    firmware.outbox.append((b"reply 3", False))
    server._transmit()
    assert sock.sent == [b"reply 1"]
    sock.room = 9
    server._transmit()
    assert sock.sent == [b"reply 1", b"reply 2", b"reply 3"]


def run(*arguments):
    """The command in this process: exit code and what it says. It must end before it serves."""
    out, err = io.StringIO(), io.StringIO()
    serves = mock.patch("firmware_sim.__main__.Server.run", side_effect=AssertionError("it runs"))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), serves:
        try:
            code = main(arguments)
        except SystemExit as end:
            code = end.code
    return types.SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=err.getvalue())


def assert_one_sentence(result, *words):
    assert result.returncode != 0
    assert result.stdout == ""
    last = result.stderr.strip().splitlines()[-1]
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in last


def test_mistakes_get_one_sentence(port, tmp_path):
    scenario = tmp_path / "scenario.toml"
    scenario.write_text('[parameters]\n"ctrlLee.mas" = 0.03\n')
    assert_one_sentence(run("--port", "0", "--scenario", str(scenario)), "ctrlLee.mas")
    assert_one_sentence(run("--port", "0", "--scenario", str(tmp_path / "none.toml")), "none.toml")
    assert_one_sentence(run("--port", "0", "--truth", str(tmp_path / "no" / "truth.csv")), "truth.csv")
    assert_one_sentence(run("--port", str(port)), f"127.0.0.1:{port}", "in use")
    assert_one_sentence(run("--host", "203.0.113.7", "--port", "0"), "203.0.113.7")
    assert_one_sentence(run("--port", "70000"), "70000")
    assert_one_sentence(run("--port", "0", "--speed", "0"), "speed")
    assert_one_sentence(run("--port", "0", "--seed", "-1"), "seed")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly_with_the_truth_written(number, tmp_path):
    path = tmp_path / "truth.csv"
    with running("firmware_sim", "--port", "0", "--speed", "5", "--truth", str(path)) as (process, _):
        time.sleep(0.5)
        process.send_signal(number)
        assert process.wait(TIMEOUT) == 0
        assert process.stderr.read() == ""
    with path.open() as file:
        header, *rows = list(csv.reader(file))
    assert rows
    assert all(len(row) == len(header) for row in rows)
    times = [float(row[0]) for row in rows]
    steps = [b - a for a, b in itertools.pairwise(times)]
    assert all(step == pytest.approx(0.01, abs=1e-6) for step in steps[1:])
