"""Supervision of writes to a flying drone: guard, health, confirmation, judgement after a write, and their account.

The pipeline calls `consider` after every estimate, and the pusher writes the decision; a dry run only records it. The
judgement after a write runs with the packets, not with the estimates, so a stalled estimator does not stop it.
"""

import math
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from crazyem.control.indi import IndiResponse
from crazyem.estimation.drag import DragRegression
from crazyem.estimation.result import Estimate, Step
from crazyem.live.controllers import EQUAL_WITHIN, writes_back
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History
from crazyem.live.policy import WriteRules
from crazyem.live.post_write_monitor import PostWriteMonitor
from crazyem.live.push import Pusher
from crazyem.live.write_gate import WriteGate
from crazyem.signals.sample import Sample

# s, 4 Hz, second order: with too high a loop gain INDI oscillates with 7 to 12 Hz; an excitation has 1 to 4 Hz.
INDI_HIGH_PASS, INDI_HIGH_PASS_ORDER = 0.04, 2
MONITOR_PERIOD = 0.04  # s between judgements
GROUNDED_WITHIN = 3.0  # s, longest wait for the ground: the firmware reports a flight for 2 s after the motors stop
HOLD_NOTE_PERIOD = 1.0  # s, shortest time between two notes about the reason why nothing is written
MOST_ACCOUNT_ENTRIES = 5000  # most entries of the account: bounds the memory


