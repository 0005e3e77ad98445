"""Two flights recorded from the real firmware, flown again by the simulated one from the same commands and setpoints.

Real: C firmware of August 2026, Lee's controller, rotor lag 30 ms, a body without noise or drag, cell at 4.0 V (at
3.9 V brushless); take-off, a figure by full-state setpoints, a place by the high-level commander, landing. Its sender's
formula is known to 3 mm (below). Tolerances: the host's and the firmware's clocks slipped by up to 50 ms against each
other during the recordings, and the recorded truth of the first differs from the recorded estimate by 25 mm rms in x
and 37 mm in y for that reason, at the best shift.
"""

import csv
import gzip
import struct
from pathlib import Path

import numpy as np
import pytest

from firmware_sim import wire
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters, variables
from firmware_sim.controllers.power_distribution import motors_step
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.plant import layout as at
from firmware_sim.plant.platforms import PLATFORMS
from firmware_sim.plant.rotors import lag, wrench
from firmware_sim.scenario import parse_scenario

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "real_firmware"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the shared recordings are not beside this checkout")

HL_ACTIVE, HL_FINISHED = 0x100, 0x200
SLIP = 0.05  # s between the recording's clocks
UPDATE = 30  # ms between a command and the supervisor's next bits, on average 20 and 10 of the log
FOERSTER = PLATFORMS["cf2"].inertia


FLIGHT = "lee_34g_mass_pushed_midflight"


def rows(name):
    with gzip.open(FOLDER / f"{name}.csv.gz", "rt") as file:
        return list(csv.DictReader(file))


class Recording:
    """Series by name (host s, firmware ms, value); setpoints of the figure: sent at [firmware ms], s of the figure."""

    def __init__(self, name):
        series = {}
        for row in rows(name):
            series.setdefault(row["name"], []).append((float(row["host_t"]), int(row["fw_ms"]), float(row["value"])))
        self.series = {name: np.array(values).T for name, values in series.items()}
        host, ms, _ = self.series["stateEstimateZ.z"]
        late = host - ms / 1000.0  # delay of the packets, the slip of the clocks in it: its lower edge
        edge = np.minimum.accumulate(late[::-1])[::-1]
        sent = self.series["ref.x"][0]
        self.sent = np.round(1000.0 * (sent - np.interp(sent, host, edge))).astype(int)
        self.phase = sent - sent[0]

    def at(self, name, ms):
        _, stamps, values = self.series[name]
        return np.interp(ms, stamps, values)

    def commands(self):
        """ms of take-off, go-to and landing: when the high-level commander became active."""
        _, ms, info = self.series["supervisor.info"]
        bits = info.astype(int)
        going = (bits & HL_ACTIVE > 0) & (bits & HL_FINISHED == 0)
        starts = ms[1:][going[1:] & ~going[:-1]]
        return starts.astype(int) - UPDATE

    def push(self):
        """ms at which the believed mass was changed: the wanted force jumps by a sixth."""
        _, ms, force = self.series["ctrlLee.thrustSi"]
        inside = (ms > self.sent[0]) & (ms < self.sent[-1])
        return int(ms[inside][np.argmax(np.diff(force[inside]))])


def figure(t):
    """Position, velocity, acceleration of the recorded sender's figure at t [s]: m, m/s, m/s^2."""
    w, u = np.pi / 2, min(t / 3.0, 1.0)
    e = np.array([u * u * (3 - 2 * u), (2 * u - 2 * u * u), (2 - 4 * u) / 3.0])
    if t >= 3.0:
        e[1:] = 0.0
    out = np.zeros((3, 3))
    for axis, (a, k) in enumerate(((0.5, w), (0.3, 2 * w), (0.15, 1.5 * w))):
        s, c = a * np.sin(k * t), a * k * np.cos(k * t)
        out[:, axis] = e[0] * s, e[1] * s + e[0] * c, e[2] * s + 2 * e[1] * c - e[0] * k * k * s
    out[0, 2] += 1.0
    return out


