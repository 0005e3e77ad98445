"""Opening, closing and reopening a cflib link within bounded time: cflib itself waits for ever for a lost reply.

There are three levels. A request without an answer is sent again (`requests.py`). A connection attempt without progress
is given up and repeated after a pause. All attempts end at the caller's timeout.
"""

import contextlib
import datetime
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from crazyem.errors import LinkError
from crazyem.links.base import AnotherDroneError
from crazyem.links.blocks import LogBlocks
from crazyem.links.requests import RetryTransport

SILENCE_LIMIT = 3.0  # s without a new answer, after which a connection attempt is given up
CONNECT_ATTEMPTS = 3  # for a drone that answers some requests
_FIRST_PAUSE = 0.2  # s before the second attempt; doubled before the third
_LOG_DATA = (5, 2)
_CONSOLE_PORT = 0
_LINK_PORT = 15

# (port, channel) of a request -> content of its reply, for the error message
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
    """Hide cflib's warnings from the terminal; a program that configures logging still gets them."""
    logger = logging.getLogger("cflib")
    if not any(isinstance(handler, logging.NullHandler) for handler in logger.handlers):
        logger.addHandler(logging.NullHandler())


def new_crazyflie(uri: str) -> Any:
    """A new cflib Crazyflie without cache files; drivers are initialised once."""
    quiet_cflib()
    import cflib.crtp
    from cflib.crazyflie import Crazyflie

    drivers = [driver.__name__ for driver in cflib.crtp.CLASSES]
    if not drivers or (uri.startswith("serial") and "SerialDriver" not in drivers):
        cflib.crtp.CLASSES.clear()
        cflib.crtp.init_drivers(enable_serial_driver=uri.startswith("serial"))
    crazyflie = Crazyflie(ro_cache=None, rw_cache=None)
    # cflib 0.1.34 joins its ping thread in the thread that notices the end of the link. A sending thread would hold the
    # lock that the ping thread waits for: a deadlock. So the ping thread is stopped, not joined; it ends by itself.
    latency = crazyflie.link_statistics.latency
    latency.stop = latency._stop_event.set
    return crazyflie


def add_callbacks(*pairs: tuple[Any, Callable[..., None]]) -> Callable[[], None]:
    """Add a callback to each of cflib's callers; returns a function that removes them, if they are still there."""
    for caller, callback in pairs:
        caller.add_callback(callback)

    def remove() -> None:
        for caller, callback in pairs:
            with contextlib.suppress(ValueError):
                caller.remove_callback(callback)

    return remove


class _Progress:
    """Watches a connection attempt from cflib's callbacks; never raises in cflib's threads."""

    def __init__(self, crazyflie: Any) -> None:
        self.wake = threading.Event()
        self.done = False
        self.failure = ""
        self.answers = 0  # different ones
        self._seen: set[tuple[int, int, bytes]] = set()
        self.last_answer = time.monotonic()
        self.awaited = ""
        self.detach = add_callbacks(
            (crazyflie.packet_sent, self._sent),
            (crazyflie.packet_received, self._received),
            (crazyflie.fully_connected, self._connected),
            (crazyflie.connection_failed, self._failed),
            (crazyflie.connection_lost, self._failed),
        )

    def _sent(self, packet: Any) -> None:
        stage = _STAGES.get((packet.port, packet.channel))
        if stage is not None:
            self.awaited = stage

    def _received(self, packet: Any) -> None:
        # Log data of an earlier session, console text and ping echoes are no answers to our requests.
        key = (packet.port, packet.channel)
        if key == _LOG_DATA or packet.port == _CONSOLE_PORT or key == (_LINK_PORT, 0):
            return
        # A repeated answer is no progress: cflib could not use it and requests it again.
        answer = (*key, bytes(packet.data))
        if answer not in self._seen:
            self._seen.add(answer)
            self.answers += 1
            self.last_answer = time.monotonic()

    def _connected(self, _uri: str) -> None:
        self.done = True
        self.wake.set()

    def _failed(self, _uri: str, message: str) -> None:
        self.failure = message or "unknown reason"
        self.wake.set()


