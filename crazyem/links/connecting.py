"""Opening and closing a cflib link within bounded time: cflib waits for ever for any reply that is lost."""

import contextlib
import logging
import threading
import time
from typing import Any

from crazyem.errors import LinkError

SILENCE_LIMIT = 3.0  # s without a new answer before a connection attempt is given up
_LOG_DATA = (5, 2)
_CONSOLE_PORT = 0
_LINK_PORT = 15

# (port, channel) of a request -> what its reply would have been, for the error message
_STAGES: dict[tuple[int, int], str] = {
    (15, 1): "its name",
    (13, 1): "its protocol version",
    (5, 1): "the log reset",
    (5, 0): "the table of log variables",
    (4, 0): "the list of memories",
    (4, 1): "a memory read",
    (2, 0): "the table of parameters",
    (2, 3): "a parameter's properties",
    (2, 1): "a parameter's value",
}


def quiet_cflib() -> None:
    """Keep cflib's warnings off the terminal; a program that configures logging still gets them."""
    logger = logging.getLogger("cflib")
    if not any(isinstance(handler, logging.NullHandler) for handler in logger.handlers):
        logger.addHandler(logging.NullHandler())


def new_crazyflie(uri: str) -> Any:
    """A fresh cflib Crazyflie, drivers initialised once, without cache files."""
    quiet_cflib()
    import cflib.crtp
    from cflib.crazyflie import Crazyflie

    if not cflib.crtp.CLASSES or (uri.startswith("serial") and "SerialDriver" not in map(_name, cflib.crtp.CLASSES)):
        cflib.crtp.CLASSES.clear()
        cflib.crtp.init_drivers(enable_serial_driver=uri.startswith("serial"))
    crazyflie = Crazyflie(ro_cache=None, rw_cache=None)
    # cflib 0.1.34 joins its ping thread in whoever meets the link's end. If that is a sender, it holds the lock that
    # the ping thread waits for, and neither ever comes back; a ping thread that is only told to stop ends by itself.
    latency = crazyflie.link_statistics.latency
    latency.stop = latency._stop_event.set
    return crazyflie


def _name(driver: type) -> str:
    return driver.__name__


class _Progress:
    """Watches a connection attempt from cflib's callbacks; never raises in cflib's threads."""

    def __init__(self, crazyflie: Any) -> None:
        self._cf = crazyflie
        self.wake = threading.Event()
        self.done = False
        self.failure = ""
        self.answers = 0
        self.last_answer = time.monotonic()
        self.awaited = ""
        crazyflie.packet_sent.add_callback(self._sent)
        crazyflie.packet_received.add_callback(self._received)
        crazyflie.fully_connected.add_callback(self._connected)
        crazyflie.connection_failed.add_callback(self._failed)
        crazyflie.connection_lost.add_callback(self._failed)

    def detach(self) -> None:
        for caller, callback in (
            (self._cf.packet_sent, self._sent),
            (self._cf.packet_received, self._received),
            (self._cf.fully_connected, self._connected),
            (self._cf.connection_failed, self._failed),
            (self._cf.connection_lost, self._failed),
        ):
            with contextlib.suppress(ValueError):
                caller.remove_callback(callback)

    def _sent(self, packet: Any) -> None:
        stage = _STAGES.get((packet.port, packet.channel))
        if stage is not None:
            self.awaited = stage

    def _received(self, packet: Any) -> None:
        # Log data of a former session, console text and ping echoes say nothing about our requests.
        key = (packet.port, packet.channel)
        if key != _LOG_DATA and packet.port != _CONSOLE_PORT and key != (_LINK_PORT, 0):
            self.answers += 1
            self.last_answer = time.monotonic()

    def _connected(self, _uri: str) -> None:
        self.done = True
        self.wake.set()

    def _failed(self, _uri: str, message: str) -> None:
        self.failure = message or "unknown reason"
        self.wake.set()