def events(recording, *, arm):
    """(ms, packet) of everything that was sent."""
    takeoff, goto, land = recording.commands()
    hl = wire.SETPOINT_HIGH_LEVEL
    out = [(takeoff, wire.Packet(hl, 0, struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 2.5)))]
    for ms, t in zip(recording.sent, recording.phase, strict=True):
        numbers = [int(1000 * v) for v in figure(t).ravel()]
        packet = b"\x06" + struct.pack("<9hI3h", *numbers, 3 << 30, 0, 0, 0)
        out.append((int(ms), wire.Packet(wire.SETPOINT_GENERIC, 0, packet)))
    out.append((goto - 1, wire.Packet(wire.SETPOINT_GENERIC, 1, b"\0" + bytes(4))))
    out.append((goto, wire.Packet(hl, 0, struct.pack("<BBBBfffff", 12, 0, 0, 0, 0.0, 0.0, 1.0, 0.0, 2.0))))
    out.append((land, wire.Packet(hl, 0, struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 2.5))))
    if arm:
        out.append((takeoff - 1000, wire.Packet(wire.SUPERVISOR, 1, b"\x01\x01")))
    return sorted(out, key=lambda event: event[0])


NAMES = [*(f"stateEstimateZ.{a}" for a in "xyz"), "ctrlLee.thrustSi", "motor.m1", "gyro.x", "gyro.z", "acc.z"]


def fly_again(recording, table, *, believed=None, pushed=None):
    """Stamps [ms] and the named variables, every 10 ms; pushed: ctrlLee.mass in kg, when it was in the recording."""
    quiet = {
        "noise": {"thrust": 0.0, "torque": 0.0},
        "battery": {"resistance": 0.0, "noise": 0.0, "capacity": 100.0, "charge": table.pop("charge")},
        "sensors": dict.fromkeys(("gyro_noise", "gyro_bias", "gyro_bias_walk", "accelerometer_noise"), 0.0),
        "estimator": {"position_noise": 0.0, "attitude_noise": 0.0},
    }
    scenario = parse_scenario({**table, **quiet}, "test")
    parameters = {"stabilizer.controller": 5.0} | ({"ctrlLee.mass": believed} if believed else {})
    firmware = Firmware(Flight(scenario, 1), platform=scenario.platform, seed=1, parameters=parameters)
    todo = events(recording, arm=scenario.platform == "cf21bl")
    push = recording.push()
    stamps, rows = [], []
    end = int(recording.series["motor.m1"][1].max())
    while firmware.flight.tick < end:
        tick = firmware.flight.tick
        while todo and todo[0][0] <= tick:
            firmware.receive(todo.pop(0)[1])
        if pushed is not None and tick >= push:
            firmware.param.set(firmware.param.table.by_name["ctrlLee.mass"], pushed)
        firmware.advance(10)
        firmware.outbox.clear()
        stamps.append(firmware.flight.tick)
        rows.append([firmware.log.table.by_name[name].value for name in NAMES])
    return np.array(stamps), {
        name: np.array(column) for name, column in zip(NAMES, zip(*rows, strict=True), strict=True)
    }


@pytest.fixture(scope="module")
def brushed():
    recording = Recording(FLIGHT)
    table = {"vehicle": {"mass": 0.034, "motor_time_constant": 0.03}, "charge": 0.68}  # 4.0 V
    return recording, *fly_again(recording, table, believed=0.029, pushed=0.034)


@pytest.fixture(scope="module")
def brushless():
    recording = Recording("lee_brushless_39g")
    vehicle = {"mass": 0.0393, "inertia": list(FOERSTER), "motor_time_constant": 0.03}
    return recording, *fly_again(recording, {"platform": "cf21bl", "vehicle": vehicle, "charge": 0.52})  # 3.9 V


@pytest.fixture(params=["brushed", "brushless"])
def both(request):
    return request.getfixturevalue(request.param)


def test_the_senders_formula_is_the_recorded_setpoints(both):
    recording = both[0]
    for axis, name in enumerate("xyz"):
        made = [figure(t)[0, axis] for t in recording.phase]
        np.testing.assert_allclose(made, recording.series[f"ref.{name}"][2], atol=0.004)


