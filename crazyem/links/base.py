"""The narrow interface of every link to a drone, and what some links can do besides.

`Link` is what all of them do. Each further ability is a protocol of its own; `isinstance(link, ReconnectingLink)` asks
an open link whether it has that ability.
"""

import math
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from crazyem.errors import LinkError
from crazyem.links.clock import ClockFit
from crazyem.signals.sample import Block, Packet, Variable

__all__ = [
    "AccountingLink",
    "AnotherDroneError",
    "Block",
    "ClockedLink",
    "ConfirmingLink",
    "DescribingLink",
    "HostClockLink",
    "HoverThrustLink",
    "Link",
    "LinkLost",
    "LinkStatistics",
    "Outage",
    "Packet",
    "ParameterWrite",
    "ReconnectingLink",
    "StreamingLink",
    "Variable",
    "link_account",
]


class AnotherDroneError(LinkError):
    """Somebody answers, but there is no going on with it: another firmware, or the same one started anew."""


@dataclass(frozen=True, slots=True)
class LinkLost:
    """Put into the packet queue, once, when the drone is gone; `reason` is one sentence.

    `restarted`: whoever answers now has started anew.
    """

    reason: str
    host_time: float
    restarted: bool = False


@dataclass(frozen=True, slots=True)
class ParameterWrite:
    """What became of a parameter write: `echoed` is the value the drone confirmed, None if no echo came in time."""

    name: str
    value: float
    echoed: float | None
    verified: bool
    host_time: float


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """Packets by fate, delays and clocks. `lost` is inferred from the firmware stamps against the block's period.

    Attributes:
        per_block: block -> received, lost, late.
        delays: block -> median and 99th percentile of the newest packets' delay over the least-delayed ones, s.
        round_trip: median of the newest echoes, s; NaN where unknown.
        clock_offset, clock_rate: host time [s since the epoch] = offset + rate * firmware time [s]; NaN where unknown.
        outages: how often the link was lost and came back.
        duplicates: packets that the link brought again; they are dropped and count as nothing else.
    """

    received: int = 0
    lost: int = 0
    late: int = 0
    per_block: Mapping[int, tuple[int, int, int]] = field(default_factory=dict)
    delays: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    round_trip: float = math.nan
    clock_offset: float = math.nan
    clock_rate: float = math.nan
    outages: int = 0
    duplicates: int = 0


@dataclass(frozen=True, slots=True)
class Outage:
    """A time without a link that is over.

    Attributes:
        reason: why the link counted as lost, one sentence.
        seconds: from the last log packet before to the first after, host clock.
        before_ms, after_ms: their stamps on the drone's clock, unwrapped, ms.
        created: log blocks that had to be created anew.
    """

    reason: str
    seconds: float
    before_ms: float
    after_ms: float
    created: int


def link_account(statistics: LinkStatistics, outages: Sequence[Outage]) -> dict[str, str]:
    """What became of the packets, for a recording: clocks, round trip, and each block's fates and delays."""
    account = {
        "clock.offset_s": repr(statistics.clock_offset),
        "clock.rate": repr(statistics.clock_rate),
        "clock.drift_ppm": f"{1e6 * (statistics.clock_rate - 1.0):.3f}",
        "round_trip_s": f"{statistics.round_trip:.6f}",
        "outages": str(len(outages)),
        "duplicates": str(statistics.duplicates),
    }
    for number, outage in enumerate(outages):
        account[f"outage.{number}"] = f"{outage.before_ms:.0f} ms to {outage.after_ms:.0f} ms: {outage.reason}"
    for block, (received, lost, late) in statistics.per_block.items():
        account[f"block.{block}.packets"] = f"{received} received, {lost} lost, {late} late"
        if block in statistics.delays:
            median, p99 = statistics.delays[block]
            account[f"block.{block}.delay_s"] = f"{median:.6f} median, {p99:.6f} 99th percentile"
    return account


