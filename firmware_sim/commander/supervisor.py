"""The supervisor decides whether the motors may run (crazyflie-firmware supervisor.c).

It handles arming, tumble, watchdogs and emergency stop at 25 Hz, with states and transitions as in
supervisor_state_machine.c, one transition an update.
"""

import math
from collections.abc import Callable, Mapping
from enum import IntEnum

import numpy as np

from firmware_sim import contents
from firmware_sim.commander import setpoint as sp
from firmware_sim.tables import Slot, slots

PERIOD = 40  # ms
_FLYING_HYSTERESIS = 2000  # ms without thrust above idle before we are not flying any more
_LEVEL_OUT_AGE, _SHUTDOWN_AGE = 500, 2000  # ms, age of the setpoint
_STOP_WATCHDOG = 1000  # ms between notifications once the first has come
_FREE_FALL = 0.1  # g
_TILTED, _TILTED_TIME = 0.5, 1000  # acc.z below this [g] for that long [ms] is a tumble
_UPSIDE_DOWN, _UPSIDE_DOWN_TIME = -0.2, 100
_SPUN_UP_TIME, _SPUN_UP_LOW, _SPUN_UP_HIGH = 200, 1000, 3500  # ms in this range of rpm


class State(IntEnum):
    """States of the supervisor."""

    NOT_INITIALISED = 0
    CHECKS_NOT_PASSED = 1
    CHECKS_PASSED = 2
    SPINNING_UP = 3
    READY = 4
    FLYING = 5
    LANDED = 6
    RESET = 7
    LEVEL_OUT = 8
    FREE_FALL = 9
    LOCKED = 10
    CRASHED = 11


_MOTORS = {State.SPINNING_UP, State.READY, State.FLYING, State.LANDED, State.LEVEL_OUT}
_CAN_FLY = _MOTORS - {State.SPINNING_UP}
_KEEP_ARMED = _MOTORS

_LIMITS = ("prefltTimeout", "landedTimeout", "tmblChckEn", "spinupTimeout", "crashDetectGs")
_PARAMETERS = ("stabilizer.stop", *(f"supervisor.{name}" for name in _LIMITS))
_VARIABLES = ("supervisor.info", "supervisor.accNorm", "sys.canfly", "sys.isFlying", "sys.isTumbled")


