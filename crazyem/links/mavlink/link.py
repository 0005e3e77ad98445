"""A link to a MAVLink drone: it receives messages, relates clocks, counts losses, and can write a parameter.

It cannot fly the drone: setpoints belong to the program that flies it.
"""

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import AnotherDroneError, LinkLost, LinkStatistics, Outage, ParameterWrite
from crazyem.links.clock import ClockFit
from crazyem.links.mavlink import streams
from crazyem.links.mavlink.frames import number_of
from crazyem.links.mavlink.parameters import ParameterClient
from crazyem.links.mavlink.receiver import Receiver
from crazyem.links.mavlink.transport import ACCEPTED, MessageSender, open_transport, parse
from crazyem.signals.sample import Block, Packet

# s of listening after the request for streams; the same at most, if messages are missing
_LISTEN_SECONDS, _LONGEST_LISTEN_SECONDS = 0.7, 5.0
HOVER_PARAMETERS = {streams.PX4: "MPC_THR_HOVER", streams.ARDUPILOT: "MOT_THST_HOVER"}
# onboard estimator of hover thrust: its parameter, the value if it is on, a description
ONBOARD_HOVER_ESTIMATORS = {
    streams.PX4: ("MPC_USE_HTE", 1.0, "PX4 flies with its own estimate of hover thrust"),
    streams.ARDUPILOT: ("MOT_HOVER_LEARN", 2.0, "ArduPilot learns and saves hover thrust itself"),
}


