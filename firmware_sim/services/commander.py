"""Ports 3, 7 and 8: setpoints, and the high-level commander, which turns its goals into setpoints.

Low-level setpoints (3, 7) and the notice that a stream of them has ended get no replies. Source of the high-level
commander: crazyflie-firmware crtp_commander_high_level.c; each command is answered with its first bytes and an error.
"""

import math
import struct
from collections.abc import Callable, Mapping

import numpy as np

from firmware_sim import contents
from firmware_sim.commander import setpoint as sp
from firmware_sim.commander.decode import RpytDecoder, decode_generic
from firmware_sim.commander.planner import Evaluation, Planner, PlannerState
from firmware_sim.commander.polynomials import unpack_compressed, unpack_poly4d
from firmware_sim.commander.setpoint import CRTP, Arbiter
from firmware_sim.services.memory import TRAJECTORY_SIZE
from firmware_sim.tables import Slot, slots
from firmware_sim.wire import EBUSY, ENOEXEC

SETPOINT, META = 0, 1
NOTIFY_STOP = 0


class SetpointService:
    """Decodes setpoints and hands them to the arbiter, unless the supervisor does not allow flight."""

    def __init__(self, arbiter: Arbiter, rpyt: RpytDecoder):
        self._arbiter, self._rpyt = arbiter, rpyt

    def handle_rpyt(self, channel: int, data: bytes, tick: int, *, allowed: bool) -> list[tuple[int, bytes]]:
        """A packet on port 3: roll, pitch, yaw rate, thrust."""
        if channel == 0 and len(data) >= 14 and allowed:
            roll, pitch, yaw_rate, thrust = struct.unpack_from("<fffH", data)
            setpoint = self._rpyt.decode(roll, pitch, yaw_rate, thrust, disabled=self._arbiter.disabled)
            self._offer(setpoint, tick)
        return []

    def handle_generic(self, channel: int, data: bytes, tick: int, *, allowed: bool) -> list[tuple[int, bytes]]:
        """A packet on port 7: a typed setpoint (channel 0) or a meta command (channel 1)."""
        if channel == META:
            if data[:1] == bytes((NOTIFY_STOP,)):
                self._arbiter.relax()
        elif channel == SETPOINT and data and allowed:
            setpoint = decode_generic(data[0], data[1:])
            if setpoint is not None:
                self._offer(setpoint, tick)
        return []

    def _offer(self, setpoint: np.ndarray, tick: int) -> None:
        """Hand on a setpoint; values that are not numbers are ignored, unlike in the firmware."""
        if np.isfinite(setpoint).all():
            self._arbiter.offer(setpoint, CRTP, tick)


PERIOD = 10  # ms
GROUP_MASK, TAKEOFF_V1, LAND_V1, STOP, GO_TO_V1, START_V1, DEFINE, TAKEOFF, LAND = 0, 1, 2, 3, 4, 5, 6, 7, 8
TAKEOFF_VELOCITY, LAND_VELOCITY, SPIRAL, GO_TO, START = 9, 10, 11, 12, 13
_COMMANDS = set(range(14))
MAX_TRAJECTORIES = 10
POLY4D, COMPRESSED = 0, 1

# enHighLevel has no effect, but clients set it
_PARAMETERS = ("hlCommander.vtoff", "hlCommander.vland", "hlCommander.groupmask", "commander.enHighLevel")


def setpoint_of(goal: Evaluation) -> np.ndarray:
    """The setpoint of a planner's goal: absolute position and yaw, with velocity, acceleration, jerk and body rates."""
    out = sp.null_setpoint()
    out[[sp.MODE_X, sp.MODE_Y, sp.MODE_Z, sp.MODE_YAW]] = sp.ABSOLUTE
    out[sp.X : sp.Z + 1] = goal.position
    out[sp.VX : sp.VZ + 1] = goal.velocity
    out[sp.AX : sp.AZ + 1] = goal.acceleration
    out[sp.JX : sp.JZ + 1] = goal.jerk
    out[sp.YAW] = math.degrees(goal.yaw)
    out[sp.RATE_ROLL : sp.RATE_YAW + 1] = np.degrees(goal.omega)
    return out