def test_positions_in_the_figure_are_the_recorded_ones(both):
    recording, ms, flown = both
    inside = (ms > recording.sent[0] + 1500) & (ms < recording.sent[-1])
    for axis, (rms, correlation) in zip("xyz", ((0.045, 0.99), (0.055, 0.975), (0.03, 0.98)), strict=True):
        name = f"stateEstimateZ.{axis}"
        real, ours = recording.at(name, ms)[inside] / 1000.0, flown[name][inside] / 1000.0
        assert np.sqrt(np.mean((real - ours) ** 2)) < rms, axis
        assert np.corrcoef(real, ours)[0, 1] > correlation, axis
        assert np.std(ours) == pytest.approx(np.std(real), rel=0.06), axis


def best_lag(ms, signal, stamps, reference):
    """s by which the signal follows the reference: the shift with the smallest difference."""
    shifts = np.arange(-100, 200, 2)
    return shifts[np.argmin([np.std(signal - np.interp(ms - s, stamps, reference)) for s in shifts])] / 1000.0


def test_the_drone_follows_the_figure_without_a_lag_as_the_real_one_does(both):
    """Feedforward: both within the slip of the clocks; without the acceleration ours would be 0.15 to 0.26 s behind."""
    recording, ms, flown = both
    inside = (ms > recording.sent[0] + 3000) & (ms < recording.sent[-1])
    reference = 1000.0 * np.array([figure(t)[0, 0] for t in recording.phase])
    real = recording.at("stateEstimateZ.x", ms)
    for signal in (real, flown["stateEstimateZ.x"]):
        assert abs(best_lag(ms[inside], signal[inside], recording.sent, reference)) < 0.05


def test_take_off_is_the_recorded_one(brushed):
    recording, ms, flown = brushed
    inside = (ms > recording.commands()[0]) & (ms < recording.sent[0])
    real = recording.at("stateEstimateZ.z", ms)[inside]
    assert real.max() > 700.0
    assert flown["stateEstimateZ.z"][inside] == pytest.approx(real, abs=30.0)  # mm; the estimates are that noisy


def test_hover_before_the_figure_is_the_recorded_one(both):
    """Hanging low by the believed mass, force and motor command (at the recorded voltage)."""
    recording, ms, flown = both
    takeoff = recording.commands()[0]
    inside = (ms > takeoff + 3400) & (ms < recording.sent[0] - 100)
    means = {name: (recording.at(name, ms)[inside].mean(), flown[name][inside].mean()) for name in NAMES}
    assert means["stateEstimateZ.z"][1] == pytest.approx(means["stateEstimateZ.z"][0], abs=2.0)  # mm
    assert means["ctrlLee.thrustSi"][1] == pytest.approx(means["ctrlLee.thrustSi"][0], rel=1.5e-3)
    volts = recording.at("pm.vbatMV", ms)[inside].mean() / 1000.0
    ours = 4.0 if volts > 3.95 else 3.9
    assert ours * means["motor.m1"][1] == pytest.approx(volts * means["motor.m1"][0], rel=5e-3)


def test_the_step_of_believed_mass_settles_as_recorded(brushed):
    """Height error in means of a second; the push is at half of the figure.

    The clocks slipped by 53 ms in the half second after it: a mean is known to 0.05 s times how fast the error moves.
    """
    recording, ms, flown = brushed
    push = recording.push()
    wanted = np.interp(ms, recording.sent, [1000.0 * figure(t)[0, 2] for t in recording.phase])
    assert abs(push - recording.sent.mean()) < 1000
    for start in range(-3000, 5000, 1000):
        inside = (ms >= push + start) & (ms < push + start + 1000)
        real = (recording.at("stateEstimateZ.z", ms) - wanted)[inside].mean()
        error = (flown["stateEstimateZ.z"] - wanted)[inside]
        slip = SLIP * np.abs(np.gradient(error, 0.01)).max()  # mm
        assert error.mean() == pytest.approx(real, abs=10.0 + slip), start
        if start < -1000 or start > 2000:
            assert real == pytest.approx(-265.0 if start < 0 else -30.0, abs=35.0)


