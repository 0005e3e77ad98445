"""Views of a running session as frozen values, and the actions of a user on it."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from crazyem.live.scheduler import UpdateThrottle
from crazyem.live.session import Session

TREND_SECONDS = 60.0  # s of estimates in a trend
TREND_POINTS = 24  # points of a trend
NOT_PUSHED = "no guard: nothing is written"
USER_MARK = "user_"  # name of marks by the user, followed by a number

# parameter -> label, unit, factor
SHOWN_PARAMETERS = (
    ("mass", "mass", "g", 1e3),
    ("Ixx", "Ixx", "10⁻⁶ kg m²", 1e6),
    ("Iyy", "Iyy", "10⁻⁶ kg m²", 1e6),
    ("Izz", "Izz", "10⁻⁶ kg m²", 1e6),
    ("motor_time_constant", "motor lag", "ms", 1e3),
)


@dataclass(frozen=True, slots=True)
class ParameterView:
    """One parameter in its displayed unit; low, high: 95 % interval; trend: values over the last minute."""

    label: str
    unit: str
    value: float
    low: float
    high: float
    identifiable: bool
    reason: str
    trend: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class LinkView:
    """Packets per second, share lost over the last second, totals, median round trip [s], largest median delay [s]."""

    rate: float = math.nan
    loss: float = math.nan
    lost: int = 0
    late: int = 0
    round_trip: float = math.nan
    delay: float = math.nan
    outages: int = 0
    gone: bool = False


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A drone at one moment.

    Attributes:
        name: of the drone. uri: of its link.
        phase: of the flight; seconds: in this phase. ended: why the flight is over, "" before its end.
        parameters: newest estimate, empty before the first.
        guard: its mode; decision: the last writes, or why there are none; paused: by the user; stopped: why, for good.
        pushes: time [s], parameter, value, verified, purpose; the newest is last.
        alarms: problems, the most urgent first.
        voltage: V. height: m. behind: s, delay of the estimator. skipped: its skipped updates. marks: by the user.
    """

    name: str
    uri: str = ""
    phase: str = ""
    seconds: float = 0.0
    ended: str = ""
    parameters: tuple[ParameterView, ...] = ()
    updates: int = 0
    converged: bool = False
    airborne: bool = False
    link: LinkView = field(default_factory=LinkView)
    guard: str = ""
    decision: str = ""
    paused: bool = False
    stopped: str = ""
    pushes: tuple[tuple[float, str, float, bool, str], ...] = ()
    writes: int = 0
    alarms: tuple[str, ...] = ()
    voltage: float = math.nan
    height: float = math.nan
    behind: float = 0.0
    skipped: int = 0
    marks: int = 0


