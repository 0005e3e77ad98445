"""Stamps and clocks: unwrapping, loss accounting and clock relation against flights whose answer is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.links.clock import STAMP_MODULUS, ClockRelation, LossCounter, StampUnwrapper


@given(st.integers(0, STAMP_MODULUS - 1), st.lists(st.integers(-4_000_000, 8_000_000), max_size=60))
def test_unwrapping_follows_jumps_and_reordering(start, steps):
    """Any stamp within half a wrap of the newest comes back right, backwards or forwards."""
    unwrapper = StampUnwrapper()
    assert unwrapper.unwrap(start) == start
    newest = start
    for step in steps:
        time = newest + step
        assert unwrapper.unwrap(time % STAMP_MODULUS) == time
        newest = max(newest, time)


def firmware_stamps(rng, count, period, jitter):
    """As the firmware makes them: a timer on an exact grid, and a worker that is held up now and then.

    What became due meanwhile is sampled as soon as the worker goes on, so some packets share a millisecond.
    """
    ideal = 1234 + period * np.arange(count)
    stamps = ideal + rng.integers(0, 2, count)
    for k in range(0, count, 5):
        if rng.random() < 0.25:
            stamps[k] = ideal[k] + rng.integers(0, jitter + 1)
    return np.maximum.accumulate(stamps)


@given(st.integers(0, 2**32 - 1), st.sampled_from([10, 20, 100]), st.floats(0.0, 0.3))
def test_losses_are_counted_exactly_under_jitter(seed, period, share):
    rng = np.random.default_rng(seed)
    stamps = firmware_stamps(rng, 400, period, 16)
    kept = rng.random(400) >= share
    kept[:12] = kept[-12:] = True
    counter = LossCounter(period)
    for stamp in stamps[kept]:
        counter.count(int(stamp))
    assert counter.received == kept.sum()
    assert counter.lost == 400 - kept.sum()
    assert counter.late == 0


@given(
    st.integers(0, 2**32 - 1), st.sampled_from([10, 20, 100]), st.floats(0.0, 0.3), st.floats(0.0, 0.5),
    st.integers(1, 3), st.integers(0, 20),
)  # fmt: skip
def test_duplicates_cancel_no_loss(seed, period, share, doubled, copies, delay):
    """Whatever is lost and doubled, at once or up to 20 packets later.

    Only a copy of the newest packet that follows a loss hides it.
    """
    rng = np.random.default_rng(seed)
    stamps = 1234 + period * np.arange(400) + rng.integers(0, 2, 400)
    kept = rng.random(400) >= share
    kept[:12] = kept[-12:] = True
    arrivals, extra, hidden, gone = [], 0, 0, 0
    for k in range(400):
        if not kept[k]:
            gone += 1
            continue
        arrivals.append((k, 0, stamps[k]))
        if k and rng.random() < doubled:
            later = int(rng.integers(0, delay + 1))
            arrivals += [(k + later, 1, stamps[k])] * copies
            extra += copies
            newest = not kept[k + 1 : k + 1 + later].any()
            hidden += min(copies, gone) if newest else 0
        gone = 0
    counter = LossCounter(period)
    taken = [counter.count(int(stamp)) for _, _, stamp in sorted(arrivals, key=lambda a: a[:2])]
    assert counter.lost == 400 - kept.sum() - hidden
    assert counter.duplicates == taken.count(False) == extra - hidden
    assert counter.received == taken.count(True)
    assert counter.late == 0


def test_two_packets_that_were_overdue_share_a_millisecond_and_are_both_counted():
    """As the real firmware does after a delay: no duplicate, and nothing lost."""
    counter = LossCounter(10)
    for stamp in (0, 10, 20, 30, 40, 60, 60, 70, 80, 110, 110, 110, 118, 128, 138, 148, 158, 168, 178, 188):
        assert counter.count(stamp)
    assert not counter.count(188)
    assert (counter.lost, counter.duplicates, counter.late) == (0, 1, 0)


def test_a_duplicate_of_an_overtaken_packet():
    counter = LossCounter(10)
    stamps = (0, 10, 30, 20, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120)
    assert [s for s in stamps if not counter.count(s)] == [20, 30]
    assert (counter.received, counter.lost, counter.late, counter.duplicates) == (13, 0, 1, 2)


def test_nothing_is_called_lost_on_the_way_when_nothing_is():
    rng = np.random.default_rng(3)
    counter = LossCounter(10)
    for stamp in firmware_stamps(rng, 3000, 10, 25):
        counter.count(int(stamp))
        assert counter.lost == 0


@pytest.mark.parametrize("rate", [1.0, 1.00003, 0.1])
def test_clock_relation_finds_offset_and_rate(rate):
    rng = np.random.default_rng(1)
    relation = ClockRelation()
    assert relation.fit() is None
    firmware = 10 * np.arange(6000) + 777
    host = 1.7e9 + rate * firmware / 1000.0 + 0.002 + rng.exponential(0.003, firmware.size) * rate
    for f, h in zip(firmware, host, strict=True):
        relation.add(int(f), float(h))
    fit = relation.fit()
    assert fit.rate == pytest.approx(rate, abs=3e-5 * rate)
    assert fit.to_host(30_000) == pytest.approx(1.7e9 + rate * 30.0 + 0.002, abs=1.5e-3 * rate)
    assert fit.packets == 6000


@pytest.mark.parametrize("rate", [1.0, 0.125])
def test_a_clock_that_stood_still_does_not_bend_the_relation(rate):
    """A simulator denied the processor for two seconds, twice: afterwards packets are as punctual as before."""
    rng = np.random.default_rng(4)
    relation = ClockRelation()
    firmware = 10 * np.arange(4000)
    stalls = 2.0 * (firmware > 3000) + 2.0 * (firmware > 22_000)
    host = 1.7e9 + rate * firmware / 1000.0 + stalls + rng.exponential(0.003, firmware.size)
    for f, h in zip(firmware, host, strict=True):
        relation.add(int(f), float(h))
        if f % 200 == 0:
            relation.fit()
    fit = relation.fit()
    assert fit.rate == pytest.approx(rate, abs=2e-4)
    assert fit.to_host(39_000) == pytest.approx(1.7e9 + rate * 39.0 + 4.0, abs=0.01)
    assert fit.delay < 0.05


def test_a_delay_that_passes_is_no_stall():
    relation = ClockRelation()
    for n in range(3000):
        late = 0.6 if 1000 <= n < 1300 else 0.0  # three seconds of a link that is behind
        relation.add(10 * n, 1.7e9 + n / 100.0 + late)
        if n % 20 == 0:
            relation.fit()
    fit = relation.fit()
    assert fit.rate == pytest.approx(1.0, abs=0.02)
    assert fit.to_host(5_000) == pytest.approx(1.7e9 + 5.0, abs=0.2)


def test_real_blocks_lose_what_their_stamps_say(shared_recordings):
    """The real firmware's stamps: 22 s at 100 Hz; the file itself shows which slots are empty."""
    import csv
    import gzip

    path = shared_recordings / "real_firmware" / "lee_34g_mass_pushed_midflight.csv.gz"
    stamps = {}
    with gzip.open(path, "rt") as stream:
        for row in csv.DictReader(stream):
            if row["block"] != "ref":
                stamps.setdefault(row["block"], {})[row["host_t"]] = int(row["fw_ms"])
    for packets in stamps.values():
        times = list(packets.values())
        counter = LossCounter(10)
        unwrapper = StampUnwrapper()
        for stamp in times:
            counter.count(unwrapper.unwrap(stamp))
        elapsed = (times[-1] - times[0]) / 10 + 1
        assert counter.lost == pytest.approx(elapsed - len(times), abs=3)
