"""Writes the guard's decisions to the drone in a thread of its own, and keeps account of every echo."""

import math
import queue
import threading
import time as clock
from collections.abc import Callable, Mapping, Sequence

from crazyem.errors import CrazyemError
from crazyem.links.base import Link, ParameterWrite
from crazyem.live.controllers import CONTROLLERS, Controller, without_target, writes_back
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History, Push

WRITE_TIMEOUT = 1.0  # s; an echo takes 2 to 30 ms on a working link, and the link asks again three times
MOMENT = 0.2  # s before the next attempt: a link that refuses at once is known as lost a little later
ATTEMPTS = 3  # of a write: what was lost in an outage is written again when the link is back


def running_controller(link: Link) -> int:
    """Number of the controller that really runs (stabilizer.controller, freshly read; the firmware may overrule)."""
    return int(link.read_parameter("stabilizer.controller"))


def push_target(link: Link) -> tuple[Controller | None, str]:
    """Where estimates can be pushed to on this drone now, or None and one sentence why not."""
    number = running_controller(link)
    controller = CONTROLLERS.get(number)
    if controller is None:
        return None, without_target(number)
    missing = [p for p in controller.parameters if p not in link.parameters]
    if missing:
        return None, f"the drone has no parameter {missing[0]}: estimates are not pushed."
    return controller, controller.note


def read_originals(link: Link, controller: Controller) -> dict[str, float]:
    """The values of every parameter a push may write, as the drone has them now."""
    return {name: link.read_parameter(name) for name in controller.parameters}


class Pusher:
    """One thread, one write at a time, in the order decided.

    A write that is not confirmed is tried again, after an outage once the link is back: writing the same value twice
    does no harm. If it stays unconfirmed, the set it belongs to is undone as far as the drone still answers, because a
    set must not stay half written, and all pushing ends.

    Args:
        link: to the drone.
        guard: told to stop when a write is not confirmed.
        history: keeps every write.
        on_write: called with every write (recording).
        wait_for_link: waits while the link is being brought back; False if it is lost for good.
        outages: how often the link was lost so far, the present time included.
        known: what the drone holds, by parameter, as read at connect. Without it nothing can be undone.
        on_done: called with (decision, whether all of it was confirmed) after each decision.
    """

    def __init__(
        self,
        link: Link,
        guard: Guard,
        *,
        history: History,
        on_write: Callable[[ParameterWrite], None] | None = None,
        timeout: float = WRITE_TIMEOUT,
        wait_for_link: Callable[[], bool] | None = None,
        outages: Callable[[], int] | None = None,
        known: Mapping[str, float] | None = None,
        on_done: Callable[[Decision, bool], None] | None = None,
    ) -> None:
        self.link = link
        self.guard = guard
        self.history = history
        self.on_write = on_write
        self.timeout = timeout
        self.wait_for_link = wait_for_link or (lambda: True)
        self.outages = outages or (lambda: 0)
        self.known = dict(known or {})
        self.on_done = on_done or (lambda decision, complete: None)
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
        """Finish what is queued, then end; bounded by the time one write and its undoing may take."""
        self._queue.put(None)
        self._thread.join(timeout=2 * ATTEMPTS * (self.timeout + 2 * MOMENT) + 1.0)
        if self._thread.is_alive():
            self.history.notice("parameter writes were still waiting for the drone when the session ended.")

    def _run(self) -> None:
        while (decision := self._queue.get()) is not None:
            complete = False
            try:
                complete = self._push(decision) if decision.kind == "push" else self._write_back(decision)
            except Exception as error:  # a fault of ours: what it leaves is not known, so nothing more is pushed
                self.guard.stop(f"pushing failed: {error!r}")
                self.history.notice(f"pushing failed: {error!r}: nothing more is pushed.")
            finally:
                with self._lock:
                    self._pending -= 1
            self.on_done(decision, complete)

    def _push(self, decision: Decision) -> bool:
        """Whether all of a set was confirmed; what was begun is completed or undone."""
        if self.guard.stopped:
            return False
        before = dict(self.known)
        for i, (name, value) in enumerate(decision.writes):
            if not self._write(decision.time, name, value):
                self._undo(decision, before, touched=[n for n, _ in decision.writes[: i + 1]])
                return False
        return True

    def _undo(self, decision: Decision, before: Mapping[str, float], *, touched: Sequence[str]) -> None:
        """Back to the values before the set, the one that was not confirmed included: it may have arrived."""
        if not all(name in before for name in touched):
            return
        lost = touched[-1]
        # For the order it counts as written; the way back is then the way there, reversed.
        now = {**self.known, lost: dict(decision.writes)[lost]}
        target = {name: before[name] for name in touched}
        for name, value in writes_back(self.guard.controller, target, now=now, uncertain=(lost,)):
            if not self._write(decision.time, name, value, purpose="undo"):
                return
        self.history.notice("the set of parameters it belongs to was undone.")

    def _write_back(self, decision: Decision) -> bool:
        """Whether the drone holds the values of a revert or restore."""
        target = dict(decision.writes)
        for name, value in writes_back(self.guard.controller, target, now=self.known):
            if not self._write(decision.time, name, value, purpose=decision.kind):
                return False
        return True

    def _write(self, time: float, name: str, value: float, *, purpose: str = "push") -> bool:
        verified, why, failed = False, "no echo came", 0
        for attempt in range(2 * ATTEMPTS):
            if attempt:
                clock.sleep(MOMENT)
                if not self.wait_for_link():
                    break
            outages = self.outages()
            verified, why = self._attempt(name, value)
            # One during which the link was lost was none: an outage is noticed two seconds after its last packet.
            failed += self.outages() == outages
            if verified or failed == ATTEMPTS:
                break
        self.history.pushes.append(Push(time, name, value, verified, purpose))
        if name in self.known:
            self.known[name] = value if verified else math.nan
        if not verified:
            sentence = f"the write of {name} = {value:.6g} was not confirmed ({why}): nothing more is pushed."
            self.guard.stop(sentence)
            if purpose != "push":
                sentence = f"{name} = {value:.6g} could not be written back ({why}): what the drone holds is not known."
            self.history.notice(sentence)
        return verified

    def _attempt(self, name: str, value: float) -> tuple[bool, str]:
        """Whether the drone confirmed it, else why not."""
        try:
            write = self.link.write_parameter(name, value, timeout=self.timeout)
        except CrazyemError as error:
            self._record(self._unconfirmed(name, value))
            return False, str(error)
        except Exception as error:  # a fault of ours ends the pushing, not the flight; the sentence names it
            self._record(self._unconfirmed(name, value))
            return False, repr(error)
        self._record(write)
        return write.verified, "no echo came" if write.echoed is None else f"the drone echoed {write.echoed:.6g}"

    @staticmethod
    def _unconfirmed(name: str, value: float) -> ParameterWrite:
        """A write of which nothing is known: its packet may have left before the link failed."""
        return ParameterWrite(name, value, None, False, clock.time())

    def _record(self, write: ParameterWrite) -> None:
        try:
            if self.on_write is not None:
                self.on_write(write)
        except Exception as error:  # the set is completed, but nothing is written that cannot be recorded
            self.guard.stop(f"a write could not be recorded: {error!r}")
            self.history.notice(f"a write could not be recorded ({error!r}): nothing more is pushed.")
