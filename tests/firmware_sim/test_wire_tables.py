"""CRTP packets and the tables: bytes as the real firmware and cflib put them on the wire."""

import itertools
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim import contents, tables, wire
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.scenario import load_scenario
from firmware_sim.wire import Air


@given(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=30))
def test_packets_survive_the_wire_with_and_without_the_link_bits(port, channel, data):
    datagram = wire.encode(port, channel, data)
    assert datagram[0] & 0x0C == 0x0C
    assert wire.decode(datagram) == (port, channel, data)
    assert wire.decode(bytes((datagram[0] & 0xF3,)) + data) == (port, channel, data)


def test_what_is_no_packet():
    assert wire.decode(b"") is None
    assert wire.decode(bytes(32)) is None
    assert wire.decode(b"\xff").is_null
    assert not wire.decode(b"\xfc\x00").is_null
    for port, channel, data in ((16, 0, b""), (0, 4, b""), (0, 0, bytes(31))):
        with pytest.raises(ValueError, match="CRTP"):
            wire.encode(port, channel, data)


def test_fetching_a_log_variable_as_another_type_converts_as_c_does():
    assert tables.fetch(1013.25, "float", "i8") == b"\xf5"  # measured on the real firmware
    assert tables.fetch(-1.9, "float", "i16") == struct.pack("<h", -1)
    assert tables.fetch(70000.0, "float", "u16") == struct.pack("<H", 70000 - 65536)
    assert tables.fetch(1e12, "float", "i32") == struct.pack("<i", 2**31 - 1)
    assert tables.fetch(float("nan"), "float", "u8") == b"\0"
    assert tables.fetch(40000.0, "u16", "float") == struct.pack("<f", 40000.0)
    assert tables.fetch(200.0, "u8", "i8") == b"\xc8"
    assert tables.fetch(0.5, "float", "fp16") == struct.pack("<e", 0.5)
    assert tables.fetch(1e9, "float", "fp16") == struct.pack("<e", float("inf"))
    assert tables.fetch(4294967295.0, "u32", "u32") == b"\xff" * 4


@given(st.sampled_from(["u8", "u16", "u32", "i8", "i16", "i32"]), st.data())
def test_whole_numbers_survive_packing(kind, data):
    dtype = np.dtype({"u": "uint", "i": "int"}[kind[0]] + kind[1:])
    limits = np.iinfo(dtype)
    value = data.draw(st.integers(int(limits.min), int(limits.max)))
    packed = tables.pack(float(value), kind)
    assert packed == np.array(value, dtype=dtype).tobytes()
    assert tables.unpack(packed, kind) == value


@given(st.floats(-1e30, 1e30))
def test_floats_are_rounded_to_single_precision(value):
    assert tables.unpack(tables.pack(value, "float"), "float") == float(np.float32(value))


def test_a_short_write_fills_up_with_zeros():
    assert tables.unpack(b"\x01", "u16") == 1.0


def slots(*names):
    return tables.slots(dict.fromkeys(names, 0.0))


def test_types_and_flags_follow_the_firmware():
    log = tables.log_table(slots("pm.vbat", "gyro.x", "pm.vbatMV", "motor.m1", "motor.m1req", "stateEstimateZ.quat"))
    assert [(item.name, item.type_byte) for item in log.items] == [
        ("pm.vbat", 7),
        ("pm.vbatMV", 2),  # groups are contiguous
        ("gyro.x", 7),
        ("motor.m1", 2),
        ("motor.m1req", 6),
        ("stateEstimateZ.quat", 3),
    ]
    param = tables.param_table(
        slots("ctrlLee.mass", "ctrlMel.mass", "stabilizer.controller", "deck.bcFlow", "powerDist.idleThrust")
    )
    assert {item.name: item.type_byte for item in param.items} == {
        "ctrlLee.mass": 0x06,  # not persistent
        "ctrlMel.mass": 0x36,
        "stabilizer.controller": 0x28,
        "deck.bcFlow": 0x68,
        "powerDist.idleThrust": 0x3A,
    }