class Observer:
    """Takes snapshots of a session; reads only, from any thread, without a lock.

    Args:
        session: running, or not yet started.
        phase: gives the phase of the flight and the seconds in it.
        ended: gives why the flight is over, "" before its end.
    """

    def __init__(
        self, session: Session, *, name: str, phase: Callable[[], tuple[str, float]],
        ended: Callable[[], str] = lambda: "",
    ) -> None:  # fmt: skip
        self.session, self.name = session, name
        self._phase, self._ended = phase, ended
        self._counted: tuple[float, int, int] | None = None
        self._link = LinkView()

    def snapshot(self) -> Snapshot:
        """The drone now."""
        session = self.session
        history, estimate = session.history, session.estimate
        phase, seconds = self._phase()
        account: Any = history.guard
        pushes = history.pushes[-3:]
        supervisor, estimator = session.write_supervisor, session.pipeline.estimator
        throttle = estimator if isinstance(estimator, UpdateThrottle) else None
        decision = session.pipeline.decision
        return Snapshot(
            name=self.name,
            uri=session.link.uri,
            phase=phase,
            seconds=seconds,
            ended=self._ended(),
            parameters=self._parameters(),
            updates=estimate.updates if estimate is not None else 0,
            converged=estimate.converged if estimate is not None else False,
            airborne=bool(estimator.airborne),
            link=self._link_view(),
            guard=str(account.get("mode", "")) if account else "",
            decision=str(decision) if decision is not None else "",
            paused=session.pipeline.paused,
            stopped=supervisor.guard.stopped if supervisor is not None else "",
            pushes=tuple((p.time, p.parameter, p.value, p.verified, p.purpose) for p in pushes),
            writes=len(history.pushes),
            alarms=self._alarms(),
            voltage=session.telemetry.voltage,
            height=session.telemetry.height,
            behind=throttle.behind if throttle is not None else 0.0,
            skipped=throttle.skipped if throttle is not None else 0,
            marks=sum(name.startswith(USER_MARK) for name in tuple(history.marks)),
        )

    def _parameters(self) -> tuple[ParameterView, ...]:
        estimates = self.session.history.estimates
        count = len(estimates)
        if not count or not estimates[count - 1].parameters:
            return ()
        newest = estimates[count - 1]
        # Evenly over the minute; the list only grows (thinning makes a new list), so these indices stay valid.
        span = min(count, round(TREND_SECONDS * 25))
        first = count - span
        chosen = sorted({first + (span - 1) * i // max(TREND_POINTS - 1, 1) for i in range(TREND_POINTS)})
        views = []
        for name, label, unit, factor in SHOWN_PARAMETERS:
            p = newest.parameters.get(name)
            if p is None:
                continue
            trend = [estimates[i].parameters[name] for i in chosen if name in estimates[i].parameters]
            views.append(
                ParameterView(
                    label, unit, p.value * factor, p.ci95[0] * factor, p.ci95[1] * factor, p.identifiable, p.reason,
                    tuple(t.value * factor for t in trend if math.isfinite(t.value)),
                )
            )  # fmt: skip
        return tuple(views)

    def _link_view(self) -> LinkView:
        """Statistics of the link, computed once a second because counting takes time."""
        now = time.monotonic()
        if self._counted is not None and now - self._counted[0] < 1.0:
            return self._link
        s = self.session.link.statistics()
        rate = loss = math.nan
        if self._counted is not None:
            received, lost = s.received - self._counted[1], max(s.lost - self._counted[2], 0)
            rate = received / (now - self._counted[0])
            loss = lost / (received + lost) if received + lost > 0 else math.nan
        self._counted = (now, s.received, s.lost)
        delay = max((median for median, _ in s.delays.values()), default=math.nan)
        gone = self.session.reconnecting or self.session.lost is not None
        self._link = LinkView(rate, loss, s.lost, s.late, s.round_trip, delay, s.outages, gone)
        return self._link

    def _alarms(self) -> tuple[str, ...]:
        session, history = self.session, self.session.history
        alarms = []
        if session.failure is not None:
            alarms.append(str(session.failure))
        if session.lost is not None:
            alarms.append(session.lost_sentence())
        elif session.reconnecting:
            alarms.append("the link is lost and being brought back")
        if history.faults:
            alarms.append(str(history.faults[-1]))
        grounded = session.telemetry.grounded_reason()
        if grounded:
            alarms.append(grounded)
        if session.recorder is not None and session.recorder.failure:
            alarms.append(session.recorder.failure)
        return (*alarms, *reversed(session.history.notices[-4:]))


class SessionControls:
    """Actions on one drone; every method returns at once with one sentence about its effect. Called from one thread.

    Args:
        land: makes the flight land; None if another program flies the drone.
    """

    def __init__(self, session: Session, *, name: str, land: Callable[[], None] | None = None) -> None:
        self.session, self.name = session, name
        self._land = land

    def toggle_push(self) -> str:
        """Switch pushing off or on; earlier writes are still judged."""
        pipeline = self.session.pipeline
        if self.session.write_supervisor is None:
            return f"{self.name}: nothing is pushed in this session."
        pipeline.paused = not pipeline.paused
        state = "off" if pipeline.paused else "on"
        self.session.record_event(f"guard: pushing switched {state} by the user")
        return f"{self.name}: pushing is {state}."

    def revert(self) -> str:
        """See `WriteSupervisor.revert_on_request`."""
        if self.session.write_supervisor is None:
            return f"{self.name}: nothing was written in this session."
        return f"{self.name}: {self.session.write_supervisor.revert_on_request()}"

    def mark(self) -> str:
        """Add an event to the recording and a mark to the summary."""
        time = self.session.clock.newest
        if not math.isfinite(time):
            return f"{self.name}: nothing was received yet."
        number = 1 + sum(name.startswith(USER_MARK) for name in tuple(self.session.history.marks))
        self.session.mark(f"{USER_MARK}{number}", time)
        where = "" if self.session.recorder is not None else " (there is no recording)"
        return f"{self.name}: mark {number} at {time:.2f} s{where}."

    def land(self) -> str:
        """Land this drone only (a first Ctrl-C lands all of them)."""
        if self._land is None:
            return f"{self.name}: somebody else flies it."
        self._land()
        return f"{self.name}: landing."
