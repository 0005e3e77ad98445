"""Read rosbag2 recordings (MCAP or SQLite): topics of crazyswarm2 for one robot, and common topics of ROS 2 drones.

There are two clocks: messages of log blocks (LogDataGeneric) have firmware stamps, all others have host stamps. The
firmware clock is the time axis if present. `rosbag2_signals` maps topics to signals. docs: rosbag2.md explains both,
and the mapping file with the variables of log blocks, which a bag does not contain. Sources:
IMRCLab/crazyswarm2 (crazyflie_interfaces/msg, crazyflie/src/crazyflie_server.cpp, crazyflie/scripts), mcap.dev.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Schema
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.recordings.contents import ReadOptions, head_of
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.mcap.scan import Loss, Problem, parts
from crazyem.recordings.recording import Recording
from crazyem.recordings.ros.ros2_messages import LARGEST_MESSAGE, MessageType, message_type, standard_definition
from crazyem.recordings.ros.rosbag2_signals import ROBOT_TYPES, WORLD_TOPICS, BagMapping, BagTopic, recording_of
from crazyem.recordings.topics import text_of
from crazyem.toml_file import read_toml

_SQLITE = b"SQLite format 3\0"
_LARGEST_UNPACKED, _LARGEST_RATIO = 1 << 30, 200  # bytes of a file unpacked; further ones per packed byte
_LARGEST_TOTAL = 2 << 30  # bytes of messages in memory for decoding
_MOST_FILES = 10_000
_MAPPING_KEYS = {"robot": str, "twist": str, "topics": dict}


def read(path: Path, options: ReadOptions) -> Recording:
    """Read the flight of one robot from the file or the folder of a bag.

    Raises: FileFormatError naming the file and the reason; UsageError if the user must choose a robot.
    """
    mapping = _user_mapping(options.mapping)
    bag = _Bag()
    for file in _files(path):
        if file.is_dir() or head_of(file).startswith(_SQLITE):
            bag.add_sqlite(file)
        else:
            bag.add(file)
    if not any(topic.messages for topic in bag.topics.values()):
        raise FileFormatError(f"{path}: the bag holds no messages that can be read ({bag.why_nothing()}).")
    robot = _robot(path, bag, mapping)
    chosen = [t for t in bag.topics.values() if t.name in WORLD_TOPICS or _owner(t.name) in (robot, "")]
    return recording_of(path, chosen, robot, mapping, options.motor, tuple(bag.findings()))


def _files(path: Path) -> list[Path]:
    """The MCAP files of a bag in the order of writing; for SQLite files the folder itself."""
    if path.is_file():
        return [path]
    names = sorted(
        path.glob("*.mcap"), key=lambda p: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", p.name)]
    )
    if names:
        return names[:_MOST_FILES]
    if any(path.glob("*.zstd")):
        raise FileFormatError(f"{path}: the files of the bag are compressed as a whole; unpack them with zstd -d.")
    if any(path.glob("*.db3")):
        return [path]
    raise FileFormatError(f"{path}: the bag has neither an MCAP nor an SQLite file.")


@dataclass(slots=True)
class _Bag:
    """The topics and problems of all files of a bag."""

    topics: dict[str, BagTopic] = field(default_factory=dict)
    problems: list[tuple[Path, Problem]] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)  # topic -> why
    large: dict[str, int] = field(default_factory=dict)  # topic -> number of messages that are too large
    damage: list[Finding] = field(default_factory=list)
    kept: int = 0
    count: int = 0
    _types: dict[tuple[str, str], MessageType | str] = field(default_factory=dict)

    def add(self, path: Path) -> None:
        """Read the sound parts of an MCAP file."""
        problems: list[Problem] = []
        channels: dict[int, BagTopic | None] = {}
        schemas: dict[int, Schema] = {}
        for part in parts(path, problems, most=_LARGEST_UNPACKED + _LARGEST_RATIO * path.stat().st_size):
            for entry in part.announced:
                if isinstance(entry, Schema):
                    schemas[entry.id] = entry
                elif entry.id not in channels:
                    channels[entry.id] = self._topic(entry, schemas.get(entry.schema_id))
            if part.scan is not None:
                for offset, length, channel, log, *_ in part.scan.messages.tolist():
                    topic = channels.get(channel)
                    if topic is not None:
                        self._take(path, topic, log % 2**64, part.scan.data[offset : offset + length].tobytes())
        self.problems += [(path, problem) for problem in problems]

    def add_sqlite(self, path: Path) -> None:
        """Read an SQLite file, or the folder of a bag with several, up to the first damage."""
        if path.is_file() and path.suffix != ".db3":
            raise FileFormatError(f"{path}: a bag in SQLite storage is read where its name ends in .db3.")
        before = self.count
        try:
            with Reader(path) as reader:
                topics = {c.id: self._stored(c) for c in reader.connections}
                for connection, log, payload in reader.messages():
                    topic = topics[connection.id]
                    if topic is not None:
                        self._take(path, topic, log, bytes(payload))
        except CrazyemError:
            raise
        except Exception as error:  # rosbags and SQLite raise many kinds
            if self.count == before:
                raise FileFormatError(f"{path}: the bag cannot be read ({error}).") from error
            text = f"{path.name} is damaged after {self.count - before} messages ({error})."
            self.damage.append(note("integrity", text, Grade.DEGRADES, messages=float(self.count - before)))

    def _stored(self, connection: Connection) -> BagTopic | None:
        """The topic of a connection if its messages can be decoded."""
        definition: str | None = connection.msgdef.data
        if connection.msgdef.format is MessageDefinitionFormat.NONE:
            definition = standard_definition(connection.msgtype)
        elif connection.msgdef.format is not MessageDefinitionFormat.MSG:
            definition = None
        if definition is None:
            why = f"the bag has no definition of {text_of(connection.msgtype)} that can be read here"
            self.refused[_name(connection.topic)] = why
            return None
        return self._announce(connection.topic, connection.msgtype, definition)

    def _take(self, path: Path, topic: BagTopic, log: int, payload: bytes) -> None:
        if len(payload) > LARGEST_MESSAGE:
            self.large[topic.name] = self.large.get(topic.name, 0) + 1
            return
        self.kept += len(payload) + 100
        if self.kept > _LARGEST_TOTAL:
            raise FileFormatError(f"{path}: the bag holds more than {_LARGEST_TOTAL >> 20} MiB of messages; split it.")
        topic.messages.append((min(log, 2**63 - 1), payload))
        topic.places.append(self.count)
        self.count += 1

    def _topic(self, channel: Any, schema: Any) -> BagTopic | None:
        """The topic of a channel if its messages can be decoded."""
        if schema is None or channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
            encoding = f"{channel.message_encoding} with {schema.encoding if schema else 'no'} definitions"
            self.refused[_name(channel.topic)] = f"its encoding is {text_of(encoding)}"
            return None
        return self._announce(channel.topic, schema.name, schema.data.decode("utf-8", "replace"))

    def _announce(self, topic: str, kind_name: str, definition: str) -> BagTopic | None:
        key = (kind_name, definition)
        if key not in self._types:
            try:
                self._types[key] = message_type(*key)
            except ValueError as error:
                self._types[key] = str(error)
        kind = self._types[key]
        name = _name(topic)
        if isinstance(kind, str):
            self.refused[name] = kind
            return None
        known = self.topics.setdefault(name, BagTopic(name, kind))
        if known.kind != kind:
            self.refused[name] = "its type changes within the bag"
            return None
        return known

    def why_nothing(self) -> str:
        """Why the bag has no messages, in a few words."""
        real = [problem for _, problem in self.problems if problem.loss is not Loss.OPEN]
        if real:
            return f"byte {real[0].offset}: {real[0].why}"
        if self.refused:
            name, why = next(iter(self.refused.items()))
            return f"{text_of(name)}: {why}"
        return "it is empty"

    def findings(self) -> list[Finding]:
        found = [*self.damage]
        for path, problem in self.problems[:20]:
            offset, lost = float(problem.offset), float(problem.end - problem.offset)
            if problem.loss is Loss.OPEN:
                text = f"{path.name} was not closed: the recorder was stopped before it could finish."
                found.append(note("integrity", text, offset=offset))
            else:
                text = f"{path.name}: bytes {problem.offset} to {problem.end} are lost, {problem.why}."
                found.append(note("integrity", text, Grade.DEGRADES, offset=offset, bytes=lost))
        for name, why in list(self.refused.items())[:20]:
            found.append(note("mapping", f"The topic {text_of(name)} is not read: {why}."))
        for name, number in self.large.items():
            found.append(note("mapping", f"{number} messages of {text_of(name)} are too large to hold signals."))
        return found


def _name(topic: str) -> str:
    return "/" + topic.strip("/")


def _owner(topic: str) -> str:
    """Robot of a topic: "cf1" for "/cf1/pose", "" for "/pose"."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 else ""