class MavlinkLink:
    """A link to one autopilot. Blocks are messages (`streams`); every call has a time limit.

    Args:
        uri: see `transport.parse`. Raises UsageError.

    Attributes:
        packets: received, in order; `LinkLost` at the end.
        on_frame: called with (host time [s], frame) for every valid frame of this drone, in the receiving thread.
        outputs: mapping of its motor outputs.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.address = parse(uri)
        self.packets: queue.SimpleQueue[Packet | LinkLost] = queue.SimpleQueue()
        self.outputs = streams.Outputs()
        self._receiver: Receiver | None = None
        self._reconnecting = False
        self._rate = 0.0
        self._parameters = ParameterClient(
            uri,
            ask_read=lambda name: self._talk().ask_parameter(name),
            ask_write=lambda name, value, kind: self._talk().set_parameter(name, value, kind),
            bitwise=lambda: self.autopilot == streams.PX4,
        )

    # --- connection ---------------------------------------------------------------------------------------------

    def connect(self, timeout: float = 30.0) -> None:
        """Wait for the heartbeat of a vehicle, then read the parameters of its outputs. Raises LinkError."""
        if self._receiver is not None:
            return
        self._receiver = receiver = Receiver(
            self.uri,
            MessageSender(open_transport(self.address)),
            system=self.address.system,
            packets=self.packets,
            on_parameter=self._parameters.on_value,
        )
        try:
            if not self._wait(lambda: receiver.autopilot >= 0, timeout):
                raise LinkError(self._silence_message(receiver, timeout))
            self._identify(receiver)
        except BaseException:
            self.close()
            raise

    def _silence_message(self, receiver: Receiver, timeout: float) -> str:
        others = f" Systems {', '.join(map(str, sorted(receiver.foreign)))} were heard." if receiver.foreign else ""
        noise = f" {receiver.parser.skipped} bytes came that are not MAVLink." if receiver.parser.skipped else ""
        chosen = f"system {self.address.system}" if self.address.system else "a vehicle"
        return f"no heartbeat of {chosen} came at {self.uri} within {timeout:g} s.{others}{noise}"

    def _identify(self, receiver: Receiver) -> None:
        wanted = list(streams.wanted(receiver.autopilot))
        if receiver.autopilot in HOVER_PARAMETERS:
            wanted += [HOVER_PARAMETERS[receiver.autopilot], ONBOARD_HOVER_ESTIMATORS[receiver.autopilot][0]]

        def complete() -> bool:
            version = attempt > 0 or "AUTOPILOT_VERSION" in receiver.seen  # not all autopilots send one
            return version and not set(wanted) - self._parameters.known.keys()

        for attempt in range(3):
            receiver.sender.request_message(number_of("AUTOPILOT_VERSION"))
            for name in wanted:
                if name not in self._parameters.known:
                    receiver.sender.ask_parameter(name)
            if self._wait(complete, 0.3 * (attempt + 1)):
                break
        self.outputs = receiver.streams.outputs = streams.Outputs.of(receiver.autopilot, self._parameters.known)

    def close(self) -> None:
        """Stop listening and close the connection. The requested streams go on."""
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.close()
            receiver.sender.transport.close()

    def __enter__(self) -> "MavlinkLink":
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> Receiver:
        if self._receiver is None:
            raise LinkError(f"The link to {self.uri} is not open.")
        return self._receiver

    def _talk(self) -> MessageSender:
        receiver = self._open()
        if receiver.lost and not self._reconnecting:
            raise LinkError(receiver.lost)
        return receiver.sender

    def _wait(self, done: Callable[[], bool], seconds: float) -> bool:
        until = time.monotonic() + seconds
        while not done():
            if time.monotonic() > until:
                return False
            self._talk()  # raises if the drone is lost
            time.sleep(0.005)
        return True

    @property
    def autopilot(self) -> int:
        """MAV_AUTOPILOT of the drone, -1 before it is known."""
        return self._receiver.autopilot if self._receiver is not None else -1

    @property
    def simulated(self) -> bool:
        """Whether the drone says that it is our simulator; an address is no evidence, since it may be a relay."""
        return self._receiver is not None and self._receiver.simulated

    @property
    def on_frame(self) -> Callable[[float, bytes], None] | None:
        return self._open().on_frame

    @on_frame.setter
    def on_frame(self, keep: Callable[[float, bytes], None] | None) -> None:
        self._open().on_frame = keep

    # --- logging ------------------------------------------------------------------------------------------------

    @property
    def log_variables(self) -> Mapping[str, str]:
        """Name -> C type of every variable in our blocks."""
        return {v.name: v.ctype for name in streams.block_names() for v in streams.variables_of(name)}

    def start_streams(self, rate_hz: float) -> tuple[Block, ...]:
        """Request all messages for the estimator, select from those that arrive, and deliver them as blocks.

        Raises: LinkError: no messages with position, attitude, or motor outputs or rotor speeds.
        """
        receiver = self._open()
        self._rate = rate_hz
        self._ask_streams(rate_hz)
        ready = time.monotonic() + max(_LISTEN_SECONDS, 2.5 / rate_hz)
        self._wait(
            lambda: time.monotonic() > ready and not _missing(receiver.seen),
            ready + _LONGEST_LISTEN_SECONDS - time.monotonic(),
        )
        if missing := _missing(receiver.seen):
            raise LinkError(f"the drone at {self.uri} sends no {' and no '.join(missing)}.")
        names = receiver.streams.choose(set(receiver.seen), raw_imu=receiver.autopilot == streams.ARDUPILOT)
        blocks = streams.blocks_of(names, rate_hz)
        receiver.use(blocks)
        return tuple(blocks.values())

    def subscribe(self, variables: Sequence[str], rate_hz: float) -> tuple[Block, ...]:
        """Start all streams for any variables: an autopilot sends messages, not variables."""
        unknown = [v for v in variables if v not in self.log_variables]
        if unknown:
            raise UsageError(f"a MAVLink drone has no log variable {unknown[0]}.")
        return self.start_streams(rate_hz)

    def _ask_streams(self, rate_hz: float) -> None:
        sender = self._talk()
        answers = 0
        for names, hertz in ((streams.FAST_MESSAGES, rate_hz), (streams.SLOW_MESSAGES, min(streams.SLOW_HZ, rate_hz))):
            for name in names:
                result = sender.set_interval(number_of(name), hertz)
                answers += result == ACCEPTED
                if result is None and not answers:
                    break  # the command is unknown: do not repeat it for all messages
        if not answers:
            for group, fast in streams.STREAM_GROUPS:
                sender.request_stream(group, rate_hz if fast else min(streams.SLOW_HZ, rate_hz))

    def statistics(self) -> LinkStatistics:
        """Counts of this drone's messages: lost ones by their sequence numbers, without repeated ones."""
        return self._open().statistics()

    def clock(self) -> ClockFit | None:
        """Relation of the host clock to the autopilot's, None before the first packet."""
        return self._open().fit()

    def account(self) -> Mapping[str, str]:
        """Counts of frames and bytes, for the end of a recording."""
        return self._open().account()

    # --- the end of a link --------------------------------------------------------------------------------------

    @property
    def can_reconnect(self) -> bool:
        """Whether `reconnect` may succeed."""
        return self._receiver is not None and not self._receiver.unrecoverable

    def reconnect(self, timeout: float = 5.0, abort: threading.Event | None = None) -> Outage:
        """After a `LinkLost`: wait for the same drone with a continuous clock, and request its streams again.

        Raises: LinkError: not in time, or restarted.
        """
        receiver = self._open()
        if not receiver.lost:
            raise LinkError(f"The link to {self.uri} is not lost.")
        before, since, reason = receiver.drone_clock.newest_ms, receiver.last, receiver.lost
        until = time.monotonic() + timeout
        self._reconnecting = True
        try:
            while receiver.last <= since:
                if receiver.unrecoverable:
                    raise AnotherDroneError(f"The drone at {self.uri} was restarted.")
                if time.monotonic() > until or (abort is not None and abort.is_set()):
                    raise LinkError(f"The drone at {self.uri} did not come back within {timeout:g} s.")
                if receiver.unplugged:
                    self._reopen(receiver)
                time.sleep(0.05)
            self._ask_streams(self._rate)
        finally:
            self._reconnecting = False
        receiver.end_outage()
        return Outage(reason, receiver.last - since, before, receiver.drone_clock.newest_ms, 0)

    def _reopen(self, receiver: Receiver) -> None:
        """Open the transport again, for example after a serial port was unplugged."""
        try:
            transport = open_transport(self.address)
        except LinkError:
            return
        old, receiver.sender.transport = receiver.sender.transport, transport
        receiver.unplugged = False
        old.close()

    # --- parameters ---------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> Mapping[str, str]:
        """Name -> C type of the parameters received so far: the whole list takes minutes over a telemetry radio."""
        return self._parameters.types()

    @property
    def hover_parameter(self) -> str:
        """The hover thrust parameter of this kind of autopilot, "" if none is known."""
        return HOVER_PARAMETERS.get(self.autopilot, "")

    @property
    def onboard_hover_estimator(self) -> str:
        """The onboard estimator that writes or replaces this parameter, one clause; "" if there is none."""
        name, value, what = ONBOARD_HOVER_ESTIMATORS.get(self.autopilot, ("", 0.0, ""))
        return f"{what} ({name} = {value:g})" if self._parameters.known.get(name) == value else ""

    @property
    def cells(self) -> int:
        """Number of battery cells; 0 if unknown."""
        return self._open().streams.cells

    @property
    def about(self) -> Mapping[str, Mapping[str, str]]:
        """Description for recordings: sections "mavlink" and "parameter_values" (received ones)."""
        receiver = self._open()
        link = {
            "system": str(receiver.system),
            "component": str(receiver.component),
            "autopilot": str(receiver.autopilot),
            "vehicle_type": str(receiver.kind),
            "our_simulator": str(receiver.simulated).lower(),
            "assumed": "; ".join(self.outputs.assumed),
            "outputs.channels": " ".join(str(c + 1) for c in self.outputs.channels),
            "outputs.motors": " ".join(str(m + 1) for m in self.outputs.motors),
        }
        return {"mavlink": link, "parameter_values": {n: repr(v) for n, v in self._parameters.known.items()}}

    def read_parameter(self, name: str, timeout: float = 2.0) -> float:
        """The present value in the drone. Raises LinkError or UsageError."""
        self._talk()
        return self._parameters.read(name, timeout)

    def write_parameter(self, name: str, value: float, timeout: float = 1.0) -> ParameterWrite:
        """Write and verify by PARAM_VALUE: `verified` only if the drone sent back exactly the bits written."""
        self._talk()
        return self._parameters.write(name, value, timeout)

    # --- flying: not possible -----------------------------------------------------------------------------------

    def _not_flown(self, *_: object, **__: object) -> None:
        raise UsageError("a MAVLink drone is watched, not flown: fly it with its own ground station.")

    arm = take_off = land = send_full_state = send_position = release_setpoints = stop = _not_flown


def _missing(seen: Mapping[str, int]) -> list[str]:
    """Necessary inputs of the estimator that have not arrived."""
    needs = {
        "LOCAL_POSITION_NED (has it no position?)": ("LOCAL_POSITION_NED",),
        "attitude": ("ATTITUDE_QUATERNION", "ATTITUDE"),
        "motor outputs or rotor speeds (ACTUATOR_OUTPUT_STATUS, SERVO_OUTPUT_RAW, ESC_STATUS)": (
            *("ACTUATOR_OUTPUT_STATUS", "SERVO_OUTPUT_RAW", "ESC_STATUS", "ESC_TELEMETRY_1_TO_4"),
        ),
    }
    return [what for what, names in needs.items() if not any(n in seen for n in names)]
