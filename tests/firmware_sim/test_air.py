"""Packet loss between simulator and host: the share and the length of bursts are what the scenario says."""

import itertools

import pytest

from firmware_sim.wire import Air


@pytest.mark.parametrize(("loss", "burst"), [(0.1, 4.0), (0.02, 1.0), (0.5, 10.0), (0.9, 3.0)])
def test_share_and_bursts(loss, burst):
    air = Air(loss, burst, seed=1)
    lost = [air.loses() for _ in range(200_000)]
    # sd of the share: the chain's correlation time is about `burst` packets
    sd = (loss * (1 - loss) * 2 * max(burst, 1 / (1 - loss)) / len(lost)) ** 0.5
    assert abs(sum(lost) / len(lost) - loss) < 5 * sd
    lengths = [len(list(group)) for bad, group in itertools.groupby(lost) if bad]
    mean = sum(lengths) / len(lengths)
    # with entering certain, bursts are as long as the loss demands
    assert mean == pytest.approx(max(burst, loss / (1 - loss)), rel=0.05)


def test_nothing_is_lost_by_default_and_seeds_repeat():
    assert not any(Air(0.0, 5.0, seed=3).loses() for _ in range(1000))
    one, other = Air(0.3, 2.0, seed=9), Air(0.3, 2.0, seed=9)
    assert [one.loses() for _ in range(1000)] == [other.loses() for _ in range(1000)]
