"""Independent simulated drones in one process: a port, a scenario, a place and a seed each.

Either `--swarm N` (the same scenario N times, on a grid), or a TOML file:

    [[drone]]
    name = "alpha"              # default: drone0, drone1, ...
    port = 19850                # default: 19850 and up
    scenario = "payload.toml"   # default: that of --scenario; relative to this file
    position = [0.0, 0.0, 0.0]  # m; default: the scenario's, else on a grid
    yaw = 0.0                   # rad; default: the scenario's
    seed = 1                    # default: --seed + number of the drone
"""

import contextlib
import heapq
import math
import re
import selectors
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_sim.errors import ScenarioError
from firmware_sim.firmware import Firmware, boot
from firmware_sim.server import Server
from firmware_sim.start import bind
from firmware_sim.vehicle_file import read_toml
from firmware_sim.wire import Air

if TYPE_CHECKING:
    from firmware_sim.scenario import Scenario

MOST_DRONES = 100  # drones
GRID_SPACING = 1.0  # m between drones on the grid
LONGEST_PAUSE = 20  # ms of firmware time between two turns of a drone that has nothing to send
_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")
_KEYS = ("name", "port", "scenario", "position", "yaw", "seed")


@dataclass(frozen=True)
class Drone:
    """One drone of a swarm. port 0: any free one; position: m, None: the scenario's; yaw: rad, None: the scenario's."""

    name: str
    port: int
    seed: int
    scenario: Path | None = None
    position: tuple[float, float, float] | None = None
    yaw: float | None = None

    def load(self) -> "Scenario":
        """The scenario with this drone's position and yaw. Raises ScenarioError."""
        from firmware_sim.scenario import load_scenario  # here: brings compiled code

        scenario = load_scenario(self.scenario)
        start = scenario.start
        if self.position is not None:
            start = replace(start, position=self.position)
        if self.yaw is not None:
            start = replace(start, yaw=self.yaw)
        return replace(scenario, start=start)


def grid(number: int, count: int) -> tuple[float, float, float]:
    """Place [m] of one of `count` drones on a square grid around the origin."""
    side = math.ceil(math.sqrt(count))
    row, column = divmod(number, side)
    middle = (side - 1) / 2
    return GRID_SPACING * (column - middle), GRID_SPACING * (row - middle), 0.0


def of_number(count: int, *, port: int, seed: int, scenario: Path | None = None) -> list[Drone]:
    """`count` equal drones on ports `port`, `port` + 1, ... (0: any free ones), with seeds `seed`, `seed` + 1, ...

    Raises: ScenarioError for an impossible number or port.
    """
    if not 1 <= count <= MOST_DRONES:
        raise ScenarioError(f"a swarm has 1 to {MOST_DRONES} drones, not {count}")
    if port + count - 1 > 65535:
        raise ScenarioError(f"{count} drones from port {port} on would need ports beyond 65535")
    return [
        Drone(f"drone{i}", port + i if port else 0, seed + i, scenario, grid(i, count) if count > 1 else None)
        for i in range(count)
    ]


def of_file(path: Path, *, port: int, seed: int, scenario: Path | None = None) -> list[Drone]:
    """The drones of a swarm file, with defaults as in `of_number`. Raises ScenarioError naming file and key."""
    table = read_toml(path)
    entries = table.pop("drone", None)
    if table:
        raise ScenarioError(f"{path}: {next(iter(table))} is not part of a swarm (only [[drone]] is)")
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries) or not entries:
        raise ScenarioError(f"{path}: a swarm needs at least one [[drone]]")
    if len(entries) > MOST_DRONES:
        raise ScenarioError(f"{path}: a swarm has at most {MOST_DRONES} drones, not {len(entries)}")
    drones = [
        _drone(entry, f"{path}: drone {i}", base, path.parent)
        for i, (entry, base) in enumerate(
            zip(entries, of_number(len(entries), port=port, seed=seed, scenario=scenario), strict=True)
        )
    ]
    for what in ("name", "port"):
        values = [getattr(d, what) for d in drones if getattr(d, what)]
        double = next((v for i, v in enumerate(values) if v in values[:i]), None)
        if double is not None:
            raise ScenarioError(f"{path}: two drones have the {what} {double}")
    return drones


