"""Writes the guard's decisions to the drone in a thread of its own, and keeps account of every echo.

Every packet with a value passes the write gate, the repetitions included: an attempt sends one packet.
"""

import math
import queue
import threading
import time as clock
from collections.abc import Callable, Mapping, Sequence

from crazyem.errors import CrazyemError
from crazyem.links.base import Link, ParameterWrite
from crazyem.live.controllers import CONTROLLERS, Controller, for_vehicle, with_drag, without_target, writes_back
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History, Push
from crazyem.live.write_gate import WriteGate
from crazyem.vehicle import Vehicle

ONBOARD_DRAG = ("kalman.dragB_x", "kalman.dragB_y")
WRITE_TIMEOUT = 0.3  # s; an echo takes 2 to 30 ms on a working link, and the link does not send again so soon
RETRY_PAUSE = 0.1  # s before the next attempt: a link that refuses at once is known as lost a little later
WRITE_ATTEMPTS = 9  # of a write, 3.6 s in all: an outage is noticed within 2 s, and attempts during it do not count
TELEMETRY_POLL = 0.01  # s between looks for fresh telemetry


def push_target(link: Link, vehicle: Vehicle) -> tuple[Controller | None, str]:
    """Where estimates can be pushed to on this drone now, or None and one sentence why not."""
    number = int(link.read_parameter("stabilizer.controller"))  # freshly read: the firmware may overrule
    plain = CONTROLLERS.get(number)
    if plain is None:
        return None, without_target(number)
    controller = for_vehicle(plain, vehicle)
    if isinstance(controller, str):
        return None, f"{controller}, estimates are not pushed."
    if set(ONBOARD_DRAG) <= set(link.parameters):
        controller = with_drag(controller)
    missing = [p for p in controller.parameters if p not in link.parameters]
    if missing:
        return None, f"the drone has no parameter {missing[0]}: estimates are not pushed."
    return controller, controller.note


def read_originals(link: Link, controller: Controller) -> dict[str, float]:
    """The values of every parameter a push may write, as the drone has them now."""
    return {name: link.read_parameter(name) for name in controller.parameters}


def nominal_estimates(vehicle: Vehicle, controller: Controller) -> dict[str, float]:
    """What the vehicle file says of everything that may be pushed [SI]: the centre of the allowed ranges."""
    values = (vehicle.mass, *vehicle.inertia, vehicle.motor_time_constant)
    return dict(zip(("mass", "Ixx", "Iyy", "Izz", "motor_time_constant"), values)) | dict(controller.known)


