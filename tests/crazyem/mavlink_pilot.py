"""Flies the MAVLink simulator for tests, with the real pymavlink, while somebody else watches it."""

import contextlib
import math
import socket
import subprocess
import sys
import threading
import time

from pymavlink import mavutil

TIMEOUT = 60.0  # s; only for a machine that hangs
PERIOD = 0.007  # s of the drone's time between setpoints: visits every place between two samples of 10 ms
# position, velocity, acceleration, yaw and its rate, in the local frame
EVERYTHING = 0


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@contextlib.contextmanager
def simulator(*wires, arguments=()):
    """A running MAVLink simulator; yields what it prints of its wires."""
    command = [sys.executable, "-m", "firmware_sim", *(w for wire in wires for w in ("--mavlink", wire)), *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert line.startswith("firmware_sim: mavlink:"), line + process.stderr.read()
            yield line.split()[1 : 1 + len(wires)]
        finally:
            process.terminate()
            process.communicate(timeout=TIMEOUT)


class Pilot:
    """A ground station at a port that the simulator calls. speed: of the simulator."""

    def __init__(self, port, *, speed=1.0):
        self.speed = speed
        self.link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=254)
        assert self.link.wait_heartbeat(timeout=TIMEOUT) is not None

    def forget(self):
        """What has piled up unread: taking it apart may take longer than it took to come."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self.link.port.recv(65536)

    def command(self, number, *values):
        for _ in range(40):
            self.forget()
            self.link.mav.command_long_send(1, 1, number, 0, *values, *(0.0,) * (7 - len(values)))
            ack = self.link.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.5)
            if ack is not None and ack.command == number and ack.result == 0:
                return
            time.sleep(0.1)
        raise AssertionError(f"command {number} was not accepted")

    def parameter(self, name):
        """Its value now."""
        for _ in range(20):
            self.forget()
            self.link.mav.param_request_read_send(1, 1, name.encode(), -1)
            answer = self.link.recv_match(type="PARAM_VALUE", blocking=True, timeout=0.5)
            if answer is not None and answer.param_id == name:
                return answer.param_value
        raise AssertionError(f"{name} was not answered")

    def fly(self, seconds, *, height=1.0):
        """Take off, follow curves with turns for so many seconds of the drone's time, land."""
        self.command(400, 1)
        self.command(22, *(0.0,) * 6, height)
        time.sleep((height + 2.0) / self.speed)
        self._follow(seconds, height)
        self.command(21)
        time.sleep(4.5 / self.speed)

    def _follow(self, seconds, height):
        begun = time.monotonic()
        entered = threading.Event()

        def enter():
            self.command(176, 1, 6, 0)
            entered.set()

        thread = threading.Thread(target=enter)
        while (t := (time.monotonic() - begun) * self.speed) < seconds:
            self._setpoint(t, height)
            if t > 0.1 and thread.ident is None:
                thread.start()
            time.sleep(PERIOD / self.speed)
        thread.join()
        assert entered.is_set()

    def _setpoint(self, t, height):
        """Lissajous curves that begin at rest, as sums of one sine an axis; NED."""
        grown = min(t / 3.0, 1.0)

        def sine(amplitude, rate, phase=0.0):
            a, w = amplitude * grown, rate
            s, c = math.sin(w * t + phase), math.cos(w * t + phase)
            return a * s, a * w * c, -a * w * w * s

        x, y, z = sine(0.35, 2.6), sine(0.35, 1.9), sine(0.12, 3.1)
        yaw, yaw_rate, _ = sine(0.6, 2.2)
        place, speed, push = zip(x, y, z, strict=True)
        self.link.mav.set_position_target_local_ned_send(
            0, 1, 1, 1, EVERYTHING, place[0], place[1], place[2] - height, *speed, *push, yaw, yaw_rate
        )

    def close(self):
        self.link.close()
