"""Decode ROS 2 messages of a bag to columns of numbers, with the message definitions in the bag.

rosbags decodes CDR: it makes Python code from a definition and trusts the definition. A long array of elements without
bytes would never end. So this module first reduces a definition to its fields, whose names are plain words. It refuses
a definition if decoding could take many more steps than a message has bytes.

Formats: design.ros2.org/articles/legacy_interface_definition.html, OMG CDR.
"""

import functools
import keyword
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

LARGEST_MESSAGE = 1 << 16  # bytes; larger ones are images, maps and point clouds
_LARGEST_DEFINITION = 1 << 18  # characters
_MOST_FIELDS = 2000  # of a message, with nested ones
_DEEPEST_NESTING = 16
_LARGEST_FIXED_ARRAY = 16  # elements of an array of fixed length that become columns; covariances have 36
_LONGEST_SEQUENCE = 64  # elements of a sequence that become columns
_LINE = re.compile(r"\s*([A-Za-z]\w*(?:/\w+){0,2}(?:<=\d{1,9})?(?:\[(?:<=)?\d{0,9}\])?)\s+([a-z]\w*)\s*(?:[^=\s].*)?$")
_CONSTANT = re.compile(r"\s*[A-Za-z]\w*(?:<=\d{1,9})?\s+[A-Za-z]\w*\s*=")
# numbers and their bytes
_NUMBER_SIZES = {"bool": 1, "byte": 1, "char": 1, "float32": 4, "float64": 8}
_NUMBER_SIZES |= {f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)}
_PRIMITIVE = {*_NUMBER_SIZES, "string", "wstring"}
_TIMES = {"builtin_interfaces/Time", "builtin_interfaces/Duration"}  # of two numbers

_Spec = dict[str, list[tuple[str, bool, int, str]]]  # type -> (type, array, fixed length or 0, name) of each field


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type and its decoder."""

    name: str  # "geometry_msgs/PoseStamped"
    decode: Callable[[bytes], Any]  # function from the bytes of a message to an object with its fields
    scalars: tuple[str, ...]  # dotted names of the numbers
    arrays: tuple[tuple[str, int], ...]  # dotted names and lengths of arrays of numbers; length 0 for sequences
    strings: tuple[str, ...]  # dotted names of the texts
    stamped: bool  # whether there is a `header.stamp`


@functools.lru_cache(maxsize=64)  # making a decoder takes longer than reading a short bag
def message_type(name: str, definition: str) -> MessageType:
    """The message type from its name and definition in a bag. Raises ValueError with the reason if not readable."""
    if len(definition) > _LARGEST_DEFINITION:
        raise ValueError("its definition is too long")
    short = _short(name)
    text, spec = _reduced(short, definition)
    _check(short, spec)
    try:
        decode = _decoder(short.replace("/", "/msg/"), text)
    except Exception as error:  # the parser raises many kinds
        raise ValueError(f"its definition cannot be parsed ({type(error).__name__})") from error
    leaves = list(_leaves(short, spec))
    arrays = tuple((name, length) for base, array, length, name in leaves if array and base in _NUMBER_SIZES)
    scalars = [name for base, array, _, name in leaves if not array and base in _NUMBER_SIZES]
    strings = tuple(name for base, array, _, name in leaves if not array and base not in _NUMBER_SIZES)
    stamped = {"header.stamp.sec", "header.stamp.nanosec"} <= set(scalars)
    own = tuple(s for s in scalars if not (stamped and s.startswith("header.stamp.")))
    return MessageType(short, decode, own, arrays, strings, stamped)


def _decoder(name: str, text: str) -> Callable[[bytes], Any]:
    """The function from the bytes of a message of type "package/msg/Name" to an object with its fields."""
    store = get_typestore(Stores.EMPTY)  # has the types of times and durations
    types = get_types_from_msg(text, name)
    store.register({kind: fields for kind, fields in types.items() if kind not in store.fielddefs})
    store.get_msgdef(name)  # makes the code now
    return functools.partial(store.deserialize_cdr, typename=name)


def standard_definition(name: str) -> str | None:
    """The definition of a type for bags without definitions (older than 2023); None if unknown."""
    try:
        return _standard().generate_msgdef(_short(name).replace("/", "/msg/"), ros_version=2)[0]
    except (KeyError, ValueError, TypesysError):
        return None


@functools.cache
def _standard() -> Typestore:
    """The types of ROS 2 Humble and of crazyswarm2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in CRAZYFLIE.items():
        store.register(get_types_from_msg(text, kind))
    return store