SHARED = Path(__file__).parents[3] / "shared"
C_TYPE = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t",
          "float": "float"}  # fmt: skip
RPM = [f"motor.m{n}_rpm" for n in range(1, 5)]


@pytest.fixture(scope="module", params=["cf2", "cf21bl"])
def drone(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("scenario") / "scenario.toml"
    path.write_text(f'platform = "{request.param}"\n')
    scenario = load_scenario(path)
    return request.param, Firmware(Flight(scenario, 0), platform=request.param, seed=0)


def types(table):
    return {item.name: C_TYPE[item.kind] for item in table.items}


def test_the_tables_are_the_real_ones_of_2026_08_with_what_a_drone_has_besides(drone):
    """354 log variables and 245 parameters with the real ids; ours come after them, rotor speeds within their group."""
    platform, firmware = drone
    log, param = types(firmware.log.table), types(firmware.param.table)
    assert (len(contents.LOG), len(contents.PARAMETERS)) == (354, 245)
    own = [name for name in log if name not in contents.LOG]
    assert {name.split(".")[0] for name in own} - {"motor"} == {"ctrlLqg"}
    assert [name for name in own if name.startswith("motor.")] == (RPM if platform == "cf21bl" else [])
    assert [name for name in log if name in contents.LOG] == list(contents.LOG)
    assert list(param)[:245] == list(contents.PARAMETERS)
    assert {name.split(".")[0] for name in list(param)[245:]} == {"ctrlLqg", "deck"}


def test_the_tables_agree_with_the_dump_of_the_real_firmware(drone):
    """That dump is of a build with the unscented filter and without the power management of a drone."""
    path = SHARED / "facts" / "toc_head.json"
    if not path.exists():
        pytest.skip("the dump of the real tables of contents is not at hand")
    real = json.loads(path.read_text())
    filters = ("ukf.", "navFilter.", "sensorFilter.")
    for ours, theirs in (
        (contents.LOG, real["log"]),
        ({n: p.kind for n, p in contents.PARAMETERS.items()}, real["param"]),
    ):
        assert {name for name in theirs if not name.startswith(filters)} <= set(ours)
        assert {name.split(".")[0] for name in set(ours) - set(theirs)} <= {"pm"}
        assert all(C_TYPE[kind] == theirs[name] for name, kind in ours.items() if name in theirs)
    assert sum("p" in contents.PARAMETERS[name].flags for name in real["param"] if name in contents.PARAMETERS) == 116


@pytest.mark.parametrize(("flight", "platform"), [("A_excite_2", "cf2"), ("D_fig8_3", "cf21bl")])
def test_order_types_and_boot_values_are_those_read_from_the_real_firmware(flight, platform):
    path = SHARED / "recordings" / "real_firmware_flights" / f"{flight}.mcap"
    if not path.exists():
        pytest.skip("the flights of the real firmware are not at hand")
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        told = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert told["log_types"] == {name: C_TYPE[kind] for name, kind in contents.LOG.items()}
    assert list(told["log_types"]) == list(contents.LOG)
    assert told["parameter_types"] == {name: C_TYPE[p.kind] for name, p in contents.PARAMETERS.items()}
    assert list(told["parameter_types"]) == list(contents.PARAMETERS)
    boot = contents.defaults(list(contents.PARAMETERS), platform)
    assert {n: np.float32(v) for n, v in told["parameter_values"].items()} == {
        n: np.float32(v) for n, v in boot.items()
    }


def test_checksums_tell_tables_apart():
    one, same, other = (
        tables.log_table(slots("a.b", "a.c")),
        tables.log_table(slots("a.b", "a.c")),
        tables.log_table(slots("a.b", "a.d")),
    )
    assert one.crc == same.crc != other.crc
    assert tables.log_table({}).crc != tables.param_table({}).crc
    assert one.crc == zlib.crc32(b"log\x07a\0b\0\x07a\0c\0")
    with pytest.raises(ValueError, match="too long"):
        tables.log_table(slots("averylonggroup.averylongname"))


# --- packet loss: the share and the length of bursts are what the scenario says ---


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
