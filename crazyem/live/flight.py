"""One flight from connect to landed: controller, arming, take-off, trajectory, landing, and every way out of it."""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from crazyem.control.command_units import PARAMETERS, IndiGains
from crazyem.control.trajectories import Trajectory, Vector, after_hover
from crazyem.errors import CrazyemError, LinkError, UsageError
from crazyem.links.base import ConfirmingLink, Link
from crazyem.live.controllers import Controller
from crazyem.live.session import Session
from crazyem.live.stream import SetpointStream
from crazyem.live.telemetry import ARMED, CAN_FLY, FLYING, Telemetry
from crazyem.live.write_supervisor import WriteRules

BASELINE_SECONDS = 3.0  # s of hover before anything is pushed: shows what the drone does with what it believes now
CONFIRMED_WITHIN = 0.25  # s; without setpoints the drone levels out after 0.5 s
PACKET_REORDER_SECONDS = 0.15  # s of host time by which packets may overtake one another
HAND_OVERS, HAND_OVER_EVERY = 3, 0.04  # times that the drone is handed back to land, s between them
LOST_AFTER_SILENCE = 3.0  # s of host time without a packet after which the drone counts as lost
REPORT_EVERY = 1.0  # s of host time between reports of progress


class FlightInterruptedError(Exception):
    """The user wants the drone on the ground (first Ctrl-C)."""


class MotorsCutError(Exception):
    """The user wants the motors off, now (second Ctrl-C)."""


@dataclass
class Interrupts:
    """Counts the user's Ctrl-C; the flight looks at it wherever it waits."""

    count: int = 0

    def __call__(self, *_: object) -> None:
        self.count += 1


@dataclass(frozen=True)
class FlightPlan:
    """What to fly.

    Attributes:
        trajectory: made from the hover point [m, world] and heading [rad] at which it begins.
        controller: of the firmware.
        height: of the hover above the take-off point, m.
        push: whether estimates go to the controller.
        rules: how they do (policy, dry run, confirmation); None: the shipped policy.
        baseline: s of hover before pushes and before the trajectory.
    """

    trajectory: Callable[[Vector, float], Trajectory]
    controller: Controller
    height: float = 1.0
    push: bool = True
    rules: WriteRules | None = None
    baseline: float = BASELINE_SECONDS


def select_controller(link: Link, controller: Controller) -> None:
    """Make the firmware run `controller`, verified by a fresh read: the firmware overrules silently.

    Raises: UsageError: this firmware does not have it. LinkError: no answer.
    """
    if "stabilizer.controller" not in link.parameters:
        raise UsageError("the drone has no parameter stabilizer.controller.")
    if "stabilizer.estimator" in link.parameters and link.read_parameter("stabilizer.estimator") != 2:
        _confirmed(link, "stabilizer.estimator", 2.0)
    _confirmed(link, "stabilizer.controller", float(controller.number))
    running = link.read_parameter("stabilizer.controller")
    if running != controller.number:
        raise UsageError(
            f"the drone's firmware does not have the controller '{controller.name}' "
            f"(asked for number {controller.number}, runs {running:g})."
        )


def _confirmed(link: Link, name: str, value: float) -> None:
    if not link.write_parameter(name, value, timeout=2.0).verified:
        raise LinkError(f"the drone did not confirm {name} = {value:g}.")