def _drone(entry: dict[str, Any], where: str, base: Drone, folder: Path) -> Drone:
    unknown = next((key for key in entry if key not in _KEYS), None)
    if unknown is not None:
        raise ScenarioError(f"{where}: {unknown} is not a key of a drone (known: {', '.join(_KEYS)})")
    values: dict[str, Any] = {}
    if "name" in entry:
        if not isinstance(entry["name"], str) or not _NAME.fullmatch(entry["name"]):
            raise ScenarioError(f"{where}: name must be 1 to 40 letters, digits, - or _, not {entry['name']!r}")
        values["name"] = entry["name"]
    for key, most in (("port", 65535), ("seed", 2**31 - 1)):
        if key in entry:
            value = entry[key]
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
                raise ScenarioError(f"{where}: {key} must be a whole number between 0 and {most}, not {value!r}")
            values[key] = value
    if "scenario" in entry:
        if not isinstance(entry["scenario"], str):
            raise ScenarioError(f"{where}: scenario must be the path of a file, not {entry['scenario']!r}")
        values["scenario"] = folder / entry["scenario"]
    if "position" in entry:
        place = entry["position"]
        if not isinstance(place, list) or len(place) != 3:
            raise ScenarioError(f"{where}: position must be 3 numbers, not {place!r}")
        values["position"] = tuple(_metres(v, f"{where}: position", 30.0) for v in place)
    elif "scenario" in entry:
        values["position"] = None  # that of the scenario file; the grid is for drones that would share a place
    if "yaw" in entry:
        values["yaw"] = _metres(entry["yaw"], f"{where}: yaw", math.pi)
    return replace(base, **values)


def _metres(value: Any, where: str, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not -most <= value <= most:
        raise ScenarioError(f"{where} must be between {-most:.4g} and {most:.4g}, not {value!r}")
    return float(value)


class Swarm:
    """Servers of several drones in one thread: each has a turn when its drone has something to send or receive.

    Args:
        servers: with bound sockets; each has its own speed and noise.
    """

    def __init__(self, servers: Sequence[Server], sockets: Sequence[socket.socket]) -> None:
        self.servers, self._sockets = list(servers), list(sockets)
        self.stopping = False

    def run(self) -> None:
        """Serve until a signal handler sets `stopping`."""
        with selectors.DefaultSelector() as selector:
            for number, sock in enumerate(self._sockets):
                selector.register(sock, selectors.EVENT_READ, number)
                self.servers[number].begin()
            dues: list[tuple[float, int]] = [(0.0, n) for n in range(len(self.servers))]
            newest = [0.0] * len(self.servers)  # the valid entry of each drone in `dues`
            while not self.stopping:
                # First the drones that are due, then those with packets: a busy client must not delay the others.
                now = time.monotonic()
                turns = []
                while dues and dues[0][0] <= now:
                    due, number = heapq.heappop(dues)
                    if due == newest[number]:
                        turns.append(number)
                wait = 0.0 if turns else max(dues[0][0] - now, 0.0)
                turns += [key.data for key, _ in selector.select(wait) if key.data not in turns]
                for number in turns:
                    due = self._turn(number, selector)
                    newest[number] = due
                    heapq.heappush(dues, (due, number))

    def _turn(self, number: int, selector: selectors.BaseSelector) -> float:
        server = self.servers[number]
        before = server.wanted
        due = server.turn(lambda: _next(server.firmware))
        if server.wanted != before:
            selector.modify(self._sockets[number], server.wanted, number)
        return due


def _next(firmware: Firmware) -> int:
    """The tick of the next turn: of the next log packet, at most LONGEST_PAUSE away; other events need no turn."""
    tick = firmware.flight.tick
    due = firmware.log.next_due()
    return tick + LONGEST_PAUSE if due is None else min(max(due, tick + 1), tick + LONGEST_PAUSE)


def open_swarm(drones: Sequence[Drone], stack: contextlib.ExitStack, *, host: str, speed: float) -> Swarm:
    """Bind the sockets and boot the drones; `stack` closes the sockets. Raises ServerError, ScenarioError."""
    sockets = [stack.enter_context(contextlib.closing(bind(host, drone.port))) for drone in drones]
    servers = []
    for drone, sock in zip(drones, sockets, strict=True):
        scenario = drone.load()
        air = Air(scenario.link.loss, scenario.link.burst, drone.seed)
        servers.append(Server(boot(scenario, drone.seed), sock, speed=speed, air=air))
        address, port = sock.getsockname()
        print(
            f"firmware_sim: udp://{address}:{port} platform {scenario.platform} seed {drone.seed} name {drone.name}",
            flush=True,
        )
    return Swarm(servers, sockets)
