"""A client in the process of the firmware, byte for byte, and a flight that is none."""

import struct

import numpy as np

from firmware_sim import tables, wire
from firmware_sim.commander import setpoint as sp
from firmware_sim.firmware import Firmware

LOG = [
    *(f"stateEstimate.{n}" for n in ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw")),
    *(f"{group}.{axis}" for group in ("gyro", "acc") for axis in "xyz"),
    *(f"motor.m{n}" for n in range(1, 5)),
    "pm.vbat",
    "pm.state",
    *(f"filler{n}.value" for n in range(140)),
]


PARAM = {"ctrlLee.mass": 0.029, "ctrlMel.mass": 0.03, "stabilizer.controller": 5.0, "powerDist.idleThrust": 7000.0}


class FakeFlight:
    """The estimate is where the setpoint is, once the motors may turn."""

    def __init__(self):
        self.tick = 0
        self.log, self.param = tables.slots(dict.fromkeys(LOG, 0.0)), tables.slots(PARAM)
        self.param_defaults = dict(PARAM)
        self.setpoint = sp.null_setpoint()
        self.motors_allowed = self.armed = False
        self.written, self.fixes = [], []
        self.set("acc.z", 1.0)
        self.set("pm.vbat", 4.1)

    def set(self, name, value):
        array, index = self.log[name]
        array[index] = value

    def parameter_written(self, name):
        self.written.append(name)
        array, index = self.param["stabilizer.controller"]
        if name == "stabilizer.controller" and array[index] == 0:
            array[index] = 5.0

    def external_position(self, position):
        self.fixes.append(np.round(position, 6).tolist())

    def external_pose(self, position, quaternion):
        self.fixes.append(np.round(np.concatenate([position, quaternion]), 2).tolist())

    def step(self):
        self.tick += 1
        flying = self.motors_allowed and self.setpoint[sp.MODE_Z] != 0
        self.set("motor.m1", 30000.0 if flying else 0.0)
        if flying:
            self.set("stateEstimate.z", self.setpoint[sp.Z])


class Client:
    """Talks to a firmware without sockets."""

    def __init__(self, platform="cf2", **kwargs):
        self.flight = FakeFlight()
        self.firmware = Firmware(self.flight, platform=platform, seed=1, **kwargs)
        self.firmware.advance(201)
        self.ask(wire.LINK, 0, b"")
        self.outgoing()

    def outgoing(self):
        packets = [wire.decode(datagram) for datagram, _ in self.firmware.outbox]
        self.firmware.outbox.clear()
        return packets

    def ask(self, port, channel, data):
        """The data of every reply on the same port and channel."""
        self.firmware.receive(wire.Packet(port, channel, bytes(data)))
        return [bytes(p.data) for p in self.outgoing() if p[:2] == (port, channel)]

    def log_id(self, name):
        return [item.name for item in self.firmware.log.table.items].index(name)

    def param_id(self, name):
        return struct.pack("<H", [item.name for item in self.firmware.param.table.items].index(name))

    def create(self, number, names, kind=7, command=6):
        body = b"".join(struct.pack("<BH", kind, self.log_id(name)) for name in names)
        return self.ask(5, 1, bytes((command, number)) + body)[0]


def client_fixture():
    return Client()
