"""Reconnection of a lost link without reading the tables again, because it is the same drone."""

import datetime
import threading
import time
from typing import Any

from crazyem.errors import LinkError
from crazyem.links.base import AnotherDroneError
from crazyem.links.blocks import LogBlocks
from crazyem.links.connection import close_driver, new_driver, shorten_socket_timeout
from crazyem.links.requests import RetryTransport

_TABLE_PORTS = (5, 2)  # ports: log, parameters
_INFO = b"\x03"
_ANSWER_WITHIN, _REPEAT_AFTER = 0.4, 0.1  # s
_FIRST_PAUSE, _LONGEST_PAUSE = 0.05, 0.8  # s between attempts
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
        pause, attempt, why = _FIRST_PAUSE, 0, "nothing answers"
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