class Flight:
    """Flies a plan over a session that is already running.

    Args:
        session: connected link with packets flowing.
        plan: what to fly.
        interrupts: the user's Ctrl-C.
        progress: called about every second of host time with (phase, seconds of firmware time in it).
    """

    def __init__(
        self,
        session: Session,
        plan: FlightPlan,
        *,
        interrupts: Interrupts | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> None:
        self.session = session
        self.link = session.link
        self.plan = plan
        self.interrupts = interrupts or Interrupts()
        self._indi: IndiGains | None = None
        self.progress = progress or (lambda phase, seconds: None)
        self.phase = "on the ground"
        self._phase_start = math.nan
        self._handled = 0
        self._report = time.monotonic()
        self._moved = (math.nan, time.monotonic())
        self._stream: SetpointStream | None = None
        self._ground = 0.0
        self._may_fly = False

    @property
    def telemetry(self) -> Telemetry:
        return self.session.telemetry

    def fly(self) -> None:
        """Take off, fly, land. Whatever happens, the drone is brought down before this returns or raises.

        Raises:
            FlightInterruptedError: the user landed it. MotorsCutError: the user cut the motors.
            LinkError: the drone is gone. CrazyemError: anything else that ended the flight early (it has landed).
        """
        try:
            self._prepare()
            self._take_off()
            self._trajectory()
            self._land()
            self.session.end_pushing("landed")
        except BaseException as error:
            self.session.stop_pushing()
            try:
                if isinstance(error, MotorsCutError):
                    self._cut()
                else:
                    self._bring_down()
            finally:
                # Only now, on the ground or with the motors off, may parameters jump.
                self.session.end_pushing(self._outcome(error))
            raise

    def _outcome(self, error: BaseException) -> str:
        if isinstance(error, MotorsCutError):
            return "interrupted"
        if self.session.lost is not None or isinstance(error, LinkError):
            return "link_lost"
        return "interrupted" if isinstance(error, FlightInterruptedError | KeyboardInterrupt) else "failed"

    # phases

    def _prepare(self) -> None:
        self._enter("preparing")
        telemetry = self.telemetry
        self._wait(lambda: telemetry.info is not None and telemetry.position is not None, 5.0,
                   "the drone sends no position or no supervisor state")  # fmt: skip
        if telemetry.grounded_reason():
            raise UsageError(f"the drone cannot fly: {telemetry.grounded_reason()}.")
        select_controller(self.link, self.plan.controller)
        if self.plan.controller.incremental:
            told = {name: self.link.read_parameter(name) for name in PARAMETERS if name in self.link.parameters}
            self._indi = IndiGains.of(told)
        if self.plan.push:
            note = self.session.push_to_controller(self.plan.rules)
            if note and self.session.recorder is not None:
                self.session.recorder.event(note)
        if not telemetry.has(ARMED):
            self.link.arm(True)
            self._wait(lambda: telemetry.has(ARMED), 5.0, "the drone does not arm")
        self._wait(lambda: telemetry.has(CAN_FLY), 5.0, "the drone says it cannot fly")
        # A client that left earlier may have locked out the high-level commander (its last packet is a setpoint).
        self.link.release_setpoints()

    def _take_off(self) -> None:
        assert self.telemetry.position is not None
        x, y, self._ground = self.telemetry.position
        yaw = self.telemetry.yaw
        self.start: Vector = (x, y, self._ground + self.plan.height)
        self.heading = yaw
        # Made before anything spins: a file that cannot be flown must not be found out in the air.
        self.path = self.plan.trajectory(self.start, yaw)
        self._enter("taking off")
        self._may_fly = True
        duration = 1.0 + self.plan.height
        self.link.take_off(self.start[2], duration)
        self._sleep(duration + 0.5)
        self._wait(lambda: self.telemetry.has(FLYING) and self.telemetry.height > self._ground + 0.1, 3.0,
                   "the drone did not take off (locked out, or its believed mass is far too low)")  # fmt: skip

    def _trajectory(self) -> None:
        path = after_hover(self.path, seconds=self.plan.baseline)
        record = self.session.recorder.setpoint if self.session.recorder is not None else None
        self._stream = stream = SetpointStream(
            self.link,
            path,
            self.session.clock,
            on_setpoint=record,
            reconnecting=lambda: self.session.reconnecting,
            indi=self._indi,
        )
        self._enter("hovering")
        stream.start()
        self._mark("trajectory_start", self.session.clock.newest)
        self._wait(lambda: stream.elapsed >= self.plan.baseline, math.inf)
        self._enter(path.name)
        self._mark("push_enabled", self.session.clock.newest)
        self.session.pipeline.push_from = self.session.clock.newest
        self._wait(lambda: stream.elapsed >= path.duration or path.finished(), math.inf)
        self.session.pipeline.push_until = self.session.clock.newest
        self._mark("trajectory_end", self.session.clock.newest)

    def _land(self) -> None:
        """Hand back to the high-level commander, land, and make sure that it has."""
        self.session.stop_pushing()
        self._enter("landing")
        # What is sent into an outage is lost, and a second Ctrl-C still cuts.
        self._wait(lambda: not self.session.reconnecting, math.inf)
        self.session.pipeline.push_until = -math.inf  # the watch on the writes ends, too
        self.session.end_estimates()
        if self._stream is not None:
            self._stream.stop()
            self._stream = None
            self._let_setpoints_arrive()
        height = self.telemetry.height - self._ground
        duration = 1.0 + 1.5 * max(height if math.isfinite(height) else 1.0, 0.3)
        for _ in range(2):
            self._hand_over(duration)
            self._sleep(duration)
            try:
                self._wait(self._landed, 5.0, "did not land")
                break
            except LinkError:
                raise
            except CrazyemError:
                if self.telemetry.height < self._ground + 0.3:
                    break  # low enough to drop
        self.link.stop()
        self._may_fly = False
        self._enter("landed")

    def _let_setpoints_arrive(self) -> None:
        """One that came after the plan to land would make the drone forget it, and the release then stop the motors."""
        # an accelerated simulator's drone levels out after 0.5 s of its own time without setpoints
        until = time.monotonic() + PACKET_REORDER_SECONDS / max(1.0, self.session.clock.rate / 3.0)
        self._wait(lambda: time.monotonic() >= until, math.inf)

    def _hand_over(self, duration: float) -> None:
        """The drone to the high-level commander, with a plan to land.

        The plan comes first: a release that arrives without one stops the motors, and nothing says what arrived. So
        both are sent three times; a plan that begins anew does no harm, and 2 s without a release would drop the drone.
        A link that can ask whether the plan arrived does so first.
        """
        link = self.link
        if isinstance(link, ConfirmingLink) and link.land_and_confirm(self._ground, duration, timeout=CONFIRMED_WITHIN):
            for _ in range(HAND_OVERS):
                self.link.release_setpoints()
                self._sleep(HAND_OVER_EVERY)
            return
        for _ in range(HAND_OVERS):
            self.link.land(self._ground, duration)
            self._sleep(HAND_OVER_EVERY)
            self.link.release_setpoints()

    def _landed(self) -> bool:
        return not self.telemetry.has(FLYING) and not self.telemetry.height > self._ground + 0.15

    # ways out

    def _bring_down(self) -> None:
        """After any failure: land while somebody answers, else cut, so that nothing of ours keeps it up."""
        if self._stream is not None:
            self._stream.stop()
        if not self._may_fly:
            return
        notice = self.session.history.notice
        fell = self.session.outages and self.telemetry.grounded_reason()
        if self.session.lost is None and not fell:
            flew = self.telemetry.has(FLYING) or self.telemetry.height > self._ground + 0.1
            for _ in range(2):  # a Ctrl-C that arrives while landing is the second one: cut
                try:
                    self._land()
                    notice(
                        "the flight ended early; the drone was landed." if flew else "the drone never left the ground."
                    )
                    return
                except MotorsCutError:
                    self._cut()
                    raise
                except FlightInterruptedError:
                    continue
                except BaseException:
                    break
            notice("the flight ended early and the drone could not be landed: its motors were cut.")
        self._cut()

    def _cut(self) -> None:
        if self._stream is not None:
            self._stream.stop()
        self._may_fly = False
        self.session.stop_pushing(motors_cut=True)
        with contextlib.suppress(Exception):
            self.link.stop()

    # waiting

    def _enter(self, phase: str) -> None:
        self.phase = phase
        self._phase_start = self.session.clock.newest
        if self.session.recorder is not None:
            self.session.recorder.event(phase)

    def _mark(self, name: str, firmware_time: float) -> None:
        self.session.history.marks[name] = firmware_time
        if self.session.recorder is not None:
            self.session.recorder.event(f"mark {name} {firmware_time!r}")

    def _sleep(self, seconds: float) -> None:
        until = self.session.clock.newest + seconds
        self._wait(lambda: self.session.clock.newest >= until, math.inf)

    def _wait(self, done: Callable[[], bool], seconds: float, otherwise: str = "") -> None:
        """Until `done()`, at most `seconds` of firmware time; looks after everything that may end a flight."""
        clock = self.session.clock
        begun = clock.newest
        while not done():
            self._watch()
            if clock.newest - begun > seconds:
                raise CrazyemError(f"{otherwise}.")
            if math.isnan(begun):
                begun = clock.newest
            time.sleep(0.005 / max(1.0, clock.rate))

    def _watch(self) -> None:
        now = time.monotonic()
        if self.interrupts.count > self._handled:
            self._handled += 1
            if self._handled >= 2:
                raise MotorsCutError
            raise FlightInterruptedError
        newest = self.session.clock.newest
        newest = newest if math.isfinite(newest) else -1.0
        if newest != self._moved[0] or self.session.reconnecting:
            self._moved = (newest, now)
        elif now - self._moved[1] > LOST_AFTER_SILENCE and self.session.lost is None:
            gone = f"the drone at {self.link.uri} was lost: nothing was received for {LOST_AFTER_SILENCE:g} s."
            raise LinkError(gone)
        if self.session.lost is not None or (self.session.failure is not None and self.phase != "landing"):
            self.session.raise_if_failed()
        if self.session.outages and self._may_fly and self.telemetry.grounded_reason():
            raise CrazyemError(f"the drone fell while the link was gone: {self.telemetry.grounded_reason()}.")
        if self.session.landing_wanted and self.phase != "landing":
            raise CrazyemError(f"the flight was ended because of a fault: {self.session.landing_wanted}.")
        if self._stream is not None and self._stream.failure is not None:
            raise LinkError(f"setpoints could not be sent: {self._stream.failure}.")
        if now - self._report >= REPORT_EVERY:
            self._report = now
            self.progress(self.phase, clock_seconds(self.session.clock.newest, self._phase_start))


def clock_seconds(now: float, start: float) -> float:
    """Seconds in a phase, 0 where unknown."""
    return now - start if math.isfinite(now - start) else 0.0
