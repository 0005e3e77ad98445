"""The simulated drone as a PX4 autopilot: MAVLink bytes in, time forward, MAVLink bytes out; no socket, no clock.

Modes: take-off, hold, land (the high-level planner flies) and offboard (the client's setpoints).
Sources: mavlink.io/en/services (command, parameter, offboard control), PX4 v1.15 px4_custom_mode.h, Commander.
"""

import contextlib
import math
import struct
from collections import deque
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from firmware_sim.commander import setpoint as sp
from firmware_sim.commander.setpoint import CRTP
from firmware_sim.commander.supervisor import State
from firmware_sim.firmware import Firmware
from firmware_sim.mavlink.parameters import Parameters
from firmware_sim.mavlink.telemetry import Telemetry, turned

LEE = 5.0  # the controller that takes a mass
MANUAL, HOLD, OFFBOARD, TAKEOFF, LAND = (1, 0), (4, 3), (6, 0), (4, 2), (4, 6)  # main and sub mode of PX4
_ACCEPTED, _TEMPORARILY_REJECTED, _DENIED, _UNSUPPORTED, _FAILED = range(5)
_FASTEST_US = 1000  # shortest interval of a stream
_TARGET_MASKS = 0x007, 0x038, 0x1C0  # ignore position, velocity, acceleration
_OFFBOARD_FRESH = 500  # ms within which a setpoint must have come for offboard
_MOST_WAITING = 4096  # frames that wait for a slow wire
# messages that are streamed without a request: message -> us
_BY_ITSELF = {0: 1_000_000, 1: 1_000_000, 245: 1_000_000, 147: 2_000_000, 30: 100_000, 32: 100_000}
# MAV_DATA_STREAM -> messages
_GROUPS = {1: (105,), 2: (1, 147, 245), 3: (375,), 6: (32, 85), 10: (30, 31), 11: ()}


