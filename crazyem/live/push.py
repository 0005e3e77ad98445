"""Writes the guard's decisions to the drone in its own thread, and records every echo; the targets of these writes.

Every packet with a value, also a repeated one, passes the write gate: each attempt sends one packet.

Hover thrust of PX4 and ArduPilot is a parameter for the guard: a mass in other units. The hover thrust parameter is
assumed to be right at the mass of the vehicle file. At another mass it is scaled by the ratio of the masses, if thrust
is proportional to the command. This holds if the autopilot linearises its motors (THR_MDL_FAC, MOT_THST_EXPO) and the
battery (MOT_BAT_VOLT_MAX); otherwise the new value is an approximation.
"""

import math
import queue
import threading
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from crazyem.errors import CrazyemError
from crazyem.links.base import HoverThrustLink, Link, ParameterWrite
from crazyem.live.controllers import CONTROLLERS, Controller, for_vehicle, with_drag, without_target, writes_back
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History, Push
from crazyem.live.policy import WriteRules
from crazyem.live.write_gate import WriteGate
from crazyem.vehicle import Vehicle

ONBOARD_DRAG = ("kalman.dragB_x", "kalman.dragB_y")
WRITE_TIMEOUT = 0.3  # s; an echo takes 2 to 30 ms on a working link, and the link itself repeats only later
RETRY_PAUSE = 0.1  # s before the next attempt: the loss of a link is noticed a little after a refusal
WRITE_ATTEMPTS = 9  # of a write, 3.6 s in all: an outage is noticed within 2 s, and attempts during it do not count
TELEMETRY_POLL = 0.01  # s between checks for fresh telemetry


def push_target(link: Link, vehicle: Vehicle) -> tuple[Controller | None, str]:
    """The target of pushes on this drone and a note; or None and one sentence why there is none."""
    number = int(link.read_parameter("stabilizer.controller"))  # a fresh read: the firmware may select another one
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
    """The present values of every parameter that a push may write."""
    return {name: link.read_parameter(name) for name in controller.parameters}


def nominal_estimates(vehicle: Vehicle, controller: Controller) -> dict[str, float]:
    """Values of the vehicle file for all estimates that may be pushed [SI]: the centres of the allowed ranges."""
    values = (vehicle.mass, *vehicle.inertia, vehicle.motor_time_constant)
    return dict(zip(("mass", "Ixx", "Iyy", "Izz", "motor_time_constant"), values)) | dict(controller.known)


