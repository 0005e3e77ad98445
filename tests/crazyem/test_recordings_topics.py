"""Topics to signals: names, orders and bounds hold whatever the topics are called."""

import numpy as np

from crazyem.recordings.topics import MOST_RAW_SIGNALS, Mapped, Topic, ranks, signals_of


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
