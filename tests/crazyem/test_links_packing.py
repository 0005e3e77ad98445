"""Packing: every variable exactly once, no block over 26 bytes, groups together, limits in plain words."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import UsageError
from crazyem.links.packing import MAX_BLOCKS, MAX_BYTES, MAX_VARIABLES, pack, period_of
from crazyem.signals.sample import CTYPE_SIZES
from crazyem.signals.vocabulary import IMU_BLOCK, MOTOR_BLOCK, STATE_BLOCK

TYPES = {
    **dict.fromkeys(STATE_BLOCK, "int16_t"),
    "stateEstimateZ.quat": "uint32_t",
    **dict.fromkeys(IMU_BLOCK, "float"),
    **dict.fromkeys(MOTOR_BLOCK, "uint16_t"),
}


def size(block):
    return sum(CTYPE_SIZES[v.ctype] for v in block.variables)


@st.composite
def requests(draw):
    types = draw(st.lists(st.sampled_from(list(CTYPE_SIZES)), min_size=1, max_size=60))
    available = {f"g{i % 7}.v{i}": t for i, t in enumerate(types)}
    names = draw(st.permutations(list(available)))
    count = draw(st.integers(0, 6))
    groups = [draw(st.lists(st.sampled_from(names), min_size=1, max_size=8)) for _ in range(count)]
    return names, available, groups


@given(requests())
def test_nothing_lost_nothing_too_large_groups_together(request_):
    names, available, groups = request_
    blocks = pack(names, available, 10, groups=groups)
    assert sorted(v.name for b in blocks for v in b.variables) == sorted(names)
    assert all(available[v.name] == v.ctype for b in blocks for v in b.variables)
    assert all(0 < size(b) <= MAX_BYTES for b in blocks)
    where = {v.name: b.identifier for b in blocks for v in b.variables}
    taken = set()
    for group in groups:
        fresh = [n for n in dict.fromkeys(group) if n not in taken]
        taken.update(fresh)
        if fresh and sum(CTYPE_SIZES[available[n]] for n in fresh) <= MAX_BYTES:
            assert len({where[n] for n in fresh}) == 1
    # first-fit: no two blocks could have been one, unless a group stands between
    if not groups:
        assert sum(size(b) <= MAX_BYTES // 2 for b in blocks) <= 1


def test_standard_signals_stay_together_in_three_blocks():
    names = [*STATE_BLOCK, *IMU_BLOCK, *MOTOR_BLOCK]
    blocks = pack(sorted(names), TYPES, 10)
    assert {frozenset(v.name for v in b.variables) for b in blocks} == {
        frozenset(STATE_BLOCK),
        frozenset(IMU_BLOCK),
        frozenset(MOTOR_BLOCK),
    }
    assert [b.identifier for b in blocks] == [0, 1, 2]
    assert {b.period_ms for b in blocks} == {10}


def test_limits_have_one_sentence_each():
    many = {f"g.v{i}": "uint8_t" for i in range(200)}
    with pytest.raises(UsageError, match="129 variables do not fit: the firmware logs 128"):
        pack(list(many)[: MAX_VARIABLES + 1], many, 10)
    floats = {f"g.v{i}": "float" for i in range(128)}
    with pytest.raises(UsageError, match=r"need 17 log blocks; the firmware has 16"):
        pack(list(floats)[:97], floats, 10)
    assert len(pack(list(floats)[:96], floats, 10)) == MAX_BLOCKS
    with pytest.raises(UsageError, match="15 of them in use already"):
        pack(list(floats)[:7], floats, 10, blocks_in_use=15)
    with pytest.raises(UsageError, match=r'no log variable "g\.nothing"'):
        pack(["g.nothing"], floats, 10)
    with pytest.raises(UsageError, match=r'did you mean "gyro\.'):
        pack(["gyro.X"], TYPES, 10)


@pytest.mark.parametrize(
    ("rate", "period"),
    [
        (100, 10), (50, 20), (99.0, 10), (30, 30), (1, 1000), (0.4, 2500), (101, 10), (200, 5), (333, 3), (500, 2),
        (1000, 1),
    ],
)  # fmt: skip
def test_periods(rate, period):
    assert period_of(rate) == period


@pytest.mark.parametrize("rate", [0, -1, 1001, 5000, 0.1, float("nan"), float("inf")])
def test_rates_the_firmware_cannot_log(rate):
    with pytest.raises(UsageError, match="Hz"):
        period_of(rate)