class Pusher:
    """One thread, one write at a time, in the order decided.

    A write that is not confirmed is tried again, after an outage once the link is back: writing the same value twice
    does no harm. If it stays unconfirmed, the set it belongs to is undone as far as the drone still answers, because a
    set must not stay half written, and all pushing ends. A set of which the gate lets nothing pass is dropped, and the
    guard decides anew.

    Args:
        link: to the drone.
        guard: told to stop when a write is not confirmed.
        gate: asked before every single packet.
        history: keeps every write.
        on_write: called with every write (recording).
        wait_for_link: waits while the link is being brought back; False if it is lost for good.
        outages: how often the link was lost so far, the present time included.
        known: what the drone holds, by parameter, as read at connect. Without it nothing can be undone.
        on_done: called after each decision with it and one clause why not all of it is in the drone, "" if it is.
    """

    def __init__(
        self,
        link: Link,
        guard: Guard,
        *,
        gate: WriteGate,
        history: History,
        on_write: Callable[[ParameterWrite], None] | None = None,
        timeout: float = WRITE_TIMEOUT,
        wait_for_link: Callable[[], bool] | None = None,
        outages: Callable[[], int] | None = None,
        known: Mapping[str, float] | None = None,
        on_done: Callable[[Decision, str], None] | None = None,
    ) -> None:
        self.link = link
        self.guard = guard
        self.gate = gate
        self.history = history
        self.on_write = on_write
        self.timeout = timeout
        self.wait_for_link = wait_for_link or (lambda: True)
        self.outages = outages or (lambda: 0)
        self.known = dict(known or {})
        self.on_done = on_done or (lambda decision, why: None)
        self._pending = 0
        self._lock = threading.Lock()
        self._queue: queue.SimpleQueue[Decision | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="crazyem-push", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether something is queued or being written."""
        return self._pending > 0

    def submit(self, decision: Decision) -> None:
        """Queue a decision's writes; returns at once. Of a revert or restore only what differs is written."""
        with self._lock:
            self._pending += 1
        self._queue.put(decision)

    def close(self) -> None:
        """Finish the set that is being written and a restore that is queued, then end; bounded by the time that one
        write and its undoing may take."""
        self._queue.put(None)
        self._thread.join(timeout=2 * WRITE_ATTEMPTS * (self.timeout + 2 * RETRY_PAUSE) + 1.0)
        if self._thread.is_alive():
            self.history.notice("parameter writes were still waiting for the drone when the session ended.")

    def _run(self) -> None:
        while (decision := self._queue.get()) is not None:
            why = ""
            try:
                why = self._push(decision) if decision.kind == "push" else self._write_back(decision)
            except Exception as error:  # a fault of ours: what it leaves is not known, so nothing more is pushed
                why = f"pushing failed: {error!r}"
                self.guard.stop(why)
                self.history.notice(f"{why}: nothing more is pushed.")
            finally:
                with self._lock:
                    self._pending -= 1
            self.on_done(decision, why)

    def _push(self, decision: Decision) -> str:
        """Why not all of a set was confirmed, "" if it was; what was begun is completed or undone."""
        if self.guard.stopped:
            return self.guard.stopped
        before = dict(self.known)
        for i, (name, value) in enumerate(decision.writes):
            why, sent = self._write(decision.time, name, value, patient=i > 0)
            if not why:
                continue
            if not sent and i == 0:
                self.guard.withdraw()
                return why
            told = "confirmed" if sent else "sent"
            sentence = f"the write of {name} = {value:.6g} was not {told} ({why}): nothing more is pushed."
            self.guard.stop(sentence)
            self.history.notice(sentence)
            self._undo(decision, before, touched=[n for n, _ in decision.writes[: i + sent]])
            return why
        return ""

    def _undo(self, decision: Decision, before: Mapping[str, float], *, touched: Sequence[str]) -> None:
        """Back to the values before the set, one that was not confirmed included: it may have arrived."""
        if not all(name in before for name in touched):
            return
        lost = [name for name in touched if math.isnan(self.known[name])]
        # For the order it counts as written; the way back is then the way there, reversed.
        now = {**self.known, **{name: dict(decision.writes)[name] for name in lost}}
        target = {name: before[name] for name in touched}
        for name, value in writes_back(self.guard.controller, target, now=now, uncertain=lost):
            if self._put_back(decision, name, value, purpose="undo"):
                return
        self.history.notice("the set of parameters it belongs to was undone.")

    def _write_back(self, decision: Decision) -> str:
        """Why the drone does not hold the values of a revert or restore, "" if it does."""
        target = dict(decision.writes)
        for name, value in writes_back(self.guard.controller, target, now=self.known):
            if why := self._put_back(decision, name, value, purpose=decision.kind):
                return why
        return ""

    def _put_back(self, decision: Decision, name: str, value: float, *, purpose: str) -> str:
        """Why a value was not put back, "" if it was."""
        why, sent = self._write(decision.time, name, value, purpose=purpose)
        if why:
            held = self.known.get(name, math.nan)
            left = "what the drone holds is not known" if sent or math.isnan(held) else f"it stays {held:.6g}"
            sentence = f"{name} = {value:.6g} could not be written back ({why}): {left}."
            self.guard.stop(sentence)
            self.history.notice(sentence)
        return why

    def _write(
        self, time: float, name: str, value: float, *, purpose: str = "push", patient: bool = True
    ) -> tuple[str, bool]:
        """Why a write was not confirmed, "" if it was, and whether a packet may have left.

        `patient`: wait for telemetry that is not fresh; else such a write is not begun.
        """
        why, sent, failed = "no echo came", False, 0
        for attempt in range(2 * WRITE_ATTEMPTS):
            if attempt:
                clock.sleep(RETRY_PAUSE)
                if not self.wait_for_link():
                    break
            outages = self.outages()
            refused, final = self._refused(purpose, patient=patient or sent)
            if refused:
                why = refused
                if final:
                    break
            else:
                sent = True
                why = self._attempt(name, value)
            # One during which the link was lost was none: an outage is noticed two seconds after its last packet.
            failed += self.outages() == outages
            if not why or failed == WRITE_ATTEMPTS:
                break
        if sent:
            self.history.pushes.append(Push(time, name, value, not why, purpose))
            if name in self.known:
                self.known[name] = math.nan if why else value
        return why, sent

    def _refused(self, purpose: str, *, patient: bool) -> tuple[str, bool]:
        """Why the gate does not let a write pass, "" if it does, and whether that is final."""
        until = clock.monotonic() + self.timeout
        while (why := self.gate.stale()) and patient and clock.monotonic() < until:
            clock.sleep(TELEMETRY_POLL)
        if why:
            return why, not patient
        why = self.gate.misplaced(purpose)
        return why, bool(why)

    def _attempt(self, name: str, value: float) -> str:
        """Send it once; "" if the drone confirmed it, else why not."""
        try:
            write = self.link.write_parameter(name, value, timeout=self.timeout)
        except Exception as error:  # a fault of ours ends the pushing, not the flight; the sentence names it
            # of the write nothing is known: its packet may have left before the link failed
            self._record(ParameterWrite(name, value, None, False, clock.time()))
            return (str(error) or type(error).__name__) if isinstance(error, CrazyemError) else repr(error)
        self._record(write)
        if write.verified:
            return ""
        return "no echo came" if write.echoed is None else f"the drone echoed {write.echoed:.6g}"

    def _record(self, write: ParameterWrite) -> None:
        try:
            if self.on_write is not None:
                self.on_write(write)
        except Exception as error:  # the set is completed, but nothing is written that cannot be recorded
            self.guard.stop(f"a write could not be recorded: {error!r}")
            self.history.notice(f"a write could not be recorded ({error!r}): nothing more is pushed.")
