"""A link to a Crazyflie over unmodified cflib, with time limits, counts of losses, and one report of a lost drone."""

import math
import queue
import statistics
import struct
import threading
import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import AnotherDroneError, LinkLost, LinkStatistics, Outage, ParameterWrite
from crazyem.links.blocks import LogBlocks
from crazyem.links.clock import ClockFit
from crazyem.links.connection import Reconnector, add_callbacks, connect, quiet_cflib, shut
from crazyem.links.parameters import ParameterClient
from crazyem.links.requests import land_command, send_until_confirmed
from crazyem.signals.sample import Block, Packet

SILENT_AFTER = 2.0  # s without log data from running blocks, after which the drone counts as lost
_ECHO = (15, 0)
_ECHO_STAMP = struct.Struct("<Bd")  # of cflib's pings: a mark, and host time [s]
_ECHOES = 50  # newest echoes, for the median of the round trip


class CrazyflieLink:
    """The link interface (`base.Link`) for one Crazyflie.

    Attributes:
        uri: address of the drone.
        packets: log packets in order of arrival; one `LinkLost` at the end if the drone is lost.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.packets: queue.SimpleQueue[Packet | LinkLost] = queue.SimpleQueue()
        self._cf: Any = None
        self._owned = True
        self._commanded = False
        self._parameters: ParameterClient | None = None
        self._blocks = LogBlocks(uri, self.packets)
        self._reconnector: Reconnector | None = None
        self._lock = threading.Lock()
        self._lost = ""
        self._unrecoverable = False
        self._reconnecting = False
        self._stop = threading.Event()
        self._watcher: threading.Thread | None = None
        self._last_packet = time.monotonic()
        self._last_echo: float | None = None
        self._round_trips: deque[float] = deque(maxlen=_ECHOES)

    @classmethod
    def from_crazyflie(cls, crazyflie: Any) -> "CrazyflieLink":
        """A link over an open cflib Crazyflie of another owner: `close` then only removes our log blocks.

        Raises: UsageError if the object is not connected.
        """
        if crazyflie.link is None or not crazyflie.is_connected():
            raise UsageError("The Crazyflie object is not connected: open its link before attaching.")
        link = cls(crazyflie.link_uri)
        link._owned = False
        link._adopt(crazyflie)
        return link

    # --- connection ---------------------------------------------------------------------------------------------

    def connect(self, timeout: float = 30.0) -> None:
        """Connect and read all tables and parameter values.

        Requests without an answer are repeated, and a connection attempt without progress starts again.

        Raises: LinkError: nothing answers, or some answers are missing after `timeout` [s].
        """
        if self._cf is not None:
            return
        crazyflie = connect(self.uri, timeout)
        if crazyflie.platform.get_protocol_version() < 4:
            shut(crazyflie)
            raise LinkError(f"The firmware at {self.uri} is too old: it does not speak CRTP protocol 4 or newer.")
        self._adopt(crazyflie)

    def _adopt(self, crazyflie: Any) -> None:
        quiet_cflib()
        self._cf = crazyflie
        self._parameters = ParameterClient(crazyflie, self.uri)
        self._blocks.attach(crazyflie)
        self._reconnector = Reconnector(crazyflie, self.uri) if self._owned else None
        self._lost, self._unrecoverable = "", False
        self._last_echo = None
        self._remove_callbacks = add_callbacks(
            (crazyflie.connection_lost, self._on_connection_lost),
            (crazyflie.disconnected, self._on_disconnected),
            (crazyflie.packet_received, self._on_any_packet),
        )
        self._last_packet = time.monotonic()
        self._stop.clear()
        self._watcher = threading.Thread(target=self._watch, name="crazyem-link-watch", daemon=True)
        self._watcher.start()

    def close(self) -> None:
        """Remove our log blocks and disconnect if the link is our own; always returns within a few seconds.

        A session that sent commands ends with motors off and "notify stop", so that the next client can use the
        high-level commander (see `connection.shut`). A session without commands sends no setpoint.
        """
        crazyflie, self._cf = self._cf, None
        if crazyflie is None:
            return
        self._stop.set()
        self._blocks.remove(answered=not self._lost)
        if self._parameters is not None:
            self._parameters.close()
            self._parameters = None
        self._remove_callbacks()
        if self._owned:
            shut(crazyflie, hand_back=self._commanded, cut_motors=self._commanded)
        if self._watcher is not None:
            self._watcher.join(timeout=1.0)

    def __enter__(self) -> "CrazyflieLink":
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- logging ------------------------------------------------------------------------------------------------

    @property
    def log_variables(self) -> Mapping[str, str]:
        """Name -> C type of everything the firmware can log."""
        self._connected()
        return self._blocks.available()

    def subscribe(self, variables: Sequence[str], rate_hz: float) -> tuple[Block, ...]:
        """Pack variables into blocks and start them; returns once every block delivers.

        Args:
            variables: names, in any order.
            rate_hz: of all variables: 0.4 to 100 Hz, rounded to periods of 10 ms; up to 1000 Hz, rounded to 1 ms, if
                the firmware allows periods in milliseconds.

        Raises: UsageError (unknown variable, does not fit, too fast for this firmware), LinkError (does not start).
        """
        self._connected()
        return self._blocks.subscribe(variables, rate_hz, lambda: self._lost)

    def statistics(self) -> LinkStatistics:
        """Packets received, lost (computed from stamps) and late, delays, clocks: in total and per block."""
        trips = list(self._round_trips)
        return self._blocks.statistics(statistics.median(trips) if trips else math.nan)

    def clock(self) -> ClockFit | None:
        """Relation of the host clock to the firmware's, None before the first packet."""
        return self._blocks.clock()

    # --- the end of a link --------------------------------------------------------------------------------------

    def _on_any_packet(self, packet: Any) -> None:
        self._last_packet = time.monotonic()
        if (packet.port, packet.channel) == _ECHO and len(packet.data) == _ECHO_STAMP.size:
            self._last_echo = self._last_packet
            took = time.time() - _ECHO_STAMP.unpack(bytes(packet.data))[1]
            if 0.0 <= took < 10.0:  # else: another client's echo, a damaged one, or a host clock that was set
                self._round_trips.append(took)

    def _on_connection_lost(self, _uri: str, _message: str) -> None:
        self._report_lost(f"The drone at {self.uri} was lost (the link reports an error).")

    def _on_disconnected(self, _uri: str) -> None:
        if not self._owned:
            self._report_lost(f"The link to {self.uri} was closed.")

    def _report_lost(self, reason: str) -> None:
        with self._lock:
            if self._lost or self._stop.is_set():
                return
            self._lost = reason
        self.packets.put(LinkLost(reason, time.time()))

    def _watch(self) -> None:
        """Report a silent drone as lost, by the times of the last packets: cflib does not notice silence."""
        while not self._stop.wait(0.2):
            self._blocks.refresh()
            periods = self._blocks.periods
            if not periods or self._lost:
                continue
            limit = max(SILENT_AFTER, 5.0 * min(periods))
            now = time.monotonic()
            if now - self._blocks.last_packet > limit:
                silent = now - self._last_packet > limit
                what = "nothing has come" if silent else "it still answers but sends no log data (has it restarted?)"
                self._report_lost(f"The drone at {self.uri} was lost: {what} for {limit:g} s.")
            elif self._owned and self._last_echo is not None and now - self._last_echo > limit:
                what = "it sends, but has answered nothing"  # so setpoints do not arrive
                self._report_lost(f"The drone at {self.uri} was lost: {what} for {limit:g} s.")

    @property
    def can_reconnect(self) -> bool:
        """Whether `reconnect` may succeed: the link is our own, and the drone is not known to have restarted."""
        return self._reconnector is not None and not self._unrecoverable

    def reconnect(self, timeout: float = 5.0, abort: threading.Event | None = None) -> Outage:
        """After a `LinkLost`: reconnect to the same drone; its blocks then go on with the same numbers.

        Setpoints can still be sent during this time, because a link may be lost in one direction only.

        Args:
            timeout: s.
            abort: set by the caller to give up earlier.

        Raises: LinkError: not in time, or impossible (restarted, another firmware, not our own link).
        """
        if not self._lost or self._cf is None:
            raise LinkError(f"The link to {self.uri} is not lost.")
        if self._reconnector is None or self._unrecoverable:
            raise LinkError(self._lost)
        before, since, reason = self._blocks.newest_ms, self._blocks.last_packet, self._lost
        self._reconnecting = True
        self._blocks.hold()
        try:
            created = self._reconnector.reconnect(self._blocks, timeout, abort or threading.Event())
        except AnotherDroneError:
            self._unrecoverable = True
            raise
        finally:
            self._reconnecting = False
        self._last_echo = None  # unknown until the next echo
        now = time.monotonic()
        after = self._blocks.release()
        with self._lock:
            self._lost = ""
        return Outage(reason, now - since, before, after, created)

    def _connected(self) -> Any:
        if self._cf is None:
            raise LinkError(f"The link to {self.uri} is not open.")
        if self._lost:
            raise LinkError(self._lost)
        return self._cf

    # --- parameters ---------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> Mapping[str, str]:
        """Name -> C type of every parameter."""
        return self._parameter_client().types()

    @property
    def about(self) -> Mapping[str, Mapping[str, str]]:
        """Description of the firmware for recordings.

        Sections "firmware" (protocol, revision), "log_types", "parameter_types", "parameter_values" (at connect).
        """
        crazyflie = self._connected()
        values = {f"{g}.{n}": str(v) for g, names in crazyflie.param.values.items() for n, v in names.items()}
        firmware = {name: values[f"firmware.{name}"] for name in ("revision0", "revision1", "modified")
                    if f"firmware.{name}" in values}  # fmt: skip
        firmware["protocol"] = str(crazyflie.platform.get_protocol_version())
        return {
            "firmware": firmware,
            "log_types": self.log_variables,
            "parameter_types": self.parameters,
            "parameter_values": values,
        }

    def read_parameter(self, name: str, timeout: float = 2.0) -> float:
        """The present value in the firmware, by a new request. Raises UsageError or LinkError."""
        return self._parameter_client().read(name, timeout)

    def write_parameter(self, name: str, value: float, timeout: float = 1.0) -> ParameterWrite:
        """Write and verify: `verified` only if the drone echoed exactly the value's bits in the parameter's type.

        No echo within `timeout` gives `verified=False`; the link stays usable.

        Raises: UsageError: an unknown or read-only parameter, or a value that does not fit its type. LinkError: the
        drone is lost.
        """
        return self._parameter_client().write(name, value, timeout)

    def _parameter_client(self) -> ParameterClient:
        self._connected()
        if self._parameters is None:
            raise LinkError(f"The link to {self.uri} is not open.")
        return self._parameters

    # --- flying -------------------------------------------------------------------------------------------------

    def _command(self) -> Any:
        crazyflie = self._cf if self._reconnecting and self._cf is not None else self._connected()
        if crazyflie.link is None:
            raise LinkError(self._lost or f"The link to {self.uri} is closed.")
        self._commanded = True
        return crazyflie

    def arm(self, armed: bool) -> None:
        """Arm or disarm (brushless drones need it; brushed ones arm themselves)."""
        crazyflie = self._command()
        with warnings.catch_warnings():  # cflib warns about protocols before 12, but handles them
            warnings.simplefilter("ignore")
            crazyflie.supervisor.send_arming_request(bool(armed))

    def take_off(self, height: float, duration: float) -> None:
        """High-level take-off to `height` [m, world] in `duration` [s]."""
        self._command().high_level_commander.takeoff(height, duration)

    def land(self, height: float, duration: float) -> None:
        """High-level landing to `height` [m, world] in `duration` [s]."""
        self._command().high_level_commander.land(height, duration)

    def land_and_confirm(self, height: float, duration: float, *, timeout: float) -> bool:
        """As `land`, repeated until the drone confirms the command; False if it does not within `timeout` [s]."""
        command = land_command(height, duration)
        return send_until_confirmed(self._command(), command, timeout=timeout, repeat_after=0.04)

    def send_full_state(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        quaternion: Sequence[float],
        body_rate: Sequence[float],
    ) -> None:
        """Full-state setpoint.

        Args:
            position: m, world; |component| <= 32.767.
            velocity: m/s, world.
            acceleration: m/s^2, world, without gravity.
            quaternion: x, y, z, w, body to world.
            body_rate: rad/s, body (sent in mrad/s; cflib's docstring is wrong).
        """
        commander = self._command().commander
        try:
            commander.send_full_state_setpoint(position, velocity, acceleration, quaternion, *body_rate)
        except (struct.error, ValueError, OverflowError) as error:
            raise UsageError(
                f"The setpoint at {[round(float(v), 3) for v in position]} m does not fit the wire: positions, "
                "velocities and accelerations must stay within 32.767 m, m/s and m/s^2."
            ) from error

    def send_position(self, x: float, y: float, z: float, yaw: float) -> None:
        """Position setpoint: x, y, z [m, world], yaw [rad] (degrees on the wire)."""
        self._command().commander.send_position_setpoint(x, y, z, math.degrees(yaw))

    def release_setpoints(self) -> None:
        """Send "notify stop": low-level setpoints have ended, and the high-level commander may act again."""
        self._command().commander.send_notify_setpoint_stop()

    def stop(self) -> None:
        """Motors off now, both for low-level setpoints and for the high-level commander."""
        crazyflie = self._command()
        crazyflie.high_level_commander.stop()
        crazyflie.commander.send_stop_setpoint()
