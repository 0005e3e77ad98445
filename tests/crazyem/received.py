"""What comes from a link: some packets, one of a kind, or all of a while. Limits are for a link that is stuck."""

import time

from crazyem.links.base import Packet

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