# Sources: IMRCLab/crazyswarm2 (crazyflie_interfaces/msg), IMRCLab/motion_capture_tracking.
_HEADER = "std_msgs/Header header\n"
CRAZYFLIE: dict[str, str] = {
    "crazyflie_interfaces/msg/LogDataGeneric": f"{_HEADER}uint32 timestamp\nfloat32[] values\n",
    "crazyflie_interfaces/msg/Status": f"{_HEADER}uint16 supervisor_info\nfloat32 battery_voltage\nuint8 pm_state\n"
    "uint8 rssi\nuint32 num_rx_broadcast\nuint32 num_tx_broadcast\nuint32 num_rx_unicast\nuint32 num_tx_unicast\n",
    "crazyflie_interfaces/msg/FullState": f"{_HEADER}geometry_msgs/Pose pose\ngeometry_msgs/Twist twist\n"
    "geometry_msgs/Vector3 acc\n",
    "crazyflie_interfaces/msg/Position": f"{_HEADER}float32 x\nfloat32 y\nfloat32 z\nfloat32 yaw\n",
    "motion_capture_tracking_interfaces/msg/NamedPose": "string name\ngeometry_msgs/Pose pose\n",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": f"{_HEADER}"
    "motion_capture_tracking_interfaces/NamedPose[] poses\n",
}


def _short(name: str) -> str:
    """The short form "geometry_msgs/Pose" of "geometry_msgs/msg/Pose" or of itself."""
    parts = name.split("/")
    if not 2 <= len(parts) <= 3 or not all(re.fullmatch(r"\w{1,100}", p) for p in parts):
        raise ValueError("its name is none of a ROS 2 message")
    return f"{parts[0]}/{parts[-1]}"


def _reduced(name: str, definition: str) -> tuple[str, _Spec]:
    """The definition without comments, constants and defaults, as text and as a table."""
    spec: _Spec = {name: []}
    lines: list[str] = []
    current, package = name, name.partition("/")[0]
    for raw in definition.splitlines():
        line = raw.partition("#")[0].rstrip()
        if not line.strip():
            continue
        if set(line.strip()) == {"="}:
            lines.append("=" * 80)
        elif line.startswith("MSG:"):
            current = _short(line[4:].strip())
            package = current.partition("/")[0]
            spec.setdefault(current, [])
            lines.append(f"MSG: {current}")
        elif not _CONSTANT.match(line):
            match = _LINE.match(line)
            if match is None:
                raise ValueError("its definition has a line that is no field")
            base, array, length = _type_of(match[1], package)
            spec[current].append((base, array, length, match[2]))
            lines.append(f"{match[1]} {match[2]}")
    return "\n".join(lines), spec


def _type_of(text: str, package: str) -> tuple[str, bool, int]:
    """Type, whether it is an array, and its fixed length or 0."""
    base, bracket, size = text.partition("[")
    base = base.partition("<=")[0]
    if base not in _PRIMITIVE:
        base = _short(base) if "/" in base else f"{package}/{base}"
    size = size.rstrip("]")
    return base, bool(bracket), int(size) if size and not size.startswith("<=") else 0


def _check(name: str, spec: _Spec) -> None:
    """Raise ValueError if decoding takes more than `_MOST_FIELDS` steps, or more than four per byte of a sequence."""
    counted: dict[str, tuple[int, int]] = {}

    def measure(kind: str, depth: int) -> tuple[int, int]:
        """Steps to decode one message without elements of sequences, and its least number of bytes."""
        if kind in _TIMES and kind not in spec:
            return 2, 8
        if kind in counted:
            return counted[kind]
        if kind not in spec:
            raise ValueError(f"its definition does not hold {kind}")
        if depth > _DEEPEST_NESTING:
            raise ValueError("its definition is nested too deeply")
        steps, size = 1, 0 if spec[kind] else 1
        for base, array, length, _ in spec[kind]:
            one, bytes_of_one = (1, _NUMBER_SIZES.get(base, 4)) if base in _PRIMITIVE else measure(base, depth + 1)
            if array and not length:
                if base not in _PRIMITIVE and one > 4 * bytes_of_one:
                    raise ValueError("its definition has a sequence of things of hardly any size")
                steps, size = steps + one, size + 4
            elif array and base in _PRIMITIVE:  # one step, or one per element while bytes remain
                steps, size = steps + 1, size + (0 if base in ("uint8", "byte") else length * bytes_of_one)
            else:
                steps, size = steps + one * max(length, 1), size + bytes_of_one * max(length, 1)
            if steps > _MOST_FIELDS:
                raise ValueError(f"its definition has more than {_MOST_FIELDS} fields")
        counted[kind] = (steps, size)
        return counted[kind]

    measure(name, 0)