class Supervisor:
    """State machine; log and param are the live slots of the flight (acc in g, PWM, rpm; powerDist.idleThrust).

    clock: the firmware's tick [ms]. auto_arm: True for brushed motors. console: where its messages go.
    """

    def __init__(
        self,
        log: Mapping[str, Slot],
        param: Mapping[str, Slot],
        *,
        auto_arm: bool,
        clock: Callable[[], int],
        console: Callable[[str], None],
    ):
        self.log, self.param = slots(dict.fromkeys(_VARIABLES, 0.0)), slots(contents.defaults(_PARAMETERS))
        self._acc = [log[f"acc.{axis}"] for axis in "xyz"]
        self._pwm = [log[f"motor.m{n}"] for n in range(1, 5)]
        self._rpm = [log[f"motor.m{n}_rpm"] for n in range(1, 5) if f"motor.m{n}_rpm" in log]
        self._idle = param.get("powerDist.idleThrust", (np.zeros(1), 0))
        self._auto_arm, self._clock, self._console = auto_arm, clock, console
        self.state = State.NOT_INITIALISED
        self.armed = self.crashed = self.tumbled = self.stopped = False
        self.planner_bits = 0  # bits 8..10 of the information, set by the owner of the planner
        self._tumble_since: int | None = None
        self._thrust_at: int | None = None
        self._watchdog_at: int | None = None
        self._entered = 0  # tick of the last change of state
        self._spun_since: int | None = None

    # Requests of clients.

    def request_arming(self, arm: bool) -> bool:
        """Arm or disarm; arming works only when the pre-flight checks have passed."""
        if arm != self.armed:
            if arm and self.state != State.CHECKS_PASSED:
                return False
            self.armed = arm
        return True

    def request_recovery(self) -> bool:
        """Leave the crashed state; impossible while the drone lies on its back."""
        if self.crashed and self.tumbled:
            return False
        self.crashed = False
        return True

    def emergency_stop(self) -> None:
        """Stop the motors for good: only a restart helps."""
        self.stopped = True

    def emergency_stop_watchdog(self) -> None:
        """Start or feed the watchdog: without the next notification within a second the motors stop for good."""
        self._watchdog_at = self._clock()

    # Queries of the rest of the firmware.

    @property
    def motors_allowed(self) -> bool:
        """May the motors turn (idle included)?"""
        return self.state in _MOTORS

    @property
    def can_fly(self) -> bool:
        """May setpoints reach the controller?"""
        return self.state in _CAN_FLY

    @property
    def flying(self) -> bool:
        """True in the air (thrust above idle within the last two seconds)."""
        return self.state in {State.FLYING, State.LEVEL_OUT}

    @property
    def info(self) -> int:
        """The information bits, crtp_supervisor.h."""
        bits = (
            self.state == State.CHECKS_PASSED,
            self.armed,
            self._auto_arm,
            self.can_fly,
            self.flying,
            self.tumbled,
            self.state == State.LOCKED,
            self.crashed,
        )
        return sum(1 << n for n, bit in enumerate(bits) if bit) | self.planner_bits

    def override(self, setpoint: np.ndarray) -> np.ndarray:
        """The setpoint for the controller: unchanged, levelled out when stale, or null."""
        if self.state in {State.READY, State.FLYING, State.LANDED}:
            return setpoint
        if self.state != State.LEVEL_OUT:
            return sp.null_setpoint()
        level = setpoint.copy()
        level[[sp.MODE_X, sp.MODE_Y]] = sp.DISABLE
        level[[sp.MODE_ROLL, sp.MODE_PITCH]] = sp.ABSOLUTE
        level[sp.MODE_YAW] = sp.VELOCITY
        level[[sp.ROLL, sp.PITCH, sp.RATE_YAW]] = 0.0
        return level  # height as it is

    # The 25 Hz update.

    def update(self, setpoint_stamp: int) -> None:
        """One update; setpoint_stamp: tick [ms] of the newest setpoint."""
        tick = self._clock()
        age = tick - setpoint_stamp
        flying = self._thrust_above_idle(tick)
        self.tumbled = self._is_tumbled(tick) and self._get("supervisor.tmblChckEn") != 0
        new = self._transition(tick, flying, age)
        if new != self.state:
            self._enter(new, tick)
        self.publish()

    def publish(self) -> None:
        """Write the supervisor's log variables."""
        acceleration = [float(array[index]) for array, index in self._acc]
        values = (self.info, math.hypot(*acceleration), self.can_fly, self.flying, self.tumbled)
        for name, value in zip(_VARIABLES, values, strict=True):
            array, index = self.log[name]
            array[index] = value

    def _get(self, name: str) -> float:
        array, index = self.param[name]
        return float(array[index])

    def _thrust_above_idle(self, tick: int) -> bool:
        idle = self._idle[0][self._idle[1]] if not self._auto_arm else 0.0
        if any(array[index] > idle for array, index in self._pwm):
            self._thrust_at = tick
        return self._thrust_at is not None and tick - self._thrust_at < _FLYING_HYSTERESIS

    def _is_tumbled(self, tick: int) -> bool:
        x, y, z = (float(array[index]) for array, index in self._acc)
        limit, norm = self._get("supervisor.crashDetectGs"), math.hypot(x, y, z)
        if limit > 0.0 and abs(norm - 1.0) > limit:
            self._console(f"SUP: Crash detected @ {norm:.2f} Gs (max {limit:.2f})\n")
            return True
        if max(abs(x), abs(y), abs(z)) < _FREE_FALL:
            self._tumble_since = None
        if z >= _TILTED:
            self._tumble_since = None
            return False
        if self._tumble_since is None:
            self._tumble_since = tick
        lasted = tick - self._tumble_since
        return lasted > _TILTED_TIME or (z < _UPSIDE_DOWN and lasted > _UPSIDE_DOWN_TIME)

    def _emergency(self, tick: int) -> bool:
        watchdog = self._watchdog_at is not None and tick >= self._watchdog_at + _STOP_WATCHDOG
        return self.stopped or watchdog or self._get("stabilizer.stop") != 0

    def _transition(self, tick: int, flying: bool, age: int) -> State:
        state, inside = self.state, tick - self._entered
        emergency = self._emergency(tick)
        if state in {State.NOT_INITIALISED, State.RESET}:
            return State.CHECKS_NOT_PASSED
        if state == State.FREE_FALL:
            return State.LOCKED
        if state == State.LOCKED:
            return state
        if state == State.CRASHED:
            if not self.crashed and not self.tumbled:
                return State.CHECKS_NOT_PASSED
            return State.LOCKED if emergency else state
        if emergency:
            return State.FREE_FALL
        if state == State.CHECKS_NOT_PASSED:
            return state if self.tumbled else State.CHECKS_PASSED
        if state == State.CHECKS_PASSED:
            if self.tumbled:
                return State.CHECKS_NOT_PASSED
            if self.armed:
                return State.SPINNING_UP if self._rpm and not self._auto_arm else State.READY
            return state
        if state == State.SPINNING_UP:
            if self.tumbled or not self.armed or inside > self._get("supervisor.spinupTimeout"):
                return State.CHECKS_NOT_PASSED
            return State.READY if self._spun_up(tick) else state
        if state == State.READY:
            timeout = not self._auto_arm and inside > self._get("supervisor.prefltTimeout")
            if self.tumbled or not self.armed or timeout:
                return State.CHECKS_NOT_PASSED
            return State.FLYING if flying else state
        if state == State.LANDED:
            timeout = not self._auto_arm and inside > self._get("supervisor.landedTimeout")
            if not self.armed or timeout:
                return State.RESET
            return State.FLYING if flying else state
        # Flying, or levelling out.
        if age > _SHUTDOWN_AGE or not self.armed:
            return State.FREE_FALL
        if self.tumbled:
            return State.CRASHED
        if age > _LEVEL_OUT_AGE:
            return State.LEVEL_OUT
        if state == State.LEVEL_OUT or flying:
            return State.FLYING
        return State.LANDED

    def _spun_up(self, tick: int) -> bool:
        if not all(_SPUN_UP_LOW <= array[index] <= _SPUN_UP_HIGH for array, index in self._rpm):
            self._spun_since = None
            return False
        if self._spun_since is None:
            self._spun_since = tick
        return tick - self._spun_since >= _SPUN_UP_TIME

    def _enter(self, new: State, tick: int) -> None:
        old, self.state, self._entered, self._spun_since = self.state, new, tick, None
        if new == State.CRASHED:
            self.crashed = True
            self._console("SUP: Crashed, recovery required\n")
        elif new == State.LOCKED:
            self._console("SUP: Locked, reboot required\n")
        elif new == State.READY and not self._auto_arm:
            self._console("SUP: Ready to fly\n")
        elif new in {State.RESET, State.CHECKS_NOT_PASSED} and old in _MOTORS and not self._auto_arm:
            self._console("SUP: Disarming\n")
        if new not in _KEEP_ARMED and not (new == State.CHECKS_PASSED and self._auto_arm):
            self.armed = False
        if new == State.CHECKS_PASSED and self._auto_arm:
            self.armed = True
