"""Tables of firmware variables as signals: the best source wins, nothing is lost, what can be shared is shared."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.recordings import Recording, SignalArray
from crazyem.recordings.columns import rows_of
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.recordings.topics import MOST_RAW_SIGNALS, Mapped, Topic, ranks, signals_of
from crazyem.signals.firmware_units import unit_of

N = 6
MOTOR, PWM = [f"motor.m{i}" for i in (1, 2, 3, 4)], [f"pwm.m{i}_pwm" for i in (1, 2, 3, 4)]


def table(name, names, *, start=0, values=None, host=None, dtype=np.float32):
    time = 1.0 + 0.01 * np.arange(N)
    columns = {n: np.arange(N).astype(dtype) + i for i, n in enumerate(names)} | (values or {})
    return Table(name, columns, time, start + 2 * np.arange(N), host_time=host)


def gyro(prefix="gyro."):
    return [prefix + axis for axis in "xyz"]


def test_best_source_wins_and_the_other_stays_under_its_own_name():
    compressed = table("z", [f"stateEstimateZ.{a}" for a in "xyz"], dtype=np.int16)
    plain = table("f", [f"stateEstimate.{a}" for a in "xyz"], start=1)
    signals = signals_from_tables([compressed, plain], motor=None)
    assert signals["position"].stream == "f"
    assert signals["position"].source == ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
    assert signals["stateEstimateZ.x"].value[:, 0].tolist() == list(range(N))
    assert signals["stateEstimateZ.x"].unit == "mm"
    assert set(signals) == {"position", *(f"stateEstimateZ.{a}" for a in "xyz")}


def test_one_variable_in_two_tables_is_kept_twice():
    signals = signals_from_tables([table("a", ["pm.vbat", "x.y"]), table("b", ["pm.vbat", "x.y"])], motor=None)
    assert set(signals) == {"voltage", "pm.vbat", "x.y@a", "x.y@b"}
    assert signals["voltage"].stream == "a"
    assert signals["pm.vbat"].stream == "b"


def test_a_name_of_the_vocabulary_is_no_signal_of_it():
    signals = signals_from_tables([table("event", ["position", "voltage"])], motor=None)
    assert set(signals) == {"position@event", "voltage@event"}
    assert signals["voltage@event"].quantity == ""


def test_tables_of_one_name_lose_nothing():
    signals = signals_from_tables([table("a", ["x.y"]), table("a", ["x.y"]), table("a", ["pm.vbat"])], motor=None)
    assert sorted(array.source[0] for array in signals.values()) == ["pm.vbat", "x.y", "x.y"]


@pytest.mark.parametrize(
    ("motor", "signals", "with_pwm"),
    [
        ("duty", {"motor_command"}, {"motor_command", *MOTOR}),
        ("request", {"motor_request"}, {"motor_command", "motor_request"}),
        (None, set(MOTOR), {"motor_command", *MOTOR}),
    ],
)
def test_motor_is_as_told_and_pwm_is_the_command_in_any_case(motor, signals, with_pwm):
    assert set(signals_from_tables([table("a", MOTOR)], motor=motor)) == signals
    found = signals_from_tables([table("a", [*MOTOR, *PWM])], motor=motor)
    assert set(found) == with_pwm
    assert found["motor_command"].source[0] == "pwm.m1_pwm"


def test_samples_come_in_the_order_of_the_rows():
    one = table("a", [*gyro(), *gyro("acc.")])
    two = table("b", ["pm.vbat", "x.y"], start=1)
    signals = signals_from_tables([one, two], motor=None)
    samples = list(Recording("p", "s", signals).samples())
    assert [s.signal for s in samples[:3]] == ["body_rate", "specific_force", "voltage"]
    assert [s.signal for s in samples] == ["body_rate", "specific_force", "voltage"] * N
    orders = np.concatenate([signals[n].order for n in ("body_rate", "specific_force", "voltage")])
    assert np.unique(orders).size == orders.size
    assert np.array_equal(np.argsort(signals["x.y"].order), np.arange(N))


def test_only_a_nan_of_ours_is_marked():
    rpm = {f"motor.m{i}_rpm": np.full(N, 1000.0) for i in (1, 2, 3, 4)}
    rpm["motor.m2_rpm"][1] = 65535  # the firmware's "missing"
    rpm["motor.m3_rpm"][4] = np.nan  # the file's own
    signal = signals_from_tables([table("a", [], values=rpm)], motor=None)["rotor_speed"]
    assert np.isnan(signal.value[[1, 4]]).any(axis=1).all()
    assert signal.marked.tolist() == [False, True, False, False, False, False]


@pytest.mark.parametrize("host", [None, 1.7e9 + np.arange(N)])
def test_what_a_table_has_in_common_is_held_once(host):
    signals = signals_from_tables([table("a", [*gyro(), "x.y", "x.z"], host=host)], motor=None)
    a, b, c = signals["body_rate"], signals["x.y"], signals["x.z"]
    for other in (b, c):
        assert other.time is a.time
        assert other.host_time is a.host_time
        assert other.marked is a.marked
    assert b.order is c.order
    assert np.isnan(a.host_time).all() if host is None else a.host_time is host


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("motor.m1", "count"), ("motor.m4req", "count"), ("motor.m2_rpm", "rpm"), ("pwm.m3_pwm", "count"),
        ("pm.vbatMV", "mV"), ("stateEstimate.ax", "g"), ("stateEstimateZ.az", "mm/s^2"), ("ctrltarget.ax", "m/s^2"),
        ("ctrltarget.yaw", "deg/s"), ("ctrlLee.torquez", "N m"), ("ctrlLee.omegarx", "rad/s"), ("gyro.xRaw", ""),
        ("mode", ""),
    ],
)  # fmt: skip
def test_units_of_variables_outside_the_vocabulary(name, unit):
    assert unit_of(name) == unit


def test_a_signalling_nan_of_damaged_bytes_is_a_nan_and_no_warning() -> None:
    """0x7f81ffff: casting it to double raises the invalid flag of the processor, which numpy warns of."""
    damaged = np.frombuffer(b"\x00\x00\x00\x3f\xff\xff\x81\x7f", "<f4")
    time, order = np.array([0.0, 0.1]), np.arange(2)
    columns = {"acc.x": damaged, "acc.y": damaged, "acc.z": damaged, "other.name": damaged}
    signals = signals_from_tables([Table("t", columns, time, order)], motor=None)
    for value in (signals["specific_force"].value[:, 0], signals["other.name"].value[:, 0]):
        assert np.isfinite(value).tolist() == [True, False]


# --- topics: names, orders and bounds hold whatever they are called ---


def topic(name: str, rows: int, columns: tuple[str, ...], start: int = 0) -> Topic:
    values = {c: np.arange(rows) + 100.0 * i for i, c in enumerate(columns)}
    return Topic(name, values, np.arange(rows, dtype=float), np.arange(start, start + rows))


def test_topics_of_one_name_stay_apart() -> None:
    first, second = topic("a", 3, ("x", "y")), topic("a", 5, ("x",), 3)
    voltage = [Mapped("voltage", t, t.columns["x"][:, None], ("x",)) for t in (first, second)]
    signals, left_out = signals_of([first, second], voltage)
    assert {n: s.value.shape for n, s in signals.items()} == {"voltage": (3, 1), "voltage@a": (5, 1), "a.y": (3, 1)}
    assert not left_out
    signals, _ = signals_of([first, second], [])
    assert {n: s.time.size for n, s in signals.items()} == {"a.x": 3, "a.y": 3, "a.x'": 5}


def test_orders_are_unique_and_follow_the_rows() -> None:
    times = [np.array([0.0, 2.0, 4.0]), np.array([1.0, 2.0, 3.0])]
    places = ranks(times)
    assert [p.tolist() for p in places] == [[0, 2, 5], [1, 3, 4]]
    topics = [Topic(n, {"x": t, "y": t}, t, p) for n, t, p in zip(("a", "b"), times, places, strict=True)]
    signals, _ = signals_of(topics, [])
    order = np.concatenate([s.order for s in signals.values()])
    time = np.concatenate([s.time for s in signals.values()])
    assert np.unique(order).size == order.size
    assert (np.diff(time[np.argsort(order)]) >= 0).all()


def test_too_many_columns_are_left_out_and_counted() -> None:
    many = topic("many", 2, tuple(f"c{i}" for i in range(MOST_RAW_SIGNALS + 7)))
    signals, left_out = signals_of([many], [])
    assert len(signals) == MOST_RAW_SIGNALS
    assert left_out[0].evidence["left_out"] == 7


# --- rows of a table, some at a time: the same as by a plain loop over all samples in order ---


STAMPS = st.sampled_from([0.0, -0.0, 0.01, math.nan])
HOSTS = st.sampled_from([math.nan, 1.7e9])


def signal(time: list[float], host: list[float], order: list[int]) -> SignalArray:
    n = len(time)
    return SignalArray(
        np.array(time, float), np.zeros((n, 1)), np.array(order, np.int64), np.array(host, float), np.zeros(n, bool)
    )


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    """Few stamps and few orders, so that many samples share them; orders that go back."""
    signals = {}
    for name in "abcd"[: draw(st.integers(1, 4))]:
        n = draw(st.integers(0, 12))
        lists = [draw(st.lists(kind, min_size=n, max_size=n)) for kind in (STAMPS, HOSTS, st.integers(0, 9))]
        order = sorted(lists[2]) if draw(st.booleans()) else lists[2]
        signals[name] = signal(lists[0], lists[1], order)
    return Recording("there", "made", signals)


def plain(recording: Recording) -> list[tuple[str, str, list[tuple[str, int]]]]:
    """[(stamp, host time, [(signal, sample)])] with a loop."""
    names = list(recording.signals)
    samples = [
        (int(array.order[i]), place, i)
        for place, array in enumerate(recording.signals.values())
        for i in range(array.time.size)
    ]
    rows: list[tuple[str, str, list[tuple[str, int]]]] = []
    last = -1
    for _, place, i in sorted(samples):
        array = recording.signals[names[place]]
        stamps = (array.time[i].hex(), array.host_time[i].hex())
        if not rows or stamps != rows[-1][:2] or place <= last:
            rows.append((*stamps, []))
        rows[-1][2].append((names[place], i))
        last = place
    return rows


@given(recordings(), st.integers(1, 6))
def test_rows_some_at_a_time_are_those_of_a_plain_loop(recording: Recording, count: int) -> None:
    found: list[tuple[str, str, list[tuple[str, int]]]] = []
    for rows in rows_of(recording, recording.signals, samples=count):
        begin = len(found)
        found += [(t.hex(), h.hex(), []) for t, h in zip(rows.time, rows.host_time, strict=True)]
        for name in recording.signals:
            for row, sample in zip(rows.row[name].tolist(), rows.sample[name].tolist(), strict=True):
                found[begin + row][2].append((name, sample))
    assert found == plain(recording)


@pytest.mark.parametrize("order", [np.arange(1000), np.zeros(1000, int), np.arange(1000)[::-1]])
def test_what_is_taken_at_once_is_bounded(order: np.ndarray) -> None:
    one = signal(np.arange(1000.0).tolist(), [math.nan] * 1000, order.tolist())
    parts = list(rows_of(Recording("there", "made", {"a": one}), ["a", "not there"], samples=10))
    assert sum(rows.time.size for rows in parts) == 1000
    if len(set(order.tolist())) > 1:  # samples of one order stay together
        assert max(rows.time.size for rows in parts) <= 10
    assert list(rows_of(Recording("there", "made", {}), ["a"])) == []
