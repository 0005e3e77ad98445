"""Inertia from the simulator's MAVLink stream, hovering without moving: within its intervals, and not a fifth too high.

The simulator flies in this process; its frames go through the parts of a link, so that stamps, units and rounding are
those of a live session. What is true is known here only.
"""

from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from crazyem.estimation.online import ATTITUDE_PERIOD, OnlineEstimator
from crazyem.links.mavlink import streams
from crazyem.links.mavlink.frames import FrameParser
from crazyem.links.mavlink.receiver import DroneClock
from crazyem.signals.sample import Packet
from crazyem.signals.vocabulary import decoders
from crazyem.vehicle import load_vehicle
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.mavlink.autopilot import Autopilot
from firmware_sim.scenario import load_scenario

pytestmark = pytest.mark.slow
INERTIA = {"Ixx": 1.66e-5, "Iyy": 1.67e-5, "Izz": 2.93e-5}
MASS = 0.034
FAST, SLOW = (31, 32, 105, 375), (147, 245)  # messages, asked for at 100 Hz and 10 Hz
URI = "mavlink:udpin:0.0.0.0:14550"


def told(autopilot, number, *values):
    message = mavlink.MAVLink_command_long_message(1, 1, number, 0, *values, *(0.0,) * (7 - len(values)))
    autopilot.receive(bytes(message.pack(mavlink.MAVLink(None, srcSystem=254))))


def hover(folder: Path, seed: int, *, seconds: int = 12) -> list[bytes]:
    """Every frame that the drone sent, hovering at 1 m."""
    scenario = folder / "heavy.toml"
    scenario.write_text(f"[vehicle]\nmass = {MASS}\n", encoding="utf-8")
    facts = load_scenario(scenario)
    firmware = Firmware(Flight(facts, seed), platform=facts.platform, seed=seed, parameters=dict(facts.parameters))
    autopilot = Autopilot(firmware, thrust=0.48)
    autopilot.advance(500)
    for numbers, interval in ((FAST, 10_000), (SLOW, 100_000)):
        for number in numbers:
            told(autopilot, 511, number, interval)
    told(autopilot, 400, 1)
    autopilot.advance(1500)
    told(autopilot, 22, *(0.0,) * 6, 1.0)
    frames = []
    for _ in range(30 + 10 * seconds):
        autopilot.advance(100)
        frames += autopilot.outbox
        autopilot.outbox.clear()
    return frames


def samples_of(frames):
    """As a link and a session make them."""
    parser, clock, reader = FrameParser(), DroneClock(), streams.Streams()
    taken = [f for data in frames for f in parser.feed(data)]
    blocks = streams.blocks_of(reader.choose({f.name for f in taken}, raw_imu=False), 100.0)
    decode = decoders(blocks.values())
    for number, frame in enumerate(taken):
        if frame.name not in reader.messages:
            continue
        fields = frame.fields()
        stamp = clock.place(fields, 0.002 * number)
        found = reader.values(frame.name, fields) if stamp is not None and reader.uses(frame.name) else None
        if found is not None and found[0] in blocks:
            block = blocks[found[0]]
            yield from decode[block.identifier].decode(Packet(block.identifier, stamp, 0.0, found[1]))


def estimated(frames, period):
    estimator = OnlineEstimator(load_vehicle("cf2"), every=200, attitude_period=period)
    for sample in samples_of(frames):
        estimator.feed(sample)
    return estimator.finish().parameters


def test_hovering_inertia_is_within_its_intervals(tmp_path):
    off, off_with_all, held = [], [], 0
    for seed in range(4):
        frames = hover(tmp_path, seed)
        said, with_all = estimated(frames, ATTITUDE_PERIOD), estimated(frames, 0.0)
        off.append([said[n].value / true - 1 for n, true in INERTIA.items()])
        off_with_all.append([with_all[n].value / true - 1 for n, true in INERTIA.items()])
        held += sum(said[n].ci95[0] <= true <= said[n].ci95[1] for n, true in INERTIA.items())
        assert said["mass"].ci95[0] <= MASS <= said["mass"].ci95[1]
    assert held >= 0.9 * len(INERTIA) * len(off)
    assert np.sqrt(np.mean(np.square(off))) < 0.10
    # all attitudes, taken for independent, say that it is much larger: this is what the period is for
    assert np.mean(off_with_all) > 0.10