def _robot(path: Path, bag: _Bag, mapping: BagMapping) -> str:
    """The robot to read: the only one, or the one that the user named."""
    owners = sorted(
        {_owner(t.name) for t in bag.topics.values() if t.messages and t.kind.name in ROBOT_TYPES} - {"all", ""}
    )
    names = ", ".join(text_of(o) for o in owners[:20])
    if mapping.robot is not None:
        if mapping.robot not in owners:
            raise UsageError(f'{path}: there is no robot "{mapping.robot}" in the bag; there are: {names or "none"}.')
        return mapping.robot
    if len(owners) > 1:
        raise UsageError(
            f"{path}: the bag holds several robots ({names}); say which with a mapping file (--map) "
            f'that holds the line robot = "{text_of(owners[0])}".'
        )
    return owners[0] if owners else ""


def _user_mapping(file: str | None) -> BagMapping:
    """The mapping file of the user. Raises UsageError or FileFormatError."""
    if file is None:
        return BagMapping()
    table = read_toml(file, what="mapping")
    for key, value in table.items():
        if key not in _MAPPING_KEYS or not isinstance(value, _MAPPING_KEYS[key]):
            known = "robot and twist (texts) and topics (a table)"
            raise FileFormatError(f"{file}: {key} is not what a mapping for a bag can hold: {known}.")
    if table.get("twist", "world") not in ("world", "body"):
        raise FileFormatError(f'{file}: twist must be "world" or "body", not "{table["twist"]}".')
    variables: dict[str, tuple[str, ...]] = {}
    for topic, entry in table.get("topics", {}).items():
        names = entry.get("variables") if isinstance(entry, dict) else None
        if not isinstance(names, list) or not all(isinstance(n, str) and n for n in names):
            raise FileFormatError(f'{file}: topics."{topic}".variables must be a list of names.')
        if len(set(names)) < len(names):
            raise FileFormatError(f'{file}: topics."{topic}".variables names a variable twice.')
        variables[_name(topic)] = tuple(names)
    return BagMapping(file, table.get("robot"), table.get("twist"), variables)
