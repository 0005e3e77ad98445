"""A drone made of a few lines for testing the flight loop: it is where it is told to be, on a clock that runs fast."""

import queue
import struct
import threading
import time
from types import SimpleNamespace

from crazyem.errors import LinkError
from crazyem.estimation.result import PARAMETER_UNITS, Estimate, ParameterEstimate
from crazyem.links.base import LinkLost, LinkStatistics, ParameterWrite
from crazyem.live.telemetry import ARMED, AUTO_ARM, CAN_ARM, CAN_FLY, FLYING
from crazyem.signals.sample import Block, Packet, Variable
from crazyem.signals.vocabulary import (
    EXTRA_VARIABLES,
    MOTOR_BLOCK,
    STATE_VARIABLES,
    WRENCH_VARIABLES,
    compress_quaternion,
)

LEVEL = float(compress_quaternion((0.0, 0.0, 0.0, 1.0)))
STEP = 20  # ms of the drone's clock between packets of a block: half of what a drone sends is enough
WAITING = 5  # packets of a block that a session may be behind: 0.1 s
AHEAD = 0.1  # s of the drone's clock that a flight may be behind
PATIENCE = 4000  # looks, a millisecond apart: a busy machine slows the looks as well as who is waited for
SAG = 0.3  # m below the wanted height until the believed mass is right
TRUTH = {"mass": 0.036, "Ixx": 2.0e-5, "Iyy": 2.1e-5, "Izz": 3.6e-5, "motor_time_constant": 0.06}


OPEN = SimpleNamespace(stale=lambda: "", misplaced=lambda purpose: "")  # a write gate that lets everything pass