def connect(uri: str, timeout: float) -> Any:
    """A connected cflib Crazyflie with tables and all parameter values; `timeout` [s] is for all attempts together.

    Raises: LinkError: one sentence, which distinguishes "nothing answers" from "a reply was lost". Nothing stays open.
    """
    deadline = time.monotonic() + timeout
    pause = _FIRST_PAUSE
    earlier_error: LinkError | None = None  # of an attempt with some answers
    for attempt in range(CONNECT_ATTEMPTS):
        crazyflie = new_crazyflie(uri)
        progress = _Progress(crazyflie)
        try:
            _open(crazyflie, progress, uri, deadline, timeout)
            return crazyflie
        except LinkError as error:
            # The error of an attempt with answers says more than that of a later one without.
            earlier_error = error if progress.answers or earlier_error is None else earlier_error
            # No further attempt if nothing ever answered or the time is over.
            answered = progress.answers or earlier_error is not error
            if not answered or attempt == CONNECT_ATTEMPTS - 1 or time.monotonic() + pause >= deadline:
                raise earlier_error from None
        finally:
            progress.detach()
        time.sleep(pause)
        pause *= 2
    raise AssertionError


def _open(crazyflie: Any, progress: _Progress, uri: str, deadline: float, timeout: float) -> None:
    """One connection attempt. Raises LinkError; then the link is closed."""
    try:
        _begin(crazyflie, uri)
        while not progress.wake.wait(0.01):
            shorten_socket_timeout(crazyflie)
            now = time.monotonic()
            if now > deadline or now - progress.last_answer > min(SILENCE_LIMIT, timeout):
                raise LinkError(_why(progress, uri, timeout, late=now > deadline))
            link = crazyflie.link
            packet = link.due_retry() if isinstance(link, RetryTransport) else None
            if packet is not None:
                crazyflie.send_packet(packet)
        if not progress.done:
            raise LinkError(_why_failed(progress, uri))
        shorten_socket_timeout(crazyflie)
    except BaseException:
        shut(crazyflie)
        raise


def _begin(crazyflie: Any, uri: str) -> None:
    """Same as `Crazyflie.open_link` (cflib 0.1.34), but with a `RetryTransport` around the driver."""
    from cflib.crazyflie import State

    crazyflie.connection_requested.call(uri)
    crazyflie.state = State.INITIALIZED
    crazyflie.link_uri = uri
    try:
        crazyflie.link = new_driver(crazyflie, uri)
        if crazyflie.link is None:
            crazyflie.connection_failed.call(uri, f"no driver found or malformed URI: {uri}")
            return
        if not crazyflie.incoming.is_alive():
            crazyflie.incoming.start()
        crazyflie.packet_received.add_callback(crazyflie._check_for_initial_packet_cb)
        crazyflie._start_connection_setup()
    except Exception as error:  # a driver may raise anything: no dongle, no permission, no such host
        crazyflie.connection_failed.call(uri, str(error) or type(error).__name__)


def new_driver(crazyflie: Any, uri: str) -> Any:
    """A driver for the URI in a `RetryTransport`, None if there is none; may raise any error of the driver."""
    import cflib.crtp

    statistics = crazyflie.link_statistics.radio_link_statistics_callback
    driver = cflib.crtp.get_link_driver(uri, statistics, crazyflie._link_error_cb)
    return RetryTransport(driver) if driver else None


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
    """Close a cflib link in bounded time (about two seconds at most), without cflib's last setpoint.

    `Crazyflie.close_link` always sends a zero roll-pitch-yaw-thrust setpoint. Any low-level setpoint locks out the
    firmware's high-level commander until "notify stop". So the next client's take-off would do nothing, and an observer
    would cut the motors of a flying drone. Therefore the link is removed from the object before `close_link`.

    Args:
        crazyflie: a cflib Crazyflie, connected or not.
        hand_back: send "notify stop", so that the next client's high-level commands work.
        cut_motors: send the zero setpoint first, as cflib does: a client that sent commands must not leave motors on.
    """
    link = crazyflie.link
    if link is not None:
        with contextlib.suppress(Exception):
            if cut_motors:
                crazyflie.commander.send_setpoint(0, 0, 0, 0)
            if hand_back:
                crazyflie.commander.send_notify_setpoint_stop()
            shorten_socket_timeout(crazyflie)
            crazyflie.link_statistics.latency.ping()  # its echo wakes the receiver
    close_driver(crazyflie)  # sending may have failed and closed it
    with contextlib.suppress(Exception):
        crazyflie.close_link()


def close_driver(crazyflie: Any) -> None:
    """Remove the driver from the object, wake cflib's dispatcher, which otherwise notices a stop late, and close it."""
    link = _take_link(crazyflie)
    if link is None:
        return
    with contextlib.suppress(Exception):
        crazyflie.incoming.stop()
        link.in_queue.put(None)
    with contextlib.suppress(Exception):
        link.close()