class Autopilot:
    """A booted autopilot.

    Args:
        firmware: the drone; the autopilot is its only client.
        thrust: N, largest total thrust of the four rotors by the firmware's constants.

    Attributes:
        outbox: frames to be sent.
    """

    def __init__(self, firmware: Firmware, *, thrust: float) -> None:
        self.firmware = firmware
        self.outbox: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self.mode = MANUAL
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parsers: dict[int, Any] = {}
        self._mass = firmware.flight.param["ctrlLee.mass"]
        controller, index = firmware.flight.param["stabilizer.controller"]
        controller[index] = LEE
        firmware.flight.parameter_written("stabilizer.controller")
        self.parameters = Parameters(mass=self._get(self._mass), thrust=thrust, believe=self._believe)
        self._believe(self.parameters.by_name["MPC_THR_HOVER"].wire() * thrust / 9.81)
        self.telemetry = Telemetry(
            {**firmware.flight.log, **firmware.supervisor.log}, tick=lambda: firmware.flight.tick, beat=self._beat
        )
        self._due: dict[int, int] = {}
        self._intervals: dict[int, int] = {}
        for number, interval in _BY_ITSELF.items():
            self._set_interval(number, interval)
        self._list: deque[int] = deque()  # parameters still to be sent
        self._client_setpoint = -math.inf  # tick of the newest

    @staticmethod
    def _get(slot: tuple[np.ndarray, int]) -> float:
        return float(slot[0][slot[1]])

    def _believe(self, mass: float) -> None:
        self._mass[0][self._mass[1]] = mass

    # Time.

    def next_event(self) -> int:
        """The tick [ms] before which the autopilot sends nothing of its own accord."""
        tick = self.firmware.flight.tick
        if self._list:
            return tick + 1
        return max(min(self._due.values(), default=tick + 10), tick + 1)

    def advance(self, milliseconds: int) -> None:
        """Let time pass; streams are sent when due."""
        flight = self.firmware.flight
        end = flight.tick + milliseconds
        while flight.tick < end:
            self.firmware.advance(min(end, self.next_event()) - flight.tick)
            self.firmware.outbox.clear()  # there is no CRTP client
            self._watch()
            self._stream(flight.tick)

    def _watch(self) -> None:
        """End modes whose end has come: a finished take-off, offboard without setpoints."""
        firmware, tick = self.firmware, self.firmware.flight.tick
        self.telemetry.setpoint = firmware.flight.setpoint
        finished = firmware.high_level.planner.finished(tick / 1000.0)
        flying = firmware.supervisor.flying and not (self.mode == LAND and not firmware.high_level.planner.active)
        landing = {TAKEOFF: 3, LAND: 4}.get(self.mode, 2)
        self.telemetry.landed = landing if flying else 1
        if self.mode == TAKEOFF and finished:
            self.mode = HOLD
        elif self.mode == OFFBOARD:
            patience = 1000.0 * self.parameters.by_name["COM_OF_LOSS_T"].value
            if tick - self._client_setpoint > min(patience, 450.0):  # before the firmware levels out
                self._hold("Offboard control lost")

    def _stream(self, tick: int) -> None:
        for number, due in list(self._due.items()):
            if tick < due:
                continue
            interval = self._intervals[number]
            self._due[number] = due + interval if due + interval > tick else tick + interval
            self._emit(number)
        for _ in range(min(len(self._list), 2)):
            self._send_parameter(self._list.popleft())

    def _emit(self, number: int) -> None:
        message = self.telemetry.makers[number]()
        if message is not None:
            self._send(message)

    def _send(self, message: Any) -> None:
        self.outbox.append(bytes(message.pack(self._packer)))
        self._packer.seq = (self._packer.seq + 1) % 256

    def _say(self, text: str, severity: int = 6) -> None:
        self._send(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))

    def _beat(self) -> Any:
        supervisor = self.firmware.supervisor
        armed = supervisor.armed and supervisor.state not in {State.LOCKED, State.CRASHED}
        ill = supervisor.state in {State.LOCKED, State.CRASHED, State.FREE_FALL}
        state = 6 if ill else 4 if armed and supervisor.flying else 3
        main, sub = self.mode
        return mavlink.MAVLink_heartbeat_message(2, 12, 1 | 128 * armed, main << 16 | sub << 24, state, 3)

    # Messages in.

    def receive(self, data: bytes, *, channel: int = 0) -> None:
        """Take any bytes from a client; each channel is a separate stream."""
        if channel not in self._parsers:
            self._parsers[channel] = mavlink.MAVLink(None)
            self._parsers[channel].robust_parsing = True
        try:
            messages = self._parsers[channel].parse_buffer(data) or []
        except (mavlink.MAVError, struct.error, ValueError, KeyError, IndexError, TypeError):
            return  # pymavlink raises on some damaged bytes
        for message in messages:
            handler = getattr(self, f"_on_{message.get_type().lower()}", None)
            target = getattr(message, "target_system", 0)
            if handler is not None and target in (0, self._packer.srcSystem):
                with contextlib.suppress(ValueError, ArithmeticError):
                    handler(message)

    def _on_timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self.firmware.flight.tick * 1_000_000, message.ts1))

    def _on_param_request_list(self, _: Any) -> None:
        self._list = deque(range(len(self.parameters.items)))

    def _on_param_request_read(self, message: Any) -> None:
        if message.param_index >= 0:
            if message.param_index < len(self.parameters.items):
                self._send_parameter(message.param_index)
            return
        self._answer_parameter(message.param_id)

    def _on_param_set(self, message: Any) -> None:
        self.parameters.set(message.param_id.rstrip("\0"), message.param_value, message.param_type)
        self._answer_parameter(message.param_id)

    def _answer_parameter(self, name: str) -> None:
        for index, parameter in enumerate(self.parameters.items):
            if parameter.name == name.rstrip("\0"):
                self._send_parameter(index)

    def _send_parameter(self, index: int) -> None:
        p, count = self.parameters.items[index], len(self.parameters.items)
        self._send(mavlink.MAVLink_param_value_message(p.name.encode(), p.wire(), p.kind, count, index))

    def _on_request_data_stream(self, message: Any) -> None:
        wanted = tuple(_GROUPS) if message.req_stream_id == 0 else (message.req_stream_id,)
        for number in (n for g in wanted for n in _GROUPS.get(g, ())):
            self._set_interval(number, round(1e6 / max(message.req_message_rate, 1)) if message.start_stop else -1)

    def _on_set_mode(self, message: Any) -> None:
        self._change_mode(message.custom_mode >> 16 & 255, message.custom_mode >> 24 & 255)

    def _on_command_long(self, message: Any) -> None:
        number = int(message.command)
        handlers = {
            21: self._land,
            22: lambda: self._take_off(message.param7),
            176: lambda: self._change_mode(int(message.param2), int(message.param3)),
            400: lambda: self._arm(message.param1),
            511: lambda: self._set_interval(int(message.param1), int(message.param2)),
            512: lambda: self._request(int(message.param1)),
        }
        result = handlers[number]() if number in handlers else _UNSUPPORTED
        self._send(mavlink.MAVLink_command_ack_message(number, result))

    def _on_set_position_target_local_ned(self, message: Any) -> None:
        """A setpoint; it acts in offboard mode only, but is needed to enter this mode."""
        setpoint = self._setpoint_of(message)
        if setpoint is None or not np.isfinite(setpoint).all():
            return
        self._client_setpoint = self.firmware.flight.tick
        if self.mode == OFFBOARD and self.firmware.supervisor.can_fly:
            self.firmware.arbiter.offer(setpoint, CRTP, self.firmware.flight.tick)

    def _setpoint_of(self, m: Any) -> np.ndarray | None:
        if m.coordinate_frame != 1:  # MAV_FRAME_LOCAL_NED
            return None
        no_position, no_velocity, no_acceleration = (bool(m.type_mask & mask) for mask in _TARGET_MASKS)
        if no_position:
            return None  # the Lee controller flies to places
        out = sp.null_setpoint()
        out[[sp.MODE_X, sp.MODE_Y, sp.MODE_Z]] = sp.ABSOLUTE
        out[sp.X : sp.Z + 1] = turned((m.x, m.y, m.z))
        if not no_velocity:
            out[sp.VX : sp.VZ + 1] = turned((m.vx, m.vy, m.vz))
        if not no_acceleration:
            out[sp.AX : sp.AZ + 1] = turned((m.afx, m.afy, m.afz))
        out[sp.MODE_YAW] = sp.ABSOLUTE
        if not m.type_mask & 0x400:
            out[sp.YAW] = -math.degrees(m.yaw)
        if not m.type_mask & 0x800:
            out[sp.RATE_YAW] = -math.degrees(m.yaw_rate)
        return out

    # Commands; each returns a MAV_RESULT.

    def _set_interval(self, number: int, interval_us: int) -> int:
        if number not in self.telemetry.makers:
            return _UNSUPPORTED
        if interval_us < 0:
            self._due.pop(number, None)
            return _ACCEPTED
        if interval_us == 0:
            interval_us = _BY_ITSELF.get(number, 1_000_000)
        interval = max(round(max(interval_us, _FASTEST_US) / 1000.0), 1)
        self._intervals[number] = interval
        tick = self.firmware.flight.tick
        # aligned to the clock, so that streams of one rate are sampled together
        self._due[number] = (tick // interval + 1) * interval
        return _ACCEPTED

    def _request(self, number: int) -> int:
        if number not in self.telemetry.makers:
            return _UNSUPPORTED
        self._emit(number)
        return _ACCEPTED

    def _arm(self, wanted: float) -> int:
        supervisor = self.firmware.supervisor
        if not wanted and supervisor.flying and self.telemetry.landed != 1:
            return _DENIED
        return _ACCEPTED if supervisor.request_arming(bool(wanted)) else _TEMPORARILY_REJECTED

    def _take_off(self, altitude: float) -> int:
        if not self.firmware.supervisor.can_fly or not self.firmware.supervisor.armed:
            return _TEMPORARILY_REJECTED
        height = altitude if math.isfinite(altitude) and altitude > 0.05 else None
        height = min(height or self.parameters.by_name["MIS_TAKEOFF_ALT"].value, 10.0)
        self._relax()
        if self.firmware.high_level.planner.takeoff(height, None, 1.0 + height, self.firmware.flight.tick / 1000.0):
            return _TEMPORARILY_REJECTED
        self.mode = TAKEOFF
        self._say(f"Takeoff to {height:.1f} m")
        return _ACCEPTED

    def _land(self) -> int:
        self._relax()
        height = max(self.telemetry.position()[2], 0.2)
        self.firmware.high_level.planner.land(0.0, None, 1.0 + 1.5 * height, self.firmware.flight.tick / 1000.0)
        self.mode = LAND
        self._say("Landing")
        return _ACCEPTED

    def _hold(self, why: str = "") -> int:
        self._relax()
        if self.firmware.supervisor.flying:
            planner, now = self.firmware.high_level.planner, self.firmware.flight.tick / 1000.0
            planner.go_to(self.telemetry.position(), planner.last.yaw, 1.0, now)
        self.mode = HOLD
        if why:
            self._say(why, 4)
        return _ACCEPTED

    def _relax(self) -> None:
        if self.mode == OFFBOARD:
            self.firmware.arbiter.relax()

    def _change_mode(self, main: int, sub: int) -> int:
        if main == OFFBOARD[0]:
            if self.firmware.flight.tick - self._client_setpoint > _OFFBOARD_FRESH:
                return _TEMPORARILY_REJECTED
            self.mode = OFFBOARD
            return _ACCEPTED
        actions = {HOLD: self._hold, LAND: self._land, TAKEOFF: lambda: self._take_off(math.nan)}
        if (main, sub) in actions:
            return actions[main, sub]()
        return _UNSUPPORTED