def until(condition, seconds=60.0):
    """Wait for it, on a busy machine as well."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


def float32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


class FakeLink:
    """A Link; `speed` firmware seconds pass per second, fewer where it must not outrun a session (`follow`)."""

    def __init__(self, *, speed=20.0, controllers=(1, 5, 6), lose_echo_after=None, lost_at=None, nan_at=None,
                 silent_at=None):  # fmt: skip
        self.uri = "fake://0"
        self.packets = queue.SimpleQueue()
        self.speed = speed
        self.controllers = controllers
        self.lose_echo_after = lose_echo_after
        self.lost_at = lost_at
        self.nan_at = nan_at
        self.silent_at = silent_at
        self.log_variables = dict.fromkeys(
            (*STATE_VARIABLES, *MOTOR_BLOCK, *EXTRA_VARIABLES, *(f"ctrlLee.{n}" for n in WRENCH_VARIABLES)), "float"
        )
        self.values = {
            "stabilizer.controller": 1.0, "stabilizer.estimator": 2.0, "ctrlLee.mass": 0.029,
            "ctrlLee.J_x": 1.657e-5, "ctrlLee.J_y": 1.666e-5, "ctrlLee.J_z": 2.926e-5,
            "ctrlLee.KR_x": 0.007, "ctrlLee.KR_y": 0.007, "ctrlLee.KR_z": 0.008,
            "ctrlLee.Kw_x": 0.00115, "ctrlLee.Kw_y": 0.00115, "ctrlLee.Kw_z": 0.002,
        }  # fmt: skip
        self.calls = []
        self.blocks = []
        self.height = 0.0
        self.wanted = (0.2, 0.1, 0.0)
        self.low_level = False
        self.motors = False
        self.armed = True
        self.last_setpoint = 0.0
        self.writes = 0
        self.fm = 1000
        self._landing = False
        self._silent_since = None
        self._session = self._flight = None
        self._free_until = {"packets": 0, "samples": 0, "flight": 0}  # ms of its clock: until then it does not wait
        self._stop = threading.Event()
        self._thread = None

    parameters = property(lambda self: dict.fromkeys(self.values, "float"))

    def follow(self, session, flight=None):
        """Let no time pass while `session` has not digested what was sent, nor `flight` looked at it.

        A busy machine starves their threads.
        """
        self._session, self._flight = session, flight

    def host_clock(self):
        """Host time [s] on which the drone's runs as fast as it should, however busy this machine is."""
        silent = time.monotonic() - self._silent_since if self._silent_since is not None else 0.0
        return self.fm / 1000.0 / self.speed + silent

    def connect(self, timeout=15.0):
        pass

    def close(self):
        self._stop.set()
        if self._thread:
            self._thread.join()

    def subscribe(self, variables, rate_hz):
        block = Block(len(self.blocks), tuple(Variable(v, "float") for v in variables), int(1000 / rate_hz))
        self.blocks.append(block)
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()
        return (block,)

    def read_parameter(self, name, timeout=2.0):
        return self.values[name]

    def write_parameter(self, name, value, timeout=1.0):
        self.writes += name.startswith("ctrl")
        if self.lose_echo_after is not None and self.writes > self.lose_echo_after:
            return ParameterWrite(name, value, None, False, time.time())
        if name != "stabilizer.controller" or value in self.controllers:
            self.values[name] = float32(value)
        return ParameterWrite(name, value, float32(value), True, time.time())

    def statistics(self):
        return LinkStatistics(received=self.fm // STEP, lost=0)

    def arm(self, armed):
        self.calls.append("arm")
        self.armed = armed

    def take_off(self, height, duration):
        self.calls.append("take_off")
        if not self.low_level:
            self.wanted, self.motors, self._landing = (*self.wanted[:2], height), True, False

    def land(self, height, duration):
        self.calls.append("land")
        if not self.low_level:
            self.wanted, self._landing = (*self.wanted[:2], height), True

    def send_full_state(self, position, velocity, acceleration, quaternion, body_rate):
        self.calls.append("setpoint")
        if self.lost_at is not None and self.fm > self.lost_at:
            raise LinkError("gone")
        self.low_level, self.wanted, self.last_setpoint = True, tuple(position), self.fm

    def send_position(self, *a, **k):
        raise AssertionError

    def release_setpoints(self):
        self.calls.append("release")
        self.low_level = False

    def stop(self):
        self.calls.append("stop")
        self.motors = False
        self._flight = None  # it ends with this, and looks no more

    def _outruns(self):
        """What it would outrun: what receives, the estimator, or who flies and writes; "" if nothing."""
        s = self._session
        if s is None or s.failure is not None or s.lost is not None:
            return ""
        most = WAITING * len(self.blocks)
        if self.packets.qsize() > most:
            return "packets"
        waiting = self.packets.qsize() + (s._samples.qsize() if s._mailbox is None else len(s._mailbox._items))
        stalled = getattr(s.pipeline.estimator, "stalled", False)  # on purpose
        if waiting > most and not stalled and self.fm >= self._free_until["samples"]:
            return "samples"
        busy = self._unseen() or (s.pusher is not None and s.pusher.busy)
        return "flight" if busy and self.fm >= self._free_until["flight"] else ""

    def _unseen(self):
        flight = self._flight
        seen = flight._moved[0] if flight is not None else -1.0
        return seen >= 0.0 and self.fm / 1000.0 - seen > AHEAD  # not while it has seen nothing at all

    def _wait(self):
        what = ""
        for _ in range(PATIENCE):
            what = self._outruns()
            if self._stop.is_set() or not what:
                return
            time.sleep(0.001)
        self._free_until[what] = self.fm + 1000  # ms; it does not catch up, perhaps because it waits for the drone

    def send(self, packet):
        self.packets.put(packet)

    def _run(self):
        while not self._stop.is_set():
            self._wait()
            self.fm += STEP
            if self.lost_at is not None and self.fm > self.lost_at:
                self.packets.put(LinkLost("the link closed.", self.host_clock()))
                self._silent_since = time.monotonic()
                return
            if self.silent_at is not None and self.fm > self.silent_at:
                self._silent_since = time.monotonic()
                return
            sag = SAG * (0.036 - self.values["ctrlLee.mass"]) / 0.007
            goal = max(0.0, self.wanted[2] - sag) if self.motors else 0.0
            self.height += 0.0975 * (goal - self.height)
            if self._landing and self.height < 0.02:
                self.motors = False
            for block in tuple(self.blocks):
                values = tuple(self.value(v.name) for v in block.variables)
                self.send(Packet(block.identifier, self.fm, self.host_clock(), values))
            time.sleep(STEP / 1000.0 / self.speed)

    def value(self, name):
        if self.nan_at is not None and self.fm > self.nan_at and name == "acc.z":
            return float("nan")
        info = CAN_ARM | AUTO_ARM | CAN_FLY | (ARMED if self.armed else 0) | (FLYING if self.motors else 0)
        fixed = {
            "stateEstimateZ.x": 1e3 * self.wanted[0], "stateEstimateZ.y": 1e3 * self.wanted[1],
            "stateEstimateZ.z": 1e3 * self.height, "stateEstimateZ.quat": LEVEL,
            "ctrltargetZ.x": 1e3 * self.wanted[0], "ctrltargetZ.y": 1e3 * self.wanted[1],
            "ctrltargetZ.z": 1e3 * self.wanted[2], "supervisor.info": float(info), "pm.vbatMV": 3900.0, "acc.z": 1.0,
        }  # fmt: skip
        if name in MOTOR_BLOCK[:4]:
            return 40000.0 if self.motors else 0.0
        return fixed.get(name, 0.0)


class FakeEstimator:
    """Says `values` after some samples in the air, wider before.

    At sample `stall_at` in the air it hangs until `released`, at `fail_at` it fails.
    """

    def __init__(self, values=None, *, every=4, stall_at=None, fail_at=None):
        self.values = {**TRUTH, **(values or {})}
        self.airborne = False
        self.update_seconds = []
        self.every = every
        self.stall_at, self.released, self.stalled = stall_at, threading.Event(), False
        self.fail_at = fail_at
        self.n = 0
        self.updates = 0
        self.time = 0.0

    def feed(self, sample):
        if self.stall_at is not None and self.n >= self.stall_at:
            self.stalled = not self.released.is_set()  # the drone does not wait for it
            self.released.wait(600.0)
        if self.fail_at is not None and self.n >= self.fail_at:
            raise ValueError("boom")
        if sample.signal == "flying":
            self.airborne = sample.value[0] > 0
        if sample.signal != "position" or not self.airborne:
            return None
        self.n += 1
        self.time = sample.time
        return None if self.n % self.every else self.finish()

    def finish(self):
        self.updates += 1
        self.update_seconds.append(1e-4)
        parameters = {}
        for name, value in self.values.items():
            sd = 0.3 / max(self.n, 1) * value
            ci = (value - 2 * sd, value + 2 * sd)
            parameters[name] = ParameterEstimate(value, sd, ci, PARAMETER_UNITS[name], self.n > 50)
        return Estimate(self.time, parameters, samples=self.n, updates=self.updates, converged=True)