def _take_link(crazyflie: Any) -> Any:
    """Remove the driver from the object, but not during a send: the sender would end with cflib's lock held."""
    lock: Any = getattr(crazyflie, "_send_lock", None)
    held = lock is not None and lock.acquire(timeout=0.5)
    try:
        link, crazyflie.link = crazyflie.link, None
    finally:
        if held:
            lock.release()
    return link


def shorten_socket_timeout(crazyflie: Any) -> None:
    """Let cflib's UDP receiver check for a stop every 0.1 s, not every second, because closing waits for it."""
    with contextlib.suppress(Exception):
        if crazyflie.link.socket.gettimeout() is not None:
            crazyflie.link.socket.settimeout(0.1)


_TABLE_PORTS = (5, 2)  # ports: log, parameters
_INFO = b"\x03"
_ANSWER_WITHIN, _REPEAT_AFTER = 0.4, 0.1  # s
_SHORTEST_PAUSE, _LONGEST_PAUSE = 0.05, 0.8  # s between attempts
_SAME_DRIVER_ATTEMPTS = 2  # attempts with the present driver, before a new one is made


class Reconnector:
    """Keeps the data for a reconnection to the same drone.

    Args:
        crazyflie: connected through `connection.connect`.
        uri: address of the drone.
    """

    def __init__(self, crazyflie: Any, uri: str) -> None:
        self._cf, self._uri = crazyflie, uri
        # cflib forgets these when a driver reports an error
        self._table, self._values = crazyflie.param.toc, crazyflie.param.values
        self._described = dict(crazyflie.link.tables) if isinstance(crazyflie.link, RetryTransport) else {}

    def reconnect(self, blocks: LogBlocks, timeout: float, abort: threading.Event) -> int:
        """Reconnect until log data arrive again (held by `blocks`); returns the number of blocks created again.

        Raises: LinkError: not within `timeout` [s], or `abort` was set. AnotherDroneError: impossible.
        """
        deadline = time.monotonic() + timeout
        pause, attempt, why = _SHORTEST_PAUSE, 0, "nothing answers"
        while not abort.is_set():
            try:
                return self._attempt(blocks, deadline, another=attempt >= _SAME_DRIVER_ATTEMPTS)
            except AnotherDroneError:
                raise
            except LinkError as error:
                why = str(error).rstrip(".")
            if time.monotonic() + pause >= deadline:
                break
            abort.wait(pause)
            pause, attempt = min(2 * pause, _LONGEST_PAUSE), attempt + 1
        raise LinkError(f"The drone at {self._uri} did not come back within {timeout:g} s: {why}.")

    def _attempt(self, blocks: LogBlocks, deadline: float, *, another: bool) -> int:
        if self._cf.link is None or another:
            self._another_driver()
        self._check_tables(blocks)
        blocks.hold()  # packets from before these answers may be those of the drone before a restart
        created = blocks.resume(deadline)
        if blocks.reset_since():
            raise AnotherDroneError(f"The drone at {self._uri} was restarted: what it knew of the flight is gone.")
        if self._cf.link is None:
            raise LinkError("the link was lost again")
        self._restore()
        return created

    def _another_driver(self) -> None:
        """Make a new driver and a new reading thread: the old thread may sleep for a second, or have ended."""
        cf = self._cf
        from cflib.crazyflie import State

        callbacks = list(cf.incoming.cb)
        close_driver(cf)
        cf.incoming.stop()
        cf.incoming = type(cf.incoming)(cf)
        cf.incoming.cb = callbacks
        cf.state = State.DISCONNECTED
        try:
            cf.link = new_driver(cf, self._uri)
        except Exception as error:  # a driver may raise any error: the dongle may be unplugged
            raise LinkError(str(error) or type(error).__name__) from None
        shorten_socket_timeout(cf)
        cf.incoming.start()

    def _check_tables(self, blocks: LogBlocks) -> None:
        for port in _TABLE_PORTS:
            reply = blocks.requests.request(port, 0, _INFO, timeout=_ANSWER_WITHIN, repeat_after=_REPEAT_AFTER)
            if reply is None:
                raise LinkError("nothing answers")
            if reply != self._described.get(port, reply):
                raise AnotherDroneError(f"Another firmware answers at {self._uri} now: its tables differ.")

    def _restore(self) -> None:
        """Restore the data that cflib drops when a driver reports an error."""
        from cflib.crazyflie import State

        cf = self._cf
        cf.param.toc, cf.param.values = self._table, self._values
        cf.state = State.SETUP_FINISHED
        cf.connected_ts = cf.connected_ts or datetime.datetime.now()
        cf.link_statistics.start()
