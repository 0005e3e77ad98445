"""A connected link, what comes from it, and the fault relay in a thread between a test's link and its drone.

Limits are for a link that is stuck.
"""

import contextlib
import threading
import time

from crazyem.links.crazyflie import CrazyflieLink
from crazyem.signals.sample import Packet
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


PATIENCE = 60.0  # s


def wait_for(link, kind):
    """The next item of that kind; what comes before it is dropped."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        item = link.packets.get(timeout=PATIENCE)
        if isinstance(item, kind):
            return item
    raise AssertionError(f"no {kind.__name__} came")


def packets(link, count):
    """So many log packets, however long they take."""
    return [wait_for(link, Packet) for _ in range(count)]


def take(link, seconds):
    """Everything that comes in a while: to let time pass, or to see that nothing comes."""
    items, deadline = [], time.monotonic() + seconds
    while time.monotonic() < deadline:
        if link.packets.empty():
            time.sleep(0.005)
        else:
            items.append(link.packets.get_nowait())
    return items