class Pusher:
    """Writes decisions in one thread, one write at a time, in their order.

    An unconfirmed write is tried again, after an outage once the link is back: writing the same value twice does no
    harm. If it stays unconfirmed, all pushing ends, and its set is undone as far as the drone answers, because a set
    must not stay incomplete. If the gate refuses the first write of a set, the set is dropped and the guard decides
    again.

    Args:
        guard: is stopped after an unconfirmed write.
        gate: checked before every packet.
        history: keeps every write.
        on_write: called with every write (recording).
        wait_for_link: waits during a reconnection; False if the link is lost for good.
        outages: number of losses of the link, including a present one.
        known: parameter values in the drone, as read at connect. Without them nothing can be undone.
        on_done: called after each decision with the decision and one clause why it is not complete, "" if it is.
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
        """Whether a decision is queued or being written."""
        return self._pending > 0

    def submit(self, decision: Decision) -> None:
        """Queue a decision's writes; returns at once. A revert or restore writes only values that differ."""
        with self._lock:
            self._pending += 1
        self._queue.put(decision)

    def close(self) -> None:
        """Finish the present set and a queued restore, then end; waits at most as long as a write and its undo take."""
        self._queue.put(None)
        self._thread.join(timeout=2 * WRITE_ATTEMPTS * (self.timeout + 2 * RETRY_PAUSE) + 1.0)
        if self._thread.is_alive():
            self.history.notice("parameter writes were still waiting for the drone when the session ended.")

    def _run(self) -> None:
        while (decision := self._queue.get()) is not None:
            why = ""
            try:
                why = self._push(decision) if decision.kind == "push" else self._write_back(decision)
            except Exception as error:  # an internal error: the drone's values are unknown, so pushing ends
                why = f"pushing failed: {error!r}"
                self.guard.stop(why)
                self.history.notice(f"{why}: nothing more is pushed.")
            finally:
                with self._lock:
                    self._pending -= 1
            self.on_done(decision, why)

    def _push(self, decision: Decision) -> str:
        """Write a set completely or undo it; returns why it was not confirmed, "" if it was."""
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
        """Write the values from before the set, also for an unconfirmed write, because it may have arrived."""
        if not all(name in before for name in touched):
            return
        lost = [name for name in touched if math.isnan(self.known[name])]
        # For the order, an unconfirmed write counts as written; so the order of the undo is that of the set, reversed.
        now = {**self.known, **{name: dict(decision.writes)[name] for name in lost}}
        target = {name: before[name] for name in touched}
        for name, value in writes_back(self.guard.controller, target, now=now, uncertain=lost):
            if self._put_back(decision, name, value, purpose="undo"):
                return
        self.history.notice("the set of parameters it belongs to was undone.")

    def _write_back(self, decision: Decision) -> str:
        """Write the values of a revert or restore; returns why the drone does not have them, "" if it does."""
        target = dict(decision.writes)
        for name, value in writes_back(self.guard.controller, target, now=self.known):
            if why := self._put_back(decision, name, value, purpose=decision.kind):
                return why
        return ""

    def _put_back(self, decision: Decision, name: str, value: float, *, purpose: str) -> str:
        """Write an old value; returns why this failed, "" if it did not."""
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
        """Write a value; returns why it was not confirmed ("" if it was), and whether a packet may have been sent.

        `patient`: wait for fresh telemetry; else the write is not begun without it.
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
            # An attempt during which the link was lost does not count.
            failed += self.outages() == outages
            if not why or failed == WRITE_ATTEMPTS:
                break
        if sent:
            self.history.pushes.append(Push(time, name, value, not why, purpose))
            if name in self.known:
                self.known[name] = math.nan if why else value
        return why, sent

    def _refused(self, purpose: str, *, patient: bool) -> tuple[str, bool]:
        """Why the gate refuses a write ("" if it does not), and whether the refusal is final."""
        until = clock.monotonic() + self.timeout
        while (why := self.gate.stale()) and patient and clock.monotonic() < until:
            clock.sleep(TELEMETRY_POLL)
        if why:
            return why, not patient
        why = self.gate.misplaced(purpose)
        return why, bool(why)

    def _attempt(self, name: str, value: float) -> str:
        """Send a write once; returns "" if the drone confirms it, else why not."""
        try:
            write = self.link.write_parameter(name, value, timeout=self.timeout)
        except Exception as error:  # an internal error ends the pushing, not the flight; the sentence names it
            # the packet may have been sent before the link failed
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
        except Exception as error:  # the set is completed, but then pushing ends: all writes must be recorded
            self.guard.stop(f"a write could not be recorded: {error!r}")
            self.history.notice(f"a write could not be recorded ({error!r}): nothing more is pushed.")


LOWEST_HOVER_THRUST, HIGHEST_HOVER_THRUST = 0.1, 0.8  # of full thrust: PX4's own bounds on MPC_THR_HOVER
_NO_CONTROLLER = -1  # there is no stabilizer.controller


def hover_target(link: HoverThrustLink, vehicle: Vehicle) -> tuple[Controller | None, str]:
    """The target of pushes on a MAVLink drone, or None and one sentence why there is none."""
    name = link.hover_parameter
    if not name:
        return None, "this autopilot has no hover thrust parameter that is known here: estimates are not pushed."
    try:
        value = link.read_parameter(name)
    except CrazyemError as error:
        return None, f"{str(error).rstrip('.')}: estimates are not pushed."
    if not LOWEST_HOVER_THRUST <= value <= HIGHEST_HOVER_THRUST:
        bounds = f"{LOWEST_HOVER_THRUST:g} to {HIGHEST_HOVER_THRUST:g}"
        return None, f"{name} is {value:g}, outside {bounds}: estimates are not pushed."
    note = f"{name} = {value:.4g} is taken for right at {vehicle.mass:.4g} kg, and thrust for proportional to it."
    if link.onboard_hover_estimator:
        note += f" {link.onboard_hover_estimator}: what is written may have no effect, or be overwritten."
    scale = vehicle.mass / value
    return Controller("hover thrust", _NO_CONTROLLER, mass=name, mass_scale=scale, persistent=True, note=note), note


def hover_rules(rules: WriteRules, link: HoverThrustLink, controller: Controller | None) -> WriteRules:
    """Rules with the narrower of the policy's bounds and those of hover thrust; the battery threshold is per cell."""
    policy = rules.policy
    if controller is not None:
        least, most = policy.limits.mass_absolute
        inside = (
            max(least, LOWEST_HOVER_THRUST * controller.mass_scale),
            min(most, HIGHEST_HOVER_THRUST * controller.mass_scale),
        )
        policy = replace(policy, limits=replace(policy.limits, mass_absolute=inside))
    cells = max(link.cells, 1)
    if math.isfinite(policy.health.battery):
        policy = replace(policy, health=replace(policy.health, battery=policy.health.battery * cells))
    return replace(rules, policy=policy)


def hover_afterwards(controller: Controller, *, now: Mapping[str, float], before: Mapping[str, float]) -> str:
    """One sentence for the user before the next session; "" if the parameter has its value from connect.

    The next session would assume that the new value is right at the old mass, and make the same correction again.

    Args:
        now: parameter values in the drone, NaN if unknown. before: at connect.
    """
    name = controller.mass
    value = now.get(name, math.nan)
    if math.isclose(value, before.get(name, math.nan), rel_tol=1e-6):
        return ""
    if math.isnan(value):
        return f"what {name} holds is not known: read it before the next flight."
    return (
        f"{name} is {value:.4g} now, right at {value * controller.mass_scale:.4g} kg: give that mass in the vehicle "
        "file from now on, or the next session makes the same correction again."
    )
