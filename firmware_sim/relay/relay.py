"""The relay's sockets: one that hosts talk to, one towards the drone for each host, faults in between."""

import contextlib
import selectors
import socket
import time
from collections.abc import Callable

from firmware_sim.relay.faults import DOWN, UP, Engine
from firmware_sim.relay.kinds import RelayError
from firmware_sim.start import bind, udp_socket

Address = tuple[str, int]
MOST_HOSTS = 64  # beyond, the longest silent host is removed: every scan counts as a new host
_LONGEST_NAP = 0.05  # s between two looks at the schedule


def parse_target(text: str) -> Address:
    """Host and port of "udp://host:port" or "host:port". Raises RelayError."""
    host, _, port = text.removeprefix("udp://").rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise RelayError(f'"{text}" is no drone; it should look like udp://127.0.0.1:19850')
    try:
        return socket.gethostbyname(host), int(port)
    except OSError:
        raise RelayError(f'the host "{host}" is not known') from None


class Relay:
    """Hosts on one side, a drone on the other; every packet goes through the engine.

    Args:
        target: address of the drone.
        engine: applies the faults.
        host, port: where to listen; port 0 picks a free one.

    Raises: ServerError: the port cannot be listened on.
    """

    def __init__(self, target: Address, engine: Engine, *, host: str = "127.0.0.1", port: int = 0) -> None:
        self.target, self.engine = target, engine
        self.stopping = False
        self._selector = selectors.DefaultSelector()
        self._drones: dict[Address, socket.socket] = {}  # host -> the socket that speaks to the drone for it
        self._heard: dict[Address, float] = {}
        self.address: Address = (host, port)  # where hosts connect to
        self._listener: socket.socket | None = None
        self._place: socket.socket | None = None  # keeps the port while it refuses
        self._open()

    @property
    def uri(self) -> str:
        """The same as a URI."""
        return f"udp://{self.address[0]}:{self.address[1]}"

    def run(self, until: Callable[[], bool] | None = None) -> None:
        """Relay until `stopping` is set or `until()` is true; closes everything."""
        try:
            while not self.stopping and not (until is not None and until()):
                now = time.monotonic()
                dead = self.engine.dead(now)
                if dead and self._listener is not None:
                    self._refuse()
                elif not dead and self._listener is None:
                    self._open()
                due = self.engine.next_time()
                nap = _LONGEST_NAP if due is None else min(max(due - now, 0.0), _LONGEST_NAP)
                for key, _ in self._selector.select(nap):
                    self._receive(key.fileobj, key.data)  # type: ignore[arg-type]
                self._send()
        finally:
            self.close()

    def close(self) -> None:
        """Give back every socket; safe to call twice."""
        self._close_listener()
        self._give_place()
        for host in list(self._drones):
            self._forget(host)
        self._selector.close()

    def _open(self) -> None:
        self._give_place()
        self._listener = bind(*self.address)
        self.address = self._listener.getsockname()
        self._selector.register(self._listener, selectors.EVENT_READ, None)

    def _close_listener(self) -> None:
        if self._listener is not None:
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = None

    def _refuse(self) -> None:
        """Let hosts get "connection refused" while no other program can take the port.

        A connected UDP socket receives from its peer only. Connected to itself, the socket receives nothing.
        """
        self._close_listener()
        self._place = udp_socket()
        self._place.bind(self.address)
        self._place.connect(self.address)

    def _give_place(self) -> None:
        if self._place is not None:
            self._place.close()
            self._place = None

    def _receive(self, sock: socket.socket, host: Address | None) -> None:
        """Everything that has arrived at one socket; `host` is None for the listener."""
        for _ in range(256):
            try:
                datagram, sender = sock.recvfrom(2048)
            except BlockingIOError:
                return
            except OSError:  # an ICMP error of a peer that has gone
                return
            now = time.monotonic()
            if host is None:
                self._adopt(sender, now)
                self.engine.take(now, sender, UP, datagram)
            elif self._listener is not None:  # a dead drone sends nothing
                self.engine.take(now, host, DOWN, datagram)

    def _adopt(self, host: Address, now: float) -> None:
        self._heard[host] = now
        if host in self._drones:
            return
        if len(self._drones) >= MOST_HOSTS:
            self._forget(min(self._drones, key=self._heard.__getitem__))
        sock = udp_socket()
        sock.connect(self.target)
        self._drones[host] = sock
        self._selector.register(sock, selectors.EVENT_READ, host)

    def _forget(self, host: Address) -> None:
        sock = self._drones.pop(host)
        self.engine.forget(host)
        self._heard.pop(host, None)
        self._selector.unregister(sock)
        sock.close()

    def _send(self) -> None:
        for route, direction, datagram in self.engine.due(time.monotonic()):
            assert isinstance(route, tuple)
            drone = self._drones.get(route)
            if drone is None:
                continue
            with contextlib.suppress(OSError):  # no room or nobody there: lost, as over the air
                if direction == UP:
                    drone.send(datagram)
                elif self._listener is not None:
                    self._listener.sendto(datagram, route)
