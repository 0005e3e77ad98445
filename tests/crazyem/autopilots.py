"""A made-up autopilot for tests: pymavlink on a UDP socket, answering as PX4 or ArduPilot, with faults on request."""

import math
import socket
import struct
import threading
import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

PX4, ARDUPILOT = 12, 3
_PLACES = ((0.1, 0.1), (-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1))  # forward, right, of motors 1..4 of an X quad
PARAMETERS = {
    PX4: {
        "MPC_THR_HOVER": (0.5, 9), "MPC_USE_HTE": (1, 6),
        **{f"PWM_MAIN_FUNC{n}": (100 + n, 6) for n in range(1, 5)},
        **{f"PWM_MAIN_MIN{n}": (1000, 6) for n in range(1, 5)},
        **{f"PWM_MAIN_MAX{n}": (2000, 6) for n in range(1, 5)},
        **{f"CA_ROTOR{n}_P{a}": (v, 9) for n, place in enumerate(_PLACES) for a, v in zip("XY", place, strict=True)},
    },
    ARDUPILOT: {
        "MOT_THST_HOVER": (0.35, 9), "MOT_HOVER_LEARN": (2, 1), "MOT_PWM_MIN": (1100, 4), "MOT_PWM_MAX": (1900, 4),
        **{f"SERVO{n}_FUNCTION": (32 + n, 4) for n in range(1, 5)},
    },
}  # fmt: skip


class FakeAutopilot:
    """Calls a ground station at a port; call `stream` to let its clock go and messages come.

    Attributes to set: drop_replies (how many PARAM_VALUE are lost), wrong_echo, deaf, mute; `mangle` may change bytes.
    """

    def __init__(self, port, kind=PX4, *, system=1, old=False, modern=True):
        self.kind, self.old, self.modern = kind, old, modern
        self.packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self.parser = mavlink.MAVLink(None)
        self.parser.robust_parsing = True
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(0.01)
        self.parameters = dict(PARAMETERS[kind])
        self.ms = 10_000
        self.intervals, self.groups, self.writes, self.heard = {}, {}, [], []
        self.drop_replies = 0
        self.wrong_echo = self.deaf = self.mute = False
        self.mangle = lambda data: [data]
        self.uid = b""
        self.beating = True
        self._stop = threading.Event()
        self._lock = threading.RLock()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        self.socket.close()

    def send(self, message):
        with self._lock:
            data = bytes(message.pack(self.packer, force_mavlink1=self.old))
            self.packer.seq = (self.packer.seq + 1) % 256
            if self.mute:
                return
            for part in self.mangle(data):
                try:
                    self.socket.send(part)
                except OSError:  # nobody listens yet
                    return

    def _run(self):
        beat = 0.0
        while not self._stop.is_set():
            if self.beating and time.monotonic() - beat > 0.1:
                beat = time.monotonic()
                self.send(mavlink.MAVLink_heartbeat_message(2, self.kind, 128, 0, 4, 3))
            try:
                data = self.socket.recv(4096)
            except OSError:
                continue
            if not self.deaf:
                for message in self.parser.parse_buffer(data) or []:
                    self.heard.append(message)
                    getattr(self, f"_{message.get_type().lower()}", lambda m: None)(message)

    def _timesync(self, m):
        if m.tc1 == 0:
            self.send(mavlink.MAVLink_timesync_message(self.ms * 1_000_000, m.ts1))

    def _command_long(self, m):
        result = 0 if self.modern and m.command in (511, 512) else 3
        if m.command == 511 and self.modern:
            self.intervals[int(m.param1)] = m.param2
        if m.command == 512 and self.modern:
            version = [0] * 8
            self.send(
                mavlink.MAVLink_autopilot_version_message(
                    0, 0, 0, 0, 0, version, version, version, 0, 0, 0, list(self.uid.ljust(18, b"\0"))
                )
            )
        self.send(mavlink.MAVLink_command_ack_message(m.command, result))

    def _request_data_stream(self, m):
        self.groups[m.req_stream_id] = m.req_message_rate

    def _wire(self, value, kind):
        if self.kind == PX4 and kind != 9:
            return struct.unpack("<f", struct.pack("<i", int(value)))[0]
        return float(value)

    def _answer(self, name):
        value, kind = self.parameters[name]
        if self.drop_replies > 0:
            self.drop_replies -= 1
            return
        if self.wrong_echo:
            value = value * 1.01
        self.send(mavlink.MAVLink_param_value_message(name.encode(), self._wire(value, kind), kind, 9, 0))

    def _param_request_read(self, m):
        if m.param_id in self.parameters:
            self._answer(m.param_id)

    def _param_set(self, m):
        if m.param_id in self.parameters:
            self.writes.append((m.param_id, m.param_value))
            bits = self.kind == PX4 and m.param_type != 9
            value = struct.unpack("<i", struct.pack("<f", m.param_value))[0] if bits else m.param_value
            self.parameters[m.param_id] = (value, m.param_type)
            self._answer(m.param_id)

    def stream(self, seconds=0.1, step=10):
        """So much of its time, as fast as it goes."""
        for _ in range(round(1000 * seconds / step)):
            self.ms += step
            for message in self.instant():
                self.send(message)
            time.sleep(0.0005)

    def instant(self):
        ms, t = self.ms, self.ms / 1000.0
        duty = [0.5 + 0.01 * n for n in range(4)]
        yield mavlink.MAVLink_local_position_ned_message(ms, 0.1 * math.sin(t), 0.2, -1.0, 0.1, 0.0, 0.0)
        if self.kind == PX4:
            yield mavlink.MAVLink_attitude_quaternion_message(ms, 1.0, 0.01, 0.02, 0.03, 0.1, 0.2, 0.3)
            yield mavlink.MAVLink_actuator_output_status_message(ms * 1000, 4, duty + [0.0] * 28)
            yield mavlink.MAVLink_battery_status_message(0, 0, 3, 0, [4000, 4010, 4020] + [65535] * 7, 0, 0, 0, 70)
        else:
            yield mavlink.MAVLink_attitude_message(ms, 0.01, 0.02, 0.03, 0.1, 0.2, 0.3)
            pulses = [1100 + round(800 * d) for d in duty]
            yield mavlink.MAVLink_servo_output_raw_message(ms * 1000 % (1 << 32), 0, *pulses, 0, 0, 0, 0)
            yield mavlink.MAVLink_raw_imu_message(ms * 1000, 10, 20, -1000, 100, 200, 300, 0, 0, 0)
            yield mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12030, 0, 70, 0, 0, 0, 0, 0, 0)
        yield mavlink.MAVLink_extended_sys_state_message(0, 2)
