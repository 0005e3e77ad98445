"""Every TOML file of a user's: what is hostile is one sentence, whoever reads it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from crazyem.control.named_trajectories import read_waypoints
from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.live.policy import load_policy
from crazyem.live.swarm import read_swarm
from crazyem.recordings.csv.mapping import load_mapping
from crazyem.recordings.ros.rosbag2_bag import _user_mapping
from crazyem.toml_file import LARGEST_TOML_FILE, read_text
from crazyem.vehicle import load_vehicle

READERS: dict[str, Callable[[Path], object]] = {
    "vehicle": load_vehicle,
    "policy": load_policy,
    "swarm": lambda path: read_swarm(path, vehicle="cf2", trajectory=("hover",)),
    "waypoints": read_waypoints,
    "mapping": lambda path: load_mapping(read_text(path, what="mapping"), str(path)),
    "bag": lambda path: _user_mapping(str(path)),
}
HOSTILE = {
    "not TOML": b"x = = 1",
    "nested": b"x = " + b"[" * 20_000,
    "digits": b"x = 1" + b"0" * 5000,
    "bytes": b"\xff\xfe\x00x",
    "nul": b"x = '\x00'",
    "large": b"#" * (LARGEST_TOML_FILE + 1),
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_hostile_files_are_one_sentence(tmp_path, read, content):
    path = tmp_path / "hostile.toml"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"hostile\.toml") as raised:
        read(path)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 400


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_files_that_cannot_be_read(tmp_path, read):
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(CrazyemError):
            read(path)
    with pytest.raises(UsageError, match="cannot read the vehicle file"):
        read_text("a\0b", what="vehicle file")


def test_a_byte_order_mark_does_no_harm(tmp_path):
    path = tmp_path / "marked.toml"
    path.write_bytes(b"\xef\xbb\xbfname = 'a'\r\nmass = 0.03\r\ninertia = [1e-5, 1e-5, 2e-5]\r\n")
    assert load_vehicle(path).mass == 0.03
