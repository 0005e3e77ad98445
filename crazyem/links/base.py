"""The narrow interface of every link to a drone, and additional abilities of some links.

`Link` is common to all links. Each additional ability is a separate protocol; for example,
`isinstance(link, ReconnectingLink)` tests whether an open link has this ability.
"""

import math
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from crazyem.errors import LinkError
from crazyem.links.clock import ClockFit
from crazyem.signals.sample import Block, Packet


class AnotherDroneError(LinkError):
    """A drone answers, but the session cannot continue with it: another firmware, or a restarted one."""


@dataclass(frozen=True, slots=True)
class LinkLost:
    """Put into the packet queue, once, when the drone is lost; `reason` is one sentence.

    `restarted`: a drone answers, but it has restarted.
    """

    reason: str
    host_time: float
    restarted: bool = False


@dataclass(frozen=True, slots=True)
class ParameterWrite:
    """Result of a parameter write: `echoed` is the value in the drone's echo, None if no echo came in time."""

    name: str
    value: float
    echoed: float | None
    verified: bool
    host_time: float


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """Counts of packets, delays and clocks. `lost` is computed from the firmware stamps and the block's period.

    Attributes:
        per_block: block -> received, lost, late.
        delays: block -> median and 99th percentile of the newest packets' delay over the least-delayed ones, s.
        round_trip: median of the newest echoes, s; NaN if unknown.
        clock_offset, clock_rate: host time [s since the epoch] = offset + rate * firmware time [s]; NaN if unknown.
        outages: number of times that the link was lost and came back.
        duplicates: packets that the link delivered again; they are dropped and not counted otherwise.
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
    """A past time without a link.

    Attributes:
        reason: why the link counted as lost, one sentence.
        seconds: from the last log packet before to the first after, host clock.
        before_ms, after_ms: their stamps on the drone's clock, unwrapped, ms.
        created: number of log blocks that were created again.
    """

    reason: str
    seconds: float
    before_ms: float
    after_ms: float
    created: int


def link_account(statistics: LinkStatistics, outages: Sequence[Outage]) -> dict[str, str]:
    """Statistics of a link for a recording: clocks, round trip, and each block's counts and delays."""
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
    """Interface of a link to a drone. Every call has its own timeout; none waits for ever.

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
    def send_full_state(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        quaternion: Sequence[float],
        body_rate: Sequence[float],
    ) -> None: ...
    def send_position(self, x: float, y: float, z: float, yaw: float) -> None: ...
    def release_setpoints(self) -> None: ...  # "notify stop": hand back to the high-level commander
    def stop(self) -> None: ...  # motors off now


# --- abilities that some links have -------------------------------------------------------------------------------


@runtime_checkable
class StreamingLink(Protocol):
    """A link to a drone that sends messages, not single variables on request."""

    on_frame: Callable[[float, bytes], None] | None  # called with (host time [s], frame) for every sound frame

    def start_streams(self, rate_hz: float) -> tuple[Block, ...]: ...  # raises LinkError


@runtime_checkable
class ReconnectingLink(Protocol):
    """A link that can reconnect to the same drone after a `LinkLost`."""

    @property
    def can_reconnect(self) -> bool: ...
    def reconnect(self, timeout: float = 5.0, abort: threading.Event | None = None) -> Outage: ...  # raises LinkError


@runtime_checkable
class ClockedLink(Protocol):
    """A link that relates the host's clock to the drone's; None before the first packet."""

    def clock(self) -> ClockFit | None: ...


@runtime_checkable
class HostClockLink(Protocol):
    """A link whose `Packet.host_time` comes from this clock [s], not from `time.time()`: simulated time."""

    def host_clock(self) -> float: ...


@runtime_checkable
class AccountingLink(Protocol):
    """A link with more information about lost bytes than `LinkStatistics`."""

    def account(self) -> Mapping[str, str]: ...


@runtime_checkable
class DescribingLink(Protocol):
    """A link whose firmware gives a description of itself, in sections for a recording."""

    @property
    def about(self) -> Mapping[str, Mapping[str, str]]: ...


@runtime_checkable
class ConfirmingLink(Protocol):
    """A link that repeats a command to land until the drone confirms it; False after `timeout` [s]."""

    def land_and_confirm(self, height: float, duration: float, *, timeout: float) -> bool: ...


@runtime_checkable
class HoverThrustLink(Protocol):
    """A link to an autopilot with a parameter for hover thrust instead of mass.

    `hover_parameter` is "" if none is known. `onboard_hover_estimator` describes an onboard estimator that also writes
    this parameter, "" if there is none. `cells` is the number of battery cells, 0 if unknown.
    """

    @property
    def hover_parameter(self) -> str: ...
    @property
    def onboard_hover_estimator(self) -> str: ...
    @property
    def cells(self) -> int: ...
    def read_parameter(self, name: str, timeout: float = 2.0) -> float: ...
