"""The soak's parts that need no half hour: faults the relay takes, the figures of a made series, the page."""

import itertools
import json
import random
from pathlib import Path

import numpy as np
import pytest

from benchmarks import soak
from firmware_sim.relay.schedule import load_schedule


@pytest.mark.parametrize("minutes", [0.5, 2.0, 30.0])
def test_its_faults_are_a_schedule_of_the_relay(minutes: float, tmp_path: Path) -> None:
    wanted = soak.faults(minutes)
    place = tmp_path / "faults.toml"
    place.write_text(soak.schedule(wanted, 7), encoding="utf-8")
    faults, seed = load_schedule(place)
    assert seed == 7
    assert len(faults) == len(wanted)
    silences = sorted((f.start, f.end) for f in faults if f.what == "silence")
    assert all(f.direction == "down" for f in faults if f.what == "silence")
    assert all(end < start for (_, end), (start, _) in itertools.pairwise(silences))
    long = [end - start for start, end in silences if end - start > 1.0]
    assert len(long) == len(np.arange(75.0, 60.0 * minutes, 300.0))


def made(*, growth: float, minutes: float = 10.0) -> dict:
    """A result whose host grows by so many MB a minute after it has settled."""
    rng = random.Random(3)
    rows = []
    for n in range(601):
        t = 60.0 * minutes * n / 600
        memory = [200.0 + min(t, 120.0) + growth * t / 60.0, 170.0, 17.0]
        clock = [1e9, 1.0 + 50e-6, 0.004, 1.0, t, 0.003 + 0.001 * rng.random()]
        rows.append([t, *memory, n % 5, n % 3, 0, 1, 100 * n, n, *clock])
    assert len(rows[0]) == len(soak.Watcher.NAMES)
    return {
        "minutes": minutes, "speed": 1.0, "seed": 0, "error": "", "names": soak.Watcher.NAMES, "series": rows,
        "machine": {"cores": 2, "python": "3.11", "load": 0.0}, "received": 980, "lost": 20, "outages": [(0, 1, "x")],
        "probe": {"written": 9, "confirmed": 8, "confirmed_again": 1, "unacknowledged": 1, "lost": 0, "wrong": 0,
                  "unread": 0, "slowest_s": 0.4},
        "pushes": {"written": 4, "unconfirmed": 0}, "mass": 0.032, "recording": {"bytes": 1_000_000, "writes": 13},
    }  # fmt: skip


def test_growth_queues_and_clock_are_told() -> None:
    figures = soak.summary(made(growth=0.25))
    assert figures["host_mb"]["growth_per_minute"] == pytest.approx(0.25, abs=1e-6)
    assert figures["firmware_mb"]["growth_per_minute"] == pytest.approx(0.0, abs=1e-9)
    assert figures["packets_waiting"] == {"p99": 4.0, "max": 4.0, "end": 0.0}
    assert figures["clock"]["drift_ppm"] == pytest.approx(50.0)
    assert figures["clock"]["late_ms"][0] == pytest.approx(3.5, abs=0.2)
    assert figures["clock"]["late_ms_per_minute"] == pytest.approx(0.0, abs=0.1)
    assert figures["link"] == {"lost_share": 0.02, "outages": 1}


def test_the_page_takes_the_table_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "soak.md"
    place.write_text(f"before\n{soak.MARKS[0]}\nold\n{soak.MARKS[1]}\nafter\n", encoding="utf-8")
    monkeypatch.setattr(soak, "DOCS", place)
    result = json.loads(json.dumps(made(growth=0.0)))
    soak.write_docs(result)
    soak.write_docs(result)
    text = place.read_text(encoding="utf-8")
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert text.count("| host |") == 1
    assert "| lost, wrong when read back, not readable | 0, 0, 0 |" in text


def test_the_shipped_page_has_the_marks() -> None:
    text = soak.DOCS.read_text(encoding="utf-8")
    assert text.index(soak.MARKS[0]) < text.index(soak.MARKS[1])
