"""A connected link, and the fault relay in a thread, between a test's link and its drone."""

import contextlib
import threading

from crazyem.links.crazyflie import CrazyflieLink
from firmware_sim.relay.faults import Engine, Fault
from firmware_sim.relay.relay import Relay, parse_target


@contextlib.contextmanager
def relayed(uri, *faults, seed=0):
    """A running relay in front of `uri`; its `uri` is where to connect, `engine.replace` changes its faults."""
    relay = Relay(parse_target(uri), Engine(faults, seed))
    thread = threading.Thread(target=relay.run, daemon=True)
    thread.start()
    try:
        yield relay
    finally:
        relay.stopping = True
        thread.join(60)
        assert not thread.is_alive()


@contextlib.contextmanager
def connected(uri, timeout=120.0):  # s; for machines that are busy
    """A link that is connected, and closed at the end."""
    link = CrazyflieLink(uri)
    link.connect(timeout)
    try:
        yield link
    finally:
        link.close()


def down(what, **options):
    """A fault on the way from the drone to the host."""
    return Fault(what, direction="down", **{**options, "kinds": frozenset(options.get("kinds", ()))})


def up(what, **options):
    """A fault on the way from the host to the drone."""
    return Fault(what, direction="up", **{**options, "kinds": frozenset(options.get("kinds", ()))})


def now_on(relay, *faults):
    """These faults from now on: their times count from here."""
    relay.engine.began = None
    relay.engine.replace(faults)
