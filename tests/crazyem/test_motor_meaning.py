"""What motor.m1..4 is: the real logs whose answer is known, each kind of evidence alone, and evidence at odds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import UsageError
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.finding import Grade
from crazyem.recordings.motor_meaning import MOTOR_VARIABLES, decide
from crazyem.recordings.tables import Table
from crazyem.recordings.usd.file import read

SENT = [f"pwm.m{i}_pwm" for i in (1, 2, 3, 4)]
COMMANDS = [f"controller.cmd_{name}" for name in ("thrust", "roll", "pitch", "yaw")]


def table(columns, ctypes=None, name="block"):
    n = len(next(iter(columns.values())))
    return Table(name, columns, 0.01 * np.arange(n), np.arange(n), ctypes=ctypes or {})


def legacy_mixer(thrust, roll, pitch, yaw):
    """power_distribution_stock.c of 2021, a row at a time: int16 halves, a float thrust, then an integer."""
    rows = []
    for t, r2, p2, y in zip(thrust, roll, pitch, yaw, strict=True):
        r, p = int(r2 / 2.0), int(p2 / 2.0)  # C truncates towards zero, as int() does
        rows.append([int(t - r + p + y), int(t - r - p - y), int(t + r - p + y), int(t + r + p - y)])
    return np.array(rows, np.uint32).T


def compensated(request, voltage):
    """motorsCompensateBatteryVoltage of 2021 (motors.c), a number at a time."""
    result = np.empty(request.shape, np.uint32)
    for k, row in enumerate(request):
        for i, counts in enumerate(row.tolist()):
            thrust = counts / 65536.0 * 60
            volts = -0.0006239 * thrust * thrust + 0.088 * thrust
            result[k, i] = int(min(1.0, volts / voltage[i]) * 65535)
    return result


def flight(n=200, seed=0):
    rng = np.random.default_rng(seed)
    thrust = (36_000 + 1500 * np.sin(np.arange(n) / 20) + rng.normal(0, 200, n)).astype(np.float32).astype(float)
    roll, pitch, yaw = (rng.integers(-2000, 2000, n).astype(float) for _ in range(3))
    request = legacy_mixer(thrust, roll, pitch, yaw)
    voltage = np.linspace(4.0, 3.6, n)
    columns = dict(zip(COMMANDS, (thrust, roll, pitch, yaw), strict=True))
    return request, compensated(request, voltage), voltage, columns


def motors(values):
    return dict(zip(MOTOR_VARIABLES, values, strict=True))


REQUEST, DUTY, VOLTAGE, CONTROLLER = flight()
FLAT = np.full((4, 200), 40_000.5)  # tells nothing: not even whole numbers


# --- real logs ---


def columns_of(shared_recordings, name):
    """A uSD log's columns through the reader's own table."""
    import crazyem.recordings.usd.file as module

    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module.motor_meaning, "decide", lambda tables, **_: (seen.extend(tables), decide(()))[1])
        read(shared_recordings / name, ReadOptions())
    return seen[0]


def crazypad(shared_recordings):
    return sorted(f"crazypad/{path.name}" for path in (shared_recordings / "crazypad").glob("motor__*"))


def test_crazypad_without_its_pwm_is_told_by_the_mixers_grid(shared_recordings):
    for file in crazypad(shared_recordings):
        original = columns_of(shared_recordings, file)
        columns = {k: v for k, v in original.columns.items() if k not in SENT}
        assert decide([table(columns)]).meaning == "request"
        # the PWM that was sent, under the name it would have today
        columns |= {f"motor.m{i}": original.columns[f"pwm.m{i}_pwm"] for i in (1, 2, 3, 4)}
        told = decide([table(columns)])
        assert told.meaning == "duty"
        assert 0.03 < told.evidence["mixer_share"] < 0.1  # 1/16 by chance


# --- each kind of evidence ---


def test_pwm_settles_it():
    voltage = {"pm.vbatMV": (1000 * VOLTAGE).round()}
    request = decide([table(motors(REQUEST) | dict(zip(SENT, DUTY, strict=True)) | voltage)])
    assert request.meaning == "request"
    assert request.evidence["compensation_error_counts"] < 10
    duty = decide([table(motors(DUTY) | dict(zip(SENT, DUTY, strict=True)))])
    assert duty.meaning == "duty"
    assert duty.evidence["pwm_equal_share"] == 1.0


@pytest.mark.parametrize(
    "newer", ["motor.m1req", "supervisor.info", "ctrlLee.thrustSi", "motor.m3_rpm", "motor.m2_erpm", "ctrlLee.torquez"]
)
def test_variables_of_newer_firmware(newer):
    elsewhere = table({newer: np.zeros(5)}, name="other")
    for others, metadata in (([elsewhere], {}), ([], {"drone": {"log_variables": f"acc.x {newer} pm.vbat"}})):
        told = decide([table(motors(FLAT)), *others], metadata=metadata)
        assert told.meaning == "duty"
        assert newer in told.reason


@pytest.mark.parametrize(
    ("ctype", "meaning"), [("uint16_t", "duty"), ("int32_t", "request"), ("uint32_t", None), ("float", None)]
)
def test_types(ctype, meaning):
    assert decide([table(motors(FLAT), dict.fromkeys(MOTOR_VARIABLES, ctype))]).meaning == meaning


@pytest.mark.parametrize(
    ("version", "meaning"),
    [("2023.02", "duty"), ("2025.12.1", "duty"), ("2022.09", "request"), ("2021.06", "request"), ("2022.12", None)],
)
def test_versions(version, meaning):
    for metadata in ({"drone": {"firmware_version": version}}, {"firmware": {"release": f"crazyflie {version}"}}):
        assert decide([table(motors(FLAT))], metadata=metadata).meaning == meaning
    assert decide([table(motors(FLAT))], metadata={"crazyem": {"cflib": version}}).meaning is None


def test_the_mixers_arithmetic_with_its_inputs():
    with_commands = decide([table(motors(REQUEST) | CONTROLLER)])
    assert with_commands.meaning == "request"
    assert with_commands.evidence["mixer_equal_share"] > 0.99


@given(st.integers(0, 2**32))
def test_the_mixers_arithmetic_whatever_the_flight(seed):
    request, duty, _, _ = flight(100, seed)
    assert decide([table(motors(request))]).meaning == "request"
    assert decide([table(motors(duty))]).meaning == "duty"


def test_what_proves_nothing():
    ground = np.full((4, 200), 7000)
    for values in (FLAT, np.zeros((4, 200)), np.full((4, 200), 65535), ground, REQUEST[:, :20]):
        told = decide([table(motors(values))])
        assert told.meaning is None
        (finding,) = told.findings
        assert finding.check == "motor_meaning"
        assert finding.grade is Grade.DEGRADES
        assert "--motor" in finding.advice


def test_commands_without_motors_are_not_made_into_motors():
    told = decide([table(CONTROLLER)])
    assert (told.meaning, told.reason, told.findings, told.metadata) == (None, "", (), {})


# --- evidence at odds, and the user ---


def test_new_firmware_on_the_grid_has_its_compensation_off():
    told = decide([table(motors(REQUEST), dict.fromkeys(MOTOR_VARIABLES, "uint16_t"))])
    assert told.meaning == "duty"
    assert "compensation was off" in told.reason


@pytest.mark.parametrize(
    ("values", "ctypes", "extra"),
    [
        (DUTY, dict.fromkeys(MOTOR_VARIABLES, "int32_t"), {}),
        (FLAT, dict.fromkeys(MOTOR_VARIABLES, "int32_t"), {"supervisor.info": FLAT[0]}),
    ],
)
def test_contradictions_are_left_open(values, ctypes, extra):
    told = decide([table(motors(values) | extra, ctypes)])
    assert told.meaning is None
    assert "contradicts itself" in told.findings[0].text


def test_the_user_fills_in_and_is_warned():
    cases = ((FLAT, "request", Grade.HARMLESS), (DUTY, "duty", Grade.HARMLESS), (DUTY, "request", Grade.DEGRADES))
    for values, word, grade in cases:
        told = decide([table(motors(values))], given=word)
        assert (told.meaning, told.findings[0].grade) == (word, grade)
    assert "as told" in told.findings[0].text
    with pytest.raises(UsageError, match="duty"):
        decide([table(motors(DUTY))], given="pwm")


def test_the_users_word_reaches_the_signals(shared_recordings):
    file = shared_recordings / "sysid" / "log10"
    recording = read(file, ReadOptions(motor="request"))
    assert "motor_request" in recording.signals
    assert "motor_command" not in recording.signals
    assert Grade.DEGRADES in [f.grade for f in recording.findings]