def open_link(crazyflie: Any, uri: str, timeout: float) -> None:
    """Connect and wait until the tables and every parameter value are there.

    Raises: LinkError with one sentence that tells "nothing answers" from "a reply was lost". The link is closed then.
    """
    progress = _Progress(crazyflie)
    deadline = time.monotonic() + timeout
    try:
        crazyflie.open_link(uri)
        while not progress.wake.wait(0.05):
            _shorten_naps(crazyflie)
            now = time.monotonic()
            if now > deadline or now - progress.last_answer > min(SILENCE_LIMIT, timeout):
                raise LinkError(_why(progress, uri, timeout, late=now > deadline))
        if not progress.done:
            raise LinkError(_why_failed(progress, uri))
        _shorten_naps(crazyflie)
    except BaseException:
        shut(crazyflie)
        raise
    finally:
        progress.detach()


def _why(progress: _Progress, uri: str, timeout: float, *, late: bool) -> str:
    if progress.answers == 0:
        return f"Nothing answers at {uri}."
    if late and time.monotonic() - progress.last_answer < SILENCE_LIMIT:
        return f"The drone at {uri} was still being read after {timeout:g} s; allow it more time to connect."
    return (
        f"A reply was lost while connecting to {uri}: the drone answered {progress.answers} requests but not the one "
        f"for {progress.awaited or 'the next item'}; connect again."
    )


def _why_failed(progress: _Progress, uri: str) -> str:
    lines = [line.strip() for line in progress.failure.splitlines() if line.strip()]
    text = " ".join(lines[:2])
    if "refused" in text.lower():
        if progress.answers == 0:
            return f"Nothing answers at {uri} (connection refused)."
        return f"The drone at {uri} went away while connecting."
    reason = lines[0].removeprefix("Couldn't load link driver: ").rstrip(".") if lines else "unknown reason"
    return f"No connection to {uri}: {reason}."


def shut(crazyflie: Any, *, hand_back: bool = False, cut_motors: bool = False) -> None:
    """Close a cflib link in bounded time (about two seconds at most), without cflib's parting setpoint.

    `Crazyflie.close_link` always sends a zero roll-pitch-yaw-thrust setpoint. In the firmware any low-level setpoint
    locks out the high-level commander until it is told "notify stop", so the next client's take-off would silently do
    nothing; and a mere observer would cut the motors of a flying drone. The link is therefore taken out of the
    object before `close_link` sees it.

    Args:
        crazyflie: a cflib Crazyflie, connected or not.
        hand_back: send "notify stop", so that the next client's high-level commands work.
        cut_motors: send the zero setpoint first, as cflib does: a client that commanded must not leave motors on.
    """
    link = crazyflie.link
    if link is not None:
        with contextlib.suppress(Exception):
            if cut_motors:
                crazyflie.commander.send_setpoint(0, 0, 0, 0)
            if hand_back:
                crazyflie.commander.send_notify_setpoint_stop()
            _shorten_naps(crazyflie)
            crazyflie.link_statistics.latency.ping()  # its echo ends the receiver's present nap
    link = _take_link(crazyflie)  # sending may have failed and closed it
    if link is not None:
        _wake(crazyflie, link)
        with contextlib.suppress(Exception):
            link.close()
    with contextlib.suppress(Exception):
        crazyflie.close_link()


def _take_link(crazyflie: Any) -> Any:
    """Take the driver out of the object, not in the middle of a send: a sender would die holding cflib's lock."""
    lock: Any = getattr(crazyflie, "_send_lock", None)
    held = lock is not None and lock.acquire(timeout=0.5)
    try:
        link, crazyflie.link = crazyflie.link, None
    finally:
        if held:
            lock.release()
    return link


def _shorten_naps(crazyflie: Any) -> None:
    """Let cflib's udp receiver look every 0.1 s, not every second, whether it should stop: closing waits for it."""
    with contextlib.suppress(Exception):
        if crazyflie.link.socket.gettimeout() is not None:
            crazyflie.link.socket.settimeout(0.1)


def _wake(crazyflie: Any, link: Any) -> None:
    """Spare the second cflib's dispatcher would sleep through before it sees that it should stop."""
    with contextlib.suppress(Exception):
        crazyflie.incoming.stop()
        link.in_queue.put(None)
