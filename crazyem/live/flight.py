"""One flight: selection of the controller, arming, take-off, trajectory, landing, and the handling of every failure."""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from crazyem.control.indi import PARAMETERS, IndiGains
from crazyem.control.trajectories import Trajectory, Vector, after_hover
from crazyem.errors import CrazyemError, LinkError, UsageError
from crazyem.links.base import ConfirmingLink, HostClockLink, Link
from crazyem.live.controllers import Controller
from crazyem.live.policy import WriteRules
from crazyem.live.session import Session
from crazyem.live.stream import SetpointStream
from crazyem.live.telemetry import ARMED, CAN_FLY, FLYING

BASELINE_SECONDS = 3.0  # s of hover before the first push: shows the behaviour with the present parameters
CONFIRMED_WITHIN = 0.25  # s to confirm the plan to land; without setpoints the drone levels out after 0.5 s
PACKET_REORDER_SECONDS = 0.15  # s of host time by which packets may overtake one another
HAND_OVERS, HAND_OVER_EVERY = 3, 0.04  # repetitions of the hand-over for the landing; s between them
LOST_AFTER_SILENCE = 3.0  # s of host time without a packet after which the drone counts as lost
REPORT_EVERY = 1.0  # s of host time between reports of progress


class FlightInterruptedError(Exception):
    """The user wants the drone on the ground (first Ctrl-C)."""


class MotorsCutError(Exception):
    """The user wants the motors off, now (second Ctrl-C)."""


@dataclass
class Interrupts:
    """Counts the user's Ctrl-C; the flight checks the count whenever it waits."""

    count: int = 0

    def __call__(self, *_: object) -> None:
        self.count += 1

    def land(self) -> None:
        """Land, as the first Ctrl-C does; repeated calls never cut the motors."""
        self.count = max(self.count, 1)


@dataclass(frozen=True)
class FlightPlan:
    """What to fly.

    Attributes:
        trajectory: makes the trajectory from the hover point [m, world] and heading [rad] at its beginning.
        height: of the hover above the take-off point, m.
        push: whether estimates are written to the controller.
        rules: of these writes (policy, dry run, confirmation); None: the shipped policy.
        baseline: s of hover before pushes and before the trajectory.
    """

    trajectory: Callable[[Vector, float], Trajectory]
    controller: Controller
    height: float = 1.0
    push: bool = True
    rules: WriteRules | None = None
    baseline: float = BASELINE_SECONDS