def _leaves(kind: str, spec: _Spec, prefix: str = "") -> Iterator[tuple[str, bool, int, str]]:
    """The fields of a message as in `spec`, with dotted names; long arrays and arrays of messages are left out."""
    if kind in _TIMES and kind not in spec:
        yield from (("uint32", False, 0, prefix + part) for part in ("sec", "nanosec"))
        return
    for base, array, length, name in spec[kind]:
        if base not in _PRIMITIVE and not array:
            yield from _leaves(base, spec, f"{prefix}{name}.")
        elif length <= _LARGEST_FIXED_ARRAY:
            yield base, array, length, prefix + name


@dataclass(slots=True, eq=False)
class Rows:
    """Decoded messages of a topic."""

    # dotted name -> (n,) numbers; elements of arrays as "values[3]", NaN beyond the end of a short one
    columns: dict[str, NDArray[np.float64]]
    stamp: NDArray[np.int64]  # (n,) `header.stamp`, ns since 1970, 0 if absent
    log: NDArray[np.int64]  # (n,) time of arrival at the recorder, ns since 1970
    objects: list[Any]  # the decoded messages, if requested
    broken: int  # number of messages that could not be decoded
    texts: dict[str, str]  # dotted name -> text in the first message


def rows_of(kind: MessageType, messages: Sequence[tuple[int, bytes]], *, keep: bool = False) -> Rows:
    """Decode (log time [ns], bytes) of one topic; `keep` also keeps the objects, for fields that are no columns."""
    numbers: list[tuple[Any, ...]] = []
    lists: list[tuple[Any, ...]] = []
    stamps: list[int] = []
    logs: list[int] = []
    objects: list[Any] = []
    broken = 0
    texts: dict[str, str] = {}
    get_numbers = _getter(kind.scalars)
    get_lists = _getter(tuple(name for name, _ in kind.arrays))
    for log, data in messages:
        try:
            message = kind.decode(data)
            row = get_numbers(message)
            parts = get_lists(message)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec if kind.stamped else 0
        except Exception:  # the code of rosbags raises many kinds on invalid bytes
            broken += 1
            continue
        if not logs:
            texts = {name: str(operator.attrgetter(name)(message)) for name in kind.strings}
        numbers.append(row)
        lists.append(parts)
        stamps.append(stamp)
        logs.append(log)
        if keep:
            objects.append(message)
    table = np.array(numbers, np.float64).reshape(len(logs), len(kind.scalars))
    columns = {name: table[:, i] for i, name in enumerate(kind.scalars)}
    for i, (name, length) in enumerate(kind.arrays):
        columns |= _array_columns(name, length, [parts[i] for parts in lists])
    return Rows(columns, np.array(stamps, np.int64), np.array(logs, np.int64), objects, broken, texts)


def _getter(names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
    # rosbags adds an underscore to names that are Python keywords
    names = tuple(".".join(p + "_" * keyword.iskeyword(p) for p in name.split(".")) for name in names)
    if not names:
        return lambda message: ()
    if len(names) == 1:
        one = operator.attrgetter(names[0])
        return lambda message: (one(message),)
    return operator.attrgetter(*names)


def _array_columns(name: str, length: int, lists: list[Any]) -> dict[str, NDArray[np.float64]]:
    """One column per element; NaN beyond the end of a sequence."""
    longest = length or min(max((len(x) for x in lists), default=0), _LONGEST_SEQUENCE)
    table = np.full((len(lists), longest), np.nan)
    for i, values in enumerate(lists):
        part = list(values)[:longest]
        table[i, : len(part)] = part
    return {f"{name}[{k}]": table[:, k] for k in range(longest)}
