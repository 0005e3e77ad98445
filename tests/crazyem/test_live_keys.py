"""Keys from a terminal: read without blocking, and the terminal as before after every way out."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import termios
import time

import pytest

from crazyem.live.dashboard import Keys


@pytest.fixture
def terminal():
    """Both ends of a pseudo terminal: where keys are pressed, where they are read."""
    master, slave = pty.openpty()
    yield master, slave
    for fd in (master, slave):
        with contextlib.suppress(OSError):
            os.close(fd)


def modes(fd):
    return termios.tcgetattr(fd)[3] & (termios.ICANON | termios.ECHO | termios.ISIG)


def test_keys_come_one_by_one_without_return_and_in_order(terminal):
    master, slave = terminal
    with Keys(slave) as keys:
        assert keys.reading
        assert keys.read(0.0) == ""
        for key in "pq":
            os.write(master, key.encode())
            assert keys.read(5.0) == key
        assert keys.read(0.0) == ""


def test_keys_pressed_at_once_are_not_lost_and_arrow_keys_are_no_letters(terminal):
    master, slave = terminal
    with Keys(slave) as keys:
        os.write(master, b"xrl\x1b[B")
        assert [keys.read(5.0) for _ in range(3)] == ["x", "r", "l"]
        assert keys.read(0.0) == ""
        os.write(master, b"\x1b[A")
        assert keys.read(5.0) == ""
        os.write(master, b"m")
        assert keys.read(5.0) == "m"


@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt, SystemExit])
def test_nothing_is_echoed_control_c_stays_a_signal_and_the_terminal_is_as_before(terminal, error):
    _, slave = terminal
    before = termios.tcgetattr(slave)

    def reads():
        with Keys(slave):
            assert modes(slave) == termios.ISIG
            if error:
                raise error

    with pytest.raises(error) if error else contextlib.nullcontext():
        reads()
    assert termios.tcgetattr(slave) == before


def test_ending_twice_or_without_beginning_does_nothing(terminal):
    _, slave = terminal
    before = termios.tcgetattr(slave)
    keys = Keys(slave)
    keys.end()
    keys.begin()
    keys.end()
    keys.end()
    assert not keys.reading
    assert keys.read(1.0) == ""
    assert termios.tcgetattr(slave) == before


NO_TERMINALS = {"a pipe": Keys, "a closed file": lambda pipe: Keys(-1), "nothing": lambda pipe: Keys()}


@pytest.mark.parametrize("source", NO_TERMINALS)
def test_what_is_no_terminal_gives_no_keys_and_does_not_wait(monkeypatch, source):
    monkeypatch.setattr(sys, "stdin", None)
    read, write = os.pipe()
    try:
        with NO_TERMINALS[source](read) as keys:
            assert not keys.reading
            assert keys.read(60.0) == ""
    finally:
        os.close(read)
        os.close(write)


def test_a_terminal_that_hangs_up_ends_the_keys_once(terminal):
    master, slave = terminal
    with Keys(slave) as keys:
        os.close(master)
        assert keys.read(5.0) == ""
        assert not keys.reading
        assert keys.read(60.0) == ""


# A shell without job control starts what is in its background with Ctrl-C ignored, and so the tests and their children.
CHILD = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from crazyem.live.dashboard import Keys
keys = Keys(0)
keys.begin()
print("ready", flush=True)
{end}
"""


@pytest.mark.parametrize("end", ["sys.exit(3)", "raise ValueError('a fault')", "time.sleep(60)"])
def test_the_terminal_is_as_before_when_the_process_has_ended(terminal, end):
    """Without `end`: atexit does it; the last one is ended by Ctrl-C."""
    _, slave = terminal
    before = termios.tcgetattr(slave)
    with subprocess.Popen(
        [sys.executable, "-c", CHILD.format(end=end)], stdin=slave, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as child:
        assert child.stdout.readline() == b"ready\n"
        if "sleep" in end:
            assert modes(slave) == termios.ISIG
            time.sleep(0.1)
            child.send_signal(signal.SIGINT)
        assert child.wait(120) != 0
    assert termios.tcgetattr(slave) == before