def select_controller(link: Link, controller: Controller) -> None:
    """Make the firmware run `controller`, and verify by a fresh read: the firmware may refuse silently.

    Raises: UsageError: the firmware does not have this controller. LinkError: no answer.
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
        progress: called about every second of host time with the phase and the seconds of firmware time in it.
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
        self.telemetry = session.telemetry
        self.plan = plan
        self.interrupts = interrupts or Interrupts()
        self._indi: IndiGains | None = None
        self.progress = progress or (lambda phase, seconds: None)
        self.phase = "on the ground"
        self._phase_start = math.nan
        self._handled = 0
        self._report = time.monotonic()
        self._host_clock = self.link.host_clock if isinstance(self.link, HostClockLink) else time.monotonic
        self._moved = (math.nan, self._host_clock())
        self._stream: SetpointStream | None = None
        self._ground = 0.0
        self._may_fly = False

    def fly(self) -> None:
        """Take off, fly, land. In every case the drone is brought down before this returns or raises.

        Raises:
            FlightInterruptedError: the user landed the drone. MotorsCutError: the user cut the motors.
            LinkError: the link is lost. CrazyemError: another reason ended the flight early (the drone has landed).
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
                # Parameters may jump only on the ground or with the motors off.
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
            if note:
                self.session.record_event(note)
        if not telemetry.has(ARMED):
            self.link.arm(True)
            self._wait(lambda: telemetry.has(ARMED), 5.0, "the drone does not arm")
        self._wait(lambda: telemetry.has(CAN_FLY), 5.0, "the drone says it cannot fly")
        # The last packet of an earlier client may be a setpoint, which locks out the high-level commander.
        self.link.release_setpoints()

    def _take_off(self) -> None:
        assert self.telemetry.position is not None
        x, y, self._ground = self.telemetry.position
        yaw = self.telemetry.yaw
        self.start: Vector = (x, y, self._ground + self.plan.height)
        self.heading = yaw
        # Made before the motors start: an error in a trajectory file must not appear in the air.
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
            self.link, path, self.session.clock,
            on_setpoint=record, reconnecting=lambda: self.session.reconnecting, indi=self._indi,
        )  # fmt: skip
        self._enter("hovering")
        stream.start()
        self._mark("trajectory_start")
        self._wait(lambda: stream.elapsed >= self.plan.baseline, math.inf)
        self._enter(path.name)
        self.session.pipeline.push_from = self._mark("push_enabled")
        self._wait(lambda: stream.elapsed >= path.duration or path.finished(), math.inf)
        self.session.pipeline.push_until = self._mark("trajectory_end")

    def _land(self) -> None:
        """Hand over to the high-level commander, land, and check that the drone has landed."""
        self.session.stop_pushing()
        self._enter("landing")
        # Packets sent during an outage are lost, so wait; a second Ctrl-C still cuts the motors.
        self._wait(lambda: not self.session.reconnecting, math.inf)
        self.session.pipeline.push_until = -math.inf  # also ends the monitoring of writes
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
                self._wait(lambda: not self.telemetry.has(FLYING) and not self.telemetry.height > self._ground + 0.15,
                           5.0, "did not land")  # fmt: skip
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
        """Wait for setpoints on their way: one that arrives after the plan to land would cancel the plan.

        The release of setpoints would then stop the motors.
        """
        # an accelerated simulator's drone levels out after 0.5 s of its own time without setpoints
        until = time.monotonic() + PACKET_REORDER_SECONDS / max(1.0, self.session.clock.rate / 3.0)
        self._wait(lambda: time.monotonic() >= until, math.inf)

    def _hand_over(self, duration: float) -> None:
        """Hand the drone over to the high-level commander, with a plan to land.

        The plan is sent before the release of setpoints: a release without a plan stops the motors. It is not known
        which packets arrive, so both are sent three times. A repeated plan does no harm; without a release the drone
        drops after 2 s. A link that can confirm the plan does so first.
        """
        link = self.link
        if isinstance(link, ConfirmingLink) and link.land_and_confirm(self._ground, duration, timeout=CONFIRMED_WITHIN):
            for _ in range(HAND_OVERS):
                link.release_setpoints()
                self._sleep(HAND_OVER_EVERY)
            return
        for _ in range(HAND_OVERS):
            link.land(self._ground, duration)
            self._sleep(HAND_OVER_EVERY)
            link.release_setpoints()

    # ways out

    def _bring_down(self) -> None:
        """After any failure: land if the drone answers, else cut the motors."""
        if self._stream is not None:
            self._stream.stop()
        if not self._may_fly:
            return
        notice = self.session.history.notice
        fell = self.session.outages and self.telemetry.grounded_reason()
        if self.session.lost is None and not fell:
            flew = self.telemetry.has(FLYING) or self.telemetry.height > self._ground + 0.1
            for _ in range(2):  # a Ctrl-C during the landing is the second one: cut
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
        self.session.record_event(phase)

    def _mark(self, name: str) -> float:
        """Mark the newest time [s] on the drone's clock, and return it."""
        newest = self.session.clock.newest
        self.session.mark(name, newest)
        return newest

    def _sleep(self, seconds: float) -> None:
        until = self.session.clock.newest + seconds
        self._wait(lambda: self.session.clock.newest >= until, math.inf)

    def _wait(self, done: Callable[[], bool], seconds: float, otherwise: str = "") -> None:
        """Wait until `done()`, at most `seconds` of firmware time, and check everything that may end a flight.

        Raises: CrazyemError: the time is over; `otherwise` says why.
        """
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
        now = self._host_clock()
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
        if (now := time.monotonic()) - self._report >= REPORT_EVERY:
            self._report = now
            seconds = self.session.clock.newest - self._phase_start
            self.progress(self.phase, seconds if math.isfinite(seconds) else 0.0)