def test_how_hard_it_works_is_as_recorded(both):
    """Standard deviations over the figure: force, motor command, body rates, specific force."""
    recording, ms, flown = both
    inside = (ms > recording.sent[0] + 1500) & (ms < recording.sent[-1])
    for name, tolerance in (("ctrlLee.thrustSi", 0.1), ("motor.m1", 0.1), ("gyro.x", 0.15), ("acc.z", 0.12)):
        real, ours = recording.at(name, ms)[inside].std(), flown[name][inside].std()
        assert ours == pytest.approx(real, rel=tolerance), name


def test_go_to_and_landing_are_as_recorded(both):
    recording, ms, flown = both
    _, goto, land = recording.commands()
    end = min(land + 2400, ms[-1])
    for name in (f"stateEstimateZ.{a}" for a in "xyz"):
        inside = (ms > goto + 1500) & (ms < end)
        difference = recording.at(name, ms)[inside] - flown[name][inside]
        assert np.abs(difference).max() < 60.0, name  # mm


# The thrust law and the power distribution against the same flight: bookkeeping, not the law


def test_force_and_torque_of_the_recorded_commands() -> None:
    table = rows(f"{FLIGHT}.truth")
    log = {key: np.array([float(row[key]) for row in table]) for key in table[0]}
    truth = parse_scenario({"vehicle": {"motor_time_constant": 0.03, "thrust_max": 1.0}}, "test").truth()
    state, mean, u = np.zeros(at.STATE_SIZE), np.empty(4), np.empty(4)
    rebuilt = np.empty((len(table), 4))
    for n in range(len(table)):
        state[at.PWM : at.PWM + 4] = [log[f"pwm{i}"][n] for i in range(1, 5)]
        state[at.VOLTS] = log["vbat"][n]
        if n:
            lag(truth, state, log["t"][n] - log["t"][n - 1], mean)
        wrench(truth, state, at.ROTOR, u)
        rebuilt[n] = u
    flying = (log["pz"] > 0.3) & (log["t"] > 5)
    true = np.column_stack([log[k] for k in ("F", "Mx", "My", "Mz")])[flying]
    error = rebuilt[flying] - true
    assert np.abs(error.mean(axis=0)) == pytest.approx([0, 0, 0, 0], abs=1e-3)
    assert abs(error[:, 0].mean()) < 1e-3 * true[:, 0].mean()
    for axis in range(4):
        assert np.corrcoef(rebuilt[flying][:, axis], true[:, axis])[0, 1] > 0.95


def test_power_distribution_gives_the_recorded_commands() -> None:
    """Lee's logged force and torque through ours; the command log is the closest sample of another block."""
    series: dict[str, list[tuple[int, float]]] = {}
    for row in rows(FLIGHT):
        if row["block"] in ("lee", "mot"):
            series.setdefault(row["name"], []).append((int(row["fw_ms"]), float(row["value"])))
    wish = {k: dict(series[f"ctrlLee.{k}"]) for k in ("thrustSi", "torquex", "torquey", "torquez")}
    got = {k: dict(series[k]) for k in ("motor.m1", "motor.m2", "motor.m3", "motor.m4", "pm.vbatMV")}
    board = parse_scenario({}, "test").board()
    param = np.array([parameters.defaults("cf2")[name] for name in parameters.PARAMETER_NAMES])
    errors = []
    for t in sorted(set(wish["thrustSi"]) & set(got["motor.m1"])):
        if wish["thrustSi"][t] < 0.2:
            continue
        state, sensor, memory = np.zeros(at.STATE_SIZE), np.zeros(at.SENSOR_SIZE), np.zeros(mem.MEMORY_SIZE)
        sensor[at.VBAT] = sensor[at.VBAT_FILTERED] = got["pm.vbatMV"][t] / 1000
        memory[mem.MODE] = mem.FORCE_TORQUE_MODE
        memory[mem.WRENCH : mem.WRENCH + 4] = [wish[k][t] for k in wish]
        motors_step(board, state, sensor, param, memory, np.zeros(len(variables.ALL_VARIABLES)), True, True)
        errors.append([state[at.PWM + i] - got[f"motor.m{i + 1}"][t] for i in range(4)])
    if len(errors) < 50:
        pytest.skip("too few samples of both blocks at the same millisecond")
    assert np.median(np.abs(errors)) < 100  # of some 40000
