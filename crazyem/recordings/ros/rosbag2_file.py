"""Recognise rosbag2 recordings (MCAP or SQLite), files and folders; `rosbag2_bag` reads them with rosbags."""

from pathlib import Path

from crazyem.extras import require
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.mcap.scan import MCAP_MAGIC, profile_of
from crazyem.recordings.recording import Recording

_SQLITE = b"SQLite format 3\0"
_METADATA = "metadata.yaml"


def recognises(head: bytes) -> bool:
    """True for MCAP with profile "ros2" or ROS 2 schemas, and for a bag in an SQLite file."""
    if head.startswith(_SQLITE):
        return b"topics" in head and b"messages" in head
    if not head.startswith(MCAP_MAGIC):
        return False
    return profile_of(head) == "ros2" or b"\x07\0\0\0ros2msg" in head


def recognises_folder(path: Path) -> bool:
    """True for a folder that `ros2 bag record` made."""
    try:
        with (path / _METADATA).open("rb") as stream:
            return b"rosbag2_bagfile_information" in stream.read(4096)
    except OSError:
        return False


def read(path: Path, options: ReadOptions) -> Recording:
    """Read the flight of one robot from the file or the folder of a bag.

    Raises: FileFormatError naming the file and the reason; UsageError if the user must choose a robot;
    MissingExtraError without rosbags.
    """
    require("rosbags", "Reading a ROS 2 bag")
    from crazyem.recordings.ros import rosbag2_bag

    return rosbag2_bag.read(path, options)