class Link(Protocol):
    """A drone on the other end. Every call has a timeout of our own; none waits for ever.

    Units are SI throughout: m, m/s, m/s^2, rad, rad/s, s; world z up, body FLU, quaternions x y z w.
    """

    uri: str
    packets: "queue.SimpleQueue[Packet | LinkLost]"

    def connect(self, timeout: float = 30.0) -> None: ...  # raises LinkError
    def close(self) -> None: ...
    @property
    def log_variables(self) -> Mapping[str, str]: ...  # name -> C type
    @property
    def parameters(self) -> Mapping[str, str]: ...
    def subscribe(self, variables: Sequence[str], rate_hz: float) -> tuple[Block, ...]: ...
    def read_parameter(self, name: str, timeout: float = 2.0) -> float: ...
    def write_parameter(self, name: str, value: float, timeout: float = 1.0) -> ParameterWrite: ...
    def statistics(self) -> LinkStatistics: ...

    # flying
    def arm(self, armed: bool) -> None: ...
    def take_off(self, height: float, duration: float) -> None: ...
    def land(self, height: float, duration: float) -> None: ...
    def go_to(self, x: float, y: float, z: float, yaw: float, duration: float, relative: bool = False) -> None: ...
    def send_full_state(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        quaternion: Sequence[float],
        body_rate: Sequence[float],
    ) -> None: ...
    def send_position(self, x: float, y: float, z: float, yaw: float) -> None: ...
    def send_hover(self, vx: float, vy: float, yaw_rate: float, z: float) -> None: ...
    def release_setpoints(self) -> None: ...  # "notify stop": hand back to the high-level commander
    def stop(self) -> None: ...  # motors off now


# --- abilities that some links have -------------------------------------------------------------------------------


@runtime_checkable
class StreamingLink(Protocol):
    """A drone that sends messages by itself; nobody asks for single variables."""

    on_frame: Callable[[float, bytes], None] | None  # called with (host time [s], frame) for every sound frame

    def start_streams(self, rate_hz: float) -> tuple[Block, ...]: ...  # raises LinkError


@runtime_checkable
class ReconnectingLink(Protocol):
    """A link that can bring back the same drone after a `LinkLost`."""

    @property
    def can_reconnect(self) -> bool: ...
    def reconnect(self, timeout: float = 5.0, abort: threading.Event | None = None) -> Outage: ...  # raises LinkError


@runtime_checkable
class ClockedLink(Protocol):
    """A link that relates the host's clock to the drone's; None before the first packet."""

    def clock(self) -> ClockFit | None: ...


@runtime_checkable
class HostClockLink(Protocol):
    """A link whose `Packet.host_time` is not `time.time()` but this clock, s: simulated time."""

    def host_clock(self) -> float: ...


@runtime_checkable
class AccountingLink(Protocol):
    """A link that knows more about lost bytes than `LinkStatistics` says."""

    def account(self) -> Mapping[str, str]: ...


@runtime_checkable
class DescribingLink(Protocol):
    """A link whose firmware describes itself, in sections for a recording."""

    @property
    def about(self) -> Mapping[str, Mapping[str, str]]: ...


@runtime_checkable
class ConfirmingLink(Protocol):
    """A link that repeats a command to land until the drone has it; False after `timeout` [s]."""

    def land_and_confirm(self, height: float, duration: float, *, timeout: float) -> bool: ...


@runtime_checkable
class HoverThrustLink(Protocol):
    """An autopilot that takes hover thrust instead of a mass.

    `hover_parameter` is "" where none is known; `onboard_hover_estimator` says what else on board writes it, "" if
    nothing does; `cells` of the battery are 0 while unknown.
    """

    @property
    def hover_parameter(self) -> str: ...
    @property
    def onboard_hover_estimator(self) -> str: ...
    @property
    def cells(self) -> int: ...
    def read_parameter(self, name: str, timeout: float = 2.0) -> float: ...
