"""The plant's thrust law against a recording of the real C firmware flying a known body (bookkeeping, not the law)."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters, variables
from firmware_sim.controllers.power_distribution import motors_step
from firmware_sim.plant import layout as at
from firmware_sim.plant.rotors import lag, wrench
from firmware_sim.scenario import parse_scenario

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "real_firmware"
FLIGHT = FOLDER / "lee_34g_mass_pushed_midflight"

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the shared recordings are not beside this checkout")


def rows(name: str) -> list[dict[str, str]]:
    with gzip.open(FOLDER / name, "rt") as file:
        return list(csv.DictReader(file))


def test_force_and_torque_of_the_recorded_commands() -> None:
    table = rows(f"{FLIGHT.name}.truth.csv.gz")
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
    for row in rows(f"{FLIGHT.name}.csv.gz"):
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
