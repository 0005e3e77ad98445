"""A Crazyflie over unmodified cflib: everything with a time limit, losses counted, a lost drone reported once."""

import contextlib
import math
import queue
import struct
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from crazyem.errors import LinkError, UsageError
from crazyem.links import connecting
from crazyem.links.base import LinkLost, LinkStatistics, ParameterWrite
from crazyem.links.clock import ClockFit, ClockRelation, LossCounter, StampUnwrapper
from crazyem.links.packing import pack, period_of
from crazyem.links.parameters import ParameterClient
from crazyem.signals.packet import Block, Packet

SILENT_AFTER = 2.0  # s without log data, while blocks run, after which the drone counts as lost
LATE_AFTER = 0.1  # s behind the least-delayed packets after which a packet counts as late
_START_ATTEMPT = 0.5  # s to wait for a block's first packet beyond its period, before asking again
_START_ATTEMPTS = 4


class CrazyflieLink:
    """The link interface (`base.Link`) for one Crazyflie.

    Attributes:
        uri: where the drone is.
        packets: log packets in order of arrival; at the end one `LinkLost` if the drone went away.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.packets: queue.SimpleQueue[Packet | LinkLost] = queue.SimpleQueue()
        self._cf: Any = None
        self._owned = True
        self._commanded = False
        self._parameters: ParameterClient | None = None
        self._running: dict[int, tuple[Block, Any, Callable[..., None]]] = {}
        self._counters: dict[int, LossCounter] = {}
        self._unwrapper = StampUnwrapper()
        self._clock = ClockRelation()
        self._edge: ClockFit | None = None
        self._lock = threading.Lock()
        self._lost = ""
        self._stop = threading.Event()
        self._watcher: threading.Thread | None = None
        self._last_packet = time.monotonic()
        self._last_log = self._last_packet

    @classmethod
    def from_crazyflie(cls, crazyflie: Any) -> "CrazyflieLink":
        """Ride on an open cflib Crazyflie without owning it: `close` then only removes our log blocks.

        Raises: UsageError if the object is not connected.
        """
        if crazyflie.link is None or not crazyflie.is_connected():
            raise UsageError("The Crazyflie object is not connected: open its link before attaching.")
        link = cls(crazyflie.link_uri)
        link._owned = False
        link._adopt(crazyflie)
        return link

    # --- connection ---------------------------------------------------------------------------------------------

    def connect(self, timeout: float = 15.0) -> None:
        """Connect and read all tables and parameter values.

        Raises: LinkError: nothing answers, or a reply was lost on the way (cflib itself would wait for ever).
        """
        if self._cf is not None:
            return
        crazyflie = connecting.new_crazyflie(self.uri)
        connecting.open_link(crazyflie, self.uri, timeout)
        if crazyflie.platform.get_protocol_version() < 4:
            connecting.shut(crazyflie)
            raise LinkError(f"The firmware at {self.uri} is too old: it does not speak CRTP protocol 4 or newer.")
        self._adopt(crazyflie)

    def _adopt(self, crazyflie: Any) -> None:
        connecting.quiet_cflib()
        self._cf = crazyflie
        self._parameters = ParameterClient(crazyflie, self.uri)
        crazyflie.connection_lost.add_callback(self._on_connection_lost)
        crazyflie.disconnected.add_callback(self._on_disconnected)
        crazyflie.packet_received.add_callback(self._on_any_packet)
        self._last_packet = self._last_log = time.monotonic()
        self._stop.clear()
        self._watcher = threading.Thread(target=self._watch, name="crazyem-link-watch", daemon=True)
        self._watcher.start()

    def close(self) -> None:
        """Remove our log blocks and, on a link of our own, disconnect; returns within a few seconds, always.

        A session that commanded the drone ends with motors off and "notify stop", so that the next client can use the
        high-level commander (see `connecting.shut`); one that only watched sends no setpoint at all.
        """
        crazyflie, self._cf = self._cf, None
        if crazyflie is None:
            return
        self._stop.set()
        self._remove_blocks(crazyflie)
        if self._parameters is not None:
            self._parameters.close()
            self._parameters = None
        for caller, callback in (
            (crazyflie.connection_lost, self._on_connection_lost),
            (crazyflie.disconnected, self._on_disconnected),
            (crazyflie.packet_received, self._on_any_packet),
        ):
            with contextlib.suppress(ValueError):
                caller.remove_callback(callback)
        if self._owned:
            connecting.shut(crazyflie, hand_back=self._commanded, cut_motors=self._commanded)
        if self._watcher is not None:
            self._watcher.join(timeout=1.0)

    def __enter__(self) -> "CrazyflieLink":
        if self._cf is None:
            self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- logging ------------------------------------------------------------------------------------------------

    @property
    def log_variables(self) -> Mapping[str, str]:
        """Name -> C type of everything the firmware can log."""
        table = self._connected().log.toc.toc
        return {f"{group}.{name}": item.ctype for group, items in table.items() for name, item in items.items()}

    def subscribe(
        self, variables: Sequence[str], rate_hz: float, groups: Sequence[Sequence[str]] | None = None
    ) -> tuple[Block, ...]:
        """Pack variables into blocks and start them; returns once every block delivers.

        Args:
            variables: names, in any order.
            rate_hz: of every one of them, 0.4 to 100 Hz (rounded to periods of 10 ms).
            groups: names that must be sampled together; None = the parts of each signal.

        Raises: UsageError (unknown variable, does not fit), LinkError (a block does not start).
        """
        from cflib.crazyflie.log import LogConfig

        crazyflie = self._connected()
        in_use = [b for b in crazyflie.log.log_blocks if b.added or b.pending or b.started]
        blocks = pack(
            variables,
            self.log_variables,
            period_of(rate_hz),
            groups=groups,
            first_identifier=max(self._counters, default=-1) + 1,
            blocks_in_use=len(in_use),
            variables_in_use=sum(len(b.variables) for b in in_use),
        )
        for block in blocks:
            config = LogConfig(f"crazyem {block.identifier}", block.period_ms)
            for variable in block.variables:
                config.add_variable(variable.name)
            try:
                crazyflie.log.add_config(config)
            except (KeyError, AttributeError) as error:
                raise UsageError(f"The drone does not take log block {block.identifier}: {error}.") from error
            receive = self._receiver(block)
            config.data_received_cb.add_callback(receive)
            self._counters[block.identifier] = LossCounter(block.period_ms)
            self._last_log = time.monotonic()
            self._running[block.identifier] = (block, config, receive)
            self._start(block, config)
        return blocks

    def _start(self, block: Block, config: Any) -> None:
        """Start a block and see its first packet; ask again if a reply was lost (the firmware tolerates repeats)."""
        for _ in range(_START_ATTEMPTS):
            try:
                config.start()
            except (AttributeError, KeyError) as error:
                raise UsageError(f"The drone does not take log block {block.identifier}: {error}.") from error
            deadline = time.monotonic() + _START_ATTEMPT + block.period_ms / 1000.0
            while time.monotonic() < deadline:
                if self._lost:
                    raise LinkError(self._lost)
                if self._counters[block.identifier].received:
                    return
                if config.err_no:
                    raise LinkError(f"The drone refused log block {block.identifier} (error {config.err_no}).")
                time.sleep(0.002)
        raise LinkError(f"Log block {block.identifier} of {self.uri} does not start: no data came.")

    def _receiver(self, block: Block) -> Callable[[int, Mapping[str, float], Any], None]:
        names = tuple(v.name for v in block.variables)
        identifier = block.identifier

        def receive(stamp: int, data: Mapping[str, float], _config: Any) -> None:
            host_time = time.time()
            self._last_log = time.monotonic()
            with self._lock:
                firmware_time = self._unwrapper.unwrap(stamp)
                self._clock.add(firmware_time, host_time)
                edge = self._edge
                late = edge is not None and host_time - edge.to_host(firmware_time) > LATE_AFTER
                self._counters[identifier].count(firmware_time, late=late)
            self.packets.put(Packet(identifier, firmware_time, host_time, tuple(data[name] for name in names)))

        return receive

    def _remove_blocks(self, crazyflie: Any) -> None:
        for _, config, receive in self._running.values():
            with contextlib.suppress(ValueError):
                config.data_received_cb.remove_callback(receive)
            if crazyflie.link is not None and not self._lost:
                with contextlib.suppress(Exception):
                    config.stop()
                    config.delete()
        deadline = time.monotonic() + 0.3
        while not self._lost and time.monotonic() < deadline and any(c.added for _, c, _ in self._running.values()):
            time.sleep(0.005)
        for _, config, _ in self._running.values():
            with contextlib.suppress(ValueError):
                crazyflie.log.log_blocks.remove(config)
        self._running.clear()

    def statistics(self) -> LinkStatistics:
        """Packets received, lost (inferred from stamps) and late, in total and per block."""
        with self._lock:
            fates = {i: (c.received, c.lost, c.late) for i, c in self._counters.items()}
        totals = [sum(f[k] for f in fates.values()) for k in range(3)]
        return LinkStatistics(totals[0], totals[1], totals[2], fates)

    def clock(self) -> ClockFit | None:
        """How the host clock runs against the firmware's, None before the first packet."""
        with self._lock:
            return self._clock.fit()

    # --- the end of a link --------------------------------------------------------------------------------------

    def _on_any_packet(self, _packet: Any) -> None:
        self._last_packet = time.monotonic()

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
        """A peer that falls silent raises nothing in cflib: compare the time of the last packet with the clock."""
        while not self._stop.wait(0.2):
            with self._lock:
                self._edge = self._clock.fit()
                periods = [block.period_ms / 1000.0 for block, _, _ in list(self._running.values())]
            if not periods or self._lost:
                continue
            limit = max(SILENT_AFTER, 5.0 * min(periods))
            now = time.monotonic()
            if now - self._last_log > limit:
                silent = now - self._last_packet > limit
                what = "nothing has come" if silent else "it still answers but sends no log data (has it restarted?)"
                self._report_lost(f"The drone at {self.uri} was lost: {what} for {limit:g} s.")

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
    def parameter_fault(self) -> str:
        """Why the last parameter access went unanswered; "" while parameters work."""
        return self._parameters.fault if self._parameters is not None else ""

    @property
    def about(self) -> Mapping[str, Mapping[str, str]]:
        """What the firmware says of itself, for recordings: sections "firmware" (protocol, revision), "log_types",
        "parameter_types" and "parameter_values" (as read while connecting)."""
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
        """The value in the firmware now, asked for afresh. Raises UsageError or LinkError."""
        return self._parameter_client().read(name, timeout)

    def write_parameter(self, name: str, value: float, timeout: float = 1.0) -> ParameterWrite:
        """Write and verify: `verified` only if the drone echoed exactly the value's bits in the parameter's type.

        No echo within `timeout` gives `verified=False` and a `parameter_fault`; the link stays usable.

        Raises: UsageError for an unknown or read-only parameter or a value that does not fit its type; LinkError if
        the drone is known to be gone.
        """
        return self._parameter_client().write(name, value, timeout)

    def _parameter_client(self) -> ParameterClient:
        self._connected()
        if self._parameters is None:
            raise LinkError(f"The link to {self.uri} is not open.")
        return self._parameters

    # --- flying -------------------------------------------------------------------------------------------------

    def _command(self) -> Any:
        crazyflie = self._connected()
        self._commanded = True
        return crazyflie

    def arm(self, armed: bool) -> None:
        """Arm or disarm (brushless drones need it; brushed ones arm themselves)."""
        crazyflie = self._command()
        with warnings.catch_warnings():  # cflib warns about protocols before 12, and then does the right thing
            warnings.simplefilter("ignore")
            crazyflie.supervisor.send_arming_request(bool(armed))

    def take_off(self, height: float, duration: float) -> None:
        """High-level take-off to `height` [m, world] in `duration` [s]."""
        self._command().high_level_commander.takeoff(height, duration)

    def land(self, height: float, duration: float) -> None:
        """High-level landing to `height` [m, world] in `duration` [s]."""
        self._command().high_level_commander.land(height, duration)

    def go_to(self, x: float, y: float, z: float, yaw: float, duration: float, relative: bool = False) -> None:
        """High-level move to x, y, z [m, world] and yaw [rad] in `duration` [s]."""
        self._command().high_level_commander.go_to(x, y, z, yaw, duration, relative)

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
            body_rate: rad/s, body (the wire carries mrad/s, whatever cflib's docstring says).
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

    def send_hover(self, vx: float, vy: float, yaw_rate: float, z: float) -> None:
        """Hover setpoint: vx, vy [m/s, body], yaw rate [rad/s] (degrees per second on the wire), z [m, world]."""
        self._command().commander.send_hover_setpoint(vx, vy, math.degrees(yaw_rate), z)

    def release_setpoints(self) -> None:
        """ "Notify stop": low-level setpoints have ended, the high-level commander may act again."""
        self._command().commander.send_notify_setpoint_stop()

    def stop(self) -> None:
        """Motors off now, for low-level setpoints and the high-level commander alike."""
        crazyflie = self._command()
        crazyflie.high_level_commander.stop()
        crazyflie.commander.send_stop_setpoint()