class WriteSupervisor:
    """Supervisor of writes, see the module. The receiving thread calls `take`, the estimating thread `consider`.

    Args:
        guard: decides by the estimates.
        originals: parameter values at connect.
        history: gets notices and the account.
        gate: check of every write before it is sent; also used here, to avoid decisions that it would refuse.
        now: newest time on the drone's clock, s.
        residual: time [s], innovations and their standard deviations of the newest sample, or None.
        enabled: whether a time [s] is in a phase of the flight with pushes.
        fault: why the model of the flight does not hold at a time [s], "" if it holds.
        record: takes a line for the recording.
    """

    def __init__(
        self,
        guard: Guard,
        rules: WriteRules,
        *,
        originals: Mapping[str, float],
        history: History,
        gate: WriteGate,
        now: Callable[[], float],
        residual: Callable[[], Any] = lambda: None,
        enabled: Callable[[float], bool] = lambda time: True,
        fault: Callable[[float], str] = lambda time: "",
        record: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.guard, self.rules = guard, rules
        self.originals, self.good = dict(originals), dict(originals)
        self.history, self.now, self.record = history, now, record
        self.gate = gate
        limits = rules.policy.watch
        if guard.controller.incremental:
            limits = replace(
                limits,
                oscillation=limits.incremental_oscillation,
                lead=0.0,
                high_pass=INDI_HIGH_PASS,
                high_pass_order=INDI_HIGH_PASS_ORDER,
            )
        self.watch = PostWriteMonitor(limits, IndiResponse() if guard.controller.incremental else None)
        self.drag = DragRegression()
        guard.capped = rules.policy.watch.enabled and not rules.dry_run
        self.pusher: Pusher | None = None
        self._residual, self._enabled, self._fault = residual, enabled, fault
        self._airborne = self._reverted = self._owed = self._restarted = False
        self._monitor_time = -math.inf
        self._residual_time = -math.inf
        self._held = ("", -math.inf)
        self._allowed = rules.confirm is None or rules.dry_run
        self._confirmation: threading.Thread | None = None
        self._ended = threading.Event()
        self._reported_stop = ""
        self._stopped: str | None = None
        self._lock = threading.Lock()
        self.entries: list[dict[str, Any]] = []
        history.guard = {"mode": rules.mode, "policy": rules.policy.name, "decisions": self.entries}
        record(f"guard: {rules.mode}, policy {rules.policy.name}")

    def take(self, samples: Sequence[Sample]) -> None:
        """Process samples as they arrive; reverts writes that made the flight worse."""
        for sample in samples:
            self.gate.take(sample)
            self.watch.take(sample)
        with self._lock:
            for sample in samples:
                self.drag.feed(sample, airborne=self._airborne)
        newest = self.watch.newest
        if self.watch.judging and newest - self._monitor_time >= MONITOR_PERIOD:
            self._monitor_time = newest
            if self._airborne and self._enabled(newest):
                self._judge(newest)

    def consider(self, estimate: Estimate, time: float, *, airborne: bool, enabled: bool = True) -> Decision:
        """The decision after an estimate; see `Guard.consider`."""
        self._innovations()
        self._airborne = airborne
        with self._lock:
            estimate = replace(estimate, parameters={**estimate.parameters, **self.drag.estimates()})
        decision = self.guard.consider(estimate, time, airborne=airborne, enabled=enabled, objection=self._hold(time))
        if self.guard.stopped and self.guard.stopped != self._reported_stop:
            self._reported_stop = self.guard.stopped
            self._enter("stopped", time, reason=self.guard.stopped)
        if not decision.writes:
            self._note_hold(decision)
            return decision
        if not self._allowed:
            self.guard.withdraw()
            self._start_confirmation(decision)
            return Decision(time, reason="waits for confirmation")
        if self.rules.dry_run:
            self._enter("would write", time, writes=decision.writes, reason=decision.why)
            return Decision(time, reason=f"dry run: would write {decision}")
        self._enter("write", time, writes=decision.writes, reason=decision.why)
        return decision

    def on_mass_step(self, step: Step, time: float) -> None:
        """A change of mass was detected, or its cause is now known, at `time` [s] (in the estimating thread)."""
        self.guard.on_mass_step(step)
        self.watch.on_mass_step(began=step.time, now=time, real=step.real)

    def on_written(self, decision: Decision, why: str) -> None:
        """The pusher has finished a decision (in its thread); `why` it is not complete in the drone, "" if it is."""
        if decision.kind == "push" and not why:
            self.watch.on_write(decision.time, max(self.now(), decision.time))
        self._owed = bool(why) if decision.kind == "revert" else self._owed
        reason = f"{decision.kind}: {why}" if why else decision.kind
        self._enter("not written" if why else "written", self.now(), reason=reason)

    def revert_on_request(self) -> str:
        """Revert to the last good values for the user; if the drone has these, to the values at connect.

        Nothing more is pushed in this flight. Returns one sentence about the effect.
        """
        if self.pusher is None or not self.history.pushes:
            return "nothing was written to this drone: there is nothing to take back."
        if self._reverted:
            return "it was taken back already."
        known = self.pusher.known
        if all(math.isclose(known[name], value, rel_tol=EQUAL_WITHIN) for name, value in self.good.items()):
            self.good = dict(self.originals)
        return self._revert(self.now(), "asked for by the user", asked=True)

    def stop(self, *, motors_cut: bool = False) -> None:
        """Write no new set from now on; this is the first step of every end of a flight.

        motors_cut: do not complete a set either, even if telemetry still shows a flight.
        """
        self.gate.motors_cut |= motors_cut
        self._ended.set()
        if self._stopped is None:
            self._stopped = self.guard.stopped  # the end of the flight itself is not reported as a reason
        self.guard.stop("the flight is over")
        self._reported_stop = self.guard.stopped

    def on_restart(self) -> None:
        """The firmware has restarted: written values are lost, unless the controller's parameters are persistent."""
        if self.pusher is None or not self.history.pushes or self.guard.controller.persistent:
            return
        self._restarted = True
        self.pusher.known = dict.fromkeys(self.pusher.known, math.nan)
        self._say("the firmware was restarted and holds the values of its start again, nothing of what was written.")

    def end(self, outcome: str) -> None:
        """The flight is over: keep the written values or restore old ones, by the policy for this outcome.

        A revert that the gate refused in flight is done here: values that made the flight worse are not kept.

        Args:
            outcome: landed, interrupted, failed or link_lost.
        """
        self.stop()
        if self.pusher is None or not self.history.pushes or self._restarted:
            return
        rule = getattr(self.rules.policy.end, outcome)
        rule = "good" if rule == "keep" and self._owed else rule
        if rule == "keep":
            return
        target = self.good if rule == "good" else self.originals
        # The pusher finishes earlier decisions first, and does not write values again that are right by then.
        values = "the values at connect" if rule == "restore" else "the last values judged good"
        until = time.monotonic() + GROUNDED_WITHIN
        while not self.gate.stale() and self.gate.misplaced("restore") and time.monotonic() < until:
            time.sleep(0.01)
        if why := self.gate.objection("restore"):
            self._say(f"{values} were not written back: {why}.")
            return
        self._enter("restore", self.now(), writes=tuple(target.items()), reason=f"{outcome}: {rule}")
        self.pusher.submit(Decision(self.now(), writes=tuple(target.items()), reason=rule, kind="restore"))

    def close(self) -> None:
        """After the end of the pusher: complete the account, and report whether a restore succeeded."""
        self._ended.set()
        account = self.history.guard
        account["stopped"] = self.guard.stopped if self._stopped is None else self._stopped
        account["at_connect"] = dict(self.originals)
        account["in_drone"] = dict(self.pusher.known) if self.pusher is not None else dict(self.originals)
        asked = next((e for e in reversed(self.entries) if e["action"] == "restore"), None)
        if asked is not None:
            left = [n for n, v in asked["writes"] if not math.isclose(account["in_drone"][n], v, rel_tol=1e-6)]
            until = "" if self.guard.controller.persistent else " until it is restarted"
            self._say(
                f"{', '.join(left)} could not be put back: the drone may keep what was pushed{until}."
                if left
                else f"the parameters were put back ({asked['reason']})."
            )

    # parts

    def _innovations(self) -> None:
        newest = self._residual()
        if newest is None or not newest[0] > self._residual_time:
            return
        self._residual_time = newest[0]
        squares = [(e / s) ** 2 for e, s in zip(newest[1], newest[2]) if s > 0 and math.isfinite(e)]
        if squares:
            self.watch.innovation(newest[0], float(sum(squares) / len(squares)))

    def _hold(self, time: float) -> str:
        if fault := self._fault(time):
            return fault
        if self.pusher is not None and self.pusher.busy:
            return "the last set is still being written"
        if self._confirmation is not None and not self._allowed:
            return "waits for confirmation"
        if self.watch.full:
            return "what was written is still being judged"
        return self.gate.health_objection(age=self.now() - time) or self.gate.objection("push")

    def _judge(self, time: float) -> None:
        if self.pusher is None or self.pusher.busy or self._reverted or self._ended.is_set():
            return
        verdict, why = self.watch.judge(time)
        if verdict == "good":
            self.good = dict(self.pusher.known)
            self.guard.trust()
            self.watch.forget()
            self._enter("judged good", time, reason=why)
        elif verdict == "worse":
            self._revert(time, why)

    def _revert(self, time: float, why: str, *, asked: bool = False) -> str:
        assert self.pusher is not None
        self._reverted = True
        wrong = dict(self.pusher.known)
        back = writes_back(self.guard.controller, self.good, now=wrong)
        undone = ", ".join(f"{n} = {wrong[n]:.6g}" for n, _ in back)
        sentence = f"the drone flew worse after {undone} ({why}): back to the last good values, nothing more is pushed."
        if asked:
            sentence = f"{undone} taken back as asked, nothing more is pushed."
        self.guard.stop(sentence)
        self._reported_stop = self.guard.stopped
        self.history.notice(sentence)
        self._enter("revert", time, writes=back, reason=why)
        self.watch.forget()
        # All good values, so that a set submitted at this moment is reverted as well.
        kind = "restore" if asked and not self.gate.telemetry.airborne else "revert"  # the user may ask on the ground
        self.pusher.submit(Decision(time, writes=tuple(self.good.items()), reason=sentence, kind=kind))
        return sentence

    def _start_confirmation(self, decision: Decision) -> None:
        question = f"first write to the drone: {decision}"
        self._enter("asked", decision.time, writes=decision.writes)
        self._confirmation = threading.Thread(
            target=self._await_confirmation, args=(question,), name="crazyem-confirm", daemon=True
        )
        self._confirmation.start()

    def _await_confirmation(self, question: str) -> None:
        assert self.rules.confirm is not None
        try:
            agreed = self.rules.confirm(question, self._ended)
        except Exception as error:  # an error is no agreement
            agreed = False
            self.history.notice(f"the confirmation of the first write could not be asked for: {error!r}.")
        if self._ended.is_set():
            return
        self._enter("confirmed" if agreed else "declined", self.now())
        if agreed:
            self._allowed = True
        else:
            self.guard.stop("the first write was not confirmed by the user")
            self.history.notice("the first write was not confirmed by the user: nothing was pushed.")

    def _note_hold(self, decision: Decision) -> None:
        kind = re.sub(r"[-+\d.,e]+", "#", decision.why)
        if kind != self._held[0] and decision.time - self._held[1] >= HOLD_NOTE_PERIOD:
            self._held = (kind, decision.time)
            self._enter("hold", decision.time, reason=decision.why)

    def _say(self, sentence: str) -> None:
        self.history.notice(sentence)
        self.record(f"guard: {sentence}")

    def _enter(self, action: str, time: float, *, writes: tuple[tuple[str, float], ...] = (), reason: str = "") -> None:
        """Add an entry to the account and to the recording."""
        entry: dict[str, Any] = {"time": time, "action": action, "reason": reason}
        if writes:
            entry["writes"] = [list(w) for w in writes]
        with self._lock:
            if len(self.entries) < MOST_ACCOUNT_ENTRIES or action not in ("hold", "would write"):
                self.entries.append(entry)
        text = ", ".join(f"{n} = {v:.6g}" for n, v in writes)
        self.record(
            f"guard {action} at {time:.3f} s" + (f": {text}" if text else "") + (f" ({reason})" if reason else "")
        )