class HighLevelService:
    """Commands in, setpoints out; `state` is the flight's estimate, `memory` the trajectory memory."""

    def __init__(self, state: Mapping[str, Slot], clock: Callable[[], int]):
        self.param = slots(contents.defaults(_PARAMETERS))
        self.planner = Planner()
        self.memory = bytearray(TRAJECTORY_SIZE)
        self._clock = clock
        self._definitions: dict[int, tuple[int, int, int, int]] = {}  # id -> location, type, offset, pieces
        self._estimate = [state[f"stateEstimate.{name}"] for name in ("x", "y", "z", "vx", "vy", "vz", "yaw")]
        self.blocked = False

    # Setpoints, 100 Hz.

    def setpoint(self) -> np.ndarray | None:
        """The setpoint of the plan; null (motors off) when idle, None without a setpoint."""
        try:
            goal = self.planner.goal(self._clock() / 1000.0)
            setpoint = None if goal is None else setpoint_of(goal)
        except (ValueError, ArithmeticError):  # infinite yaw, overflow
            setpoint = np.full(sp.SIZE, np.nan)
        if setpoint is not None:
            if np.isfinite(setpoint).all():
                return setpoint
            self.planner.disable()  # as the firmware does with an invalid evaluation
        self.set_state()
        return sp.null_setpoint() if self.planner.state == PlannerState.IDLE else None

    def set_state(self) -> None:
        """Let the next plan start from the estimated state."""
        x, y, z, vx, vy, vz, yaw = (float(array[index]) for array, index in self._estimate)
        self.planner.set_state((x, y, z), (vx, vy, vz), math.radians(yaw))

    def block(self, blocked: bool) -> None:
        """The supervisor does not allow flight: stop, and refuse commands."""
        if blocked and not self.blocked:
            self.planner.stop()
        self.blocked = blocked

    @property
    def info_bits(self) -> int:
        """Bits 8..10 of the supervisor's information: active, finished, disabled."""
        planner = self.planner
        return (
            planner.active << 8
            | planner.finished(self._clock() / 1000.0) << 9
            | (planner.state == PlannerState.DISABLED) << 10
        )

    # Commands.

    def handle(self, channel: int, data: bytes) -> list[tuple[int, bytes]]:
        """Replies (channel, data) to a packet on the high-level port."""
        if not data:
            return []
        try:
            error = self._command(data[0], data[1:])
        except (struct.error, IndexError, ValueError, ArithmeticError):
            error = ENOEXEC  # too short, a trajectory beyond the memory, or invalid numbers
        return [(channel, data[:3].ljust(3, b"\0") + bytes((error,)))]

    def _get(self, name: str) -> float:
        array, index = self.param[name]
        return float(array[index])

    def _command(self, command: int, data: bytes) -> int:
        if command == GROUP_MASK:
            array, index = self.param["hlCommander.groupmask"]
            array[index] = data[0]
            return 0
        if command == DEFINE:
            return self._define(data)
        if command not in _COMMANDS:
            return ENOEXEC
        if self.blocked:
            return EBUSY
        group = data[0] if data else 0
        if group and not group & int(self._get("hlCommander.groupmask")):
            return 0
        time = self._clock() / 1000.0
        if command == STOP:
            self.planner.stop()
            return 0
        if command in {TAKEOFF_V1, LAND_V1, TAKEOFF, LAND, TAKEOFF_VELOCITY, LAND_VELOCITY}:
            return self._vertical(command, data, time)
        if command in {GO_TO_V1, GO_TO}:
            if command == GO_TO:
                _, relative, linear, x, y, z, yaw, duration = struct.unpack_from("<BBBfffff", data)
            else:
                _, relative, x, y, z, yaw, duration = struct.unpack_from("<BBfffff", data)
                linear = False
            return self.planner.go_to((x, y, z), yaw, duration, time, relative=bool(relative), linear=bool(linear))
        if command == SPIRAL:
            _, sideways, clockwise, angle, r0, r1, ascent, duration = struct.unpack_from("<BBBfffff", data)
            return self.planner.spiral(
                angle, (r0, r1), ascent, duration, time, sideways=bool(sideways), clockwise=bool(clockwise)
            )
        return self._start(command, data, time)

    def _vertical(self, command: int, data: bytes, time: float) -> int:
        landing = command in {LAND_V1, LAND, LAND_VELOCITY}
        move = self.planner.land if landing else self.planner.takeoff
        if command in {TAKEOFF_V1, LAND_V1}:
            _, height, duration = struct.unpack_from("<Bff", data)
            return move(height, 0.0, duration, time)
        if command in {TAKEOFF, LAND}:
            _, height, yaw, keep_yaw, duration = struct.unpack_from("<Bff?f", data)
        else:
            _, height, relative, yaw, keep_yaw, velocity = struct.unpack_from("<Bf?f?f", data)
            z = self.planner.last.position[2]
            if relative:
                height = z - height if landing else z + height
            default = self._get("hlCommander.vland" if landing else "hlCommander.vtoff")
            duration = abs(height - z) / (velocity if velocity > 0 else default)
        return move(height, None if keep_yaw else yaw, duration, time)

    def _define(self, data: bytes) -> int:
        number, location, kind, offset, pieces = struct.unpack_from("<BBBIB", data)
        if number >= MAX_TRAJECTORIES:
            return ENOEXEC
        self._definitions[number] = (location, kind, offset, pieces)
        return 0

    def _start(self, command: int, data: bytes, time: float) -> int:
        if command == START:
            _, relative, relative_yaw, backwards, number, timescale = struct.unpack_from("<BBBBBf", data)
        else:
            _, relative, backwards, number, timescale = struct.unpack_from("<BBBBf", data)
            relative_yaw = False
        location, kind, offset, count = self._definitions.get(number, (0, 0, 0, 0))
        if location != 1:
            return 0 if command == START_V1 else ENOEXEC
        if kind == COMPRESSED:
            if timescale != 1.0 or backwards:
                return ENOEXEC
            pieces = unpack_compressed(bytes(self.memory), offset)
        else:
            pieces = unpack_poly4d(bytes(self.memory), offset, count)
        if not pieces or timescale <= 0.0 or any(not piece.duration >= 0.0 for piece in pieces):
            return ENOEXEC
        return self.planner.start_trajectory(
            pieces,
            time,
            timescale=timescale,
            backwards=bool(backwards),
            relative_position=bool(relative),
            relative_yaw=bool(relative_yaw),
        )
