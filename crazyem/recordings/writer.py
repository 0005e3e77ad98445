"""Writing a flight to MCAP while flying: calls cost microseconds, a thread of its own does the work.

Chunks are closed twice a second (or at 256 KiB), so a process killed in mid-flight loses at most the last second.
Messages stand in the file in the order of the calls, with log times that never decrease: replay sees what was seen.
"""

import math
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata as package_metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mcap.writer import CompressionType, Writer

from crazyem.errors import UsageError
from crazyem.links.base import ParameterWrite
from crazyem.recordings import schemas
from crazyem.signals.packet import Block, Packet
from crazyem.signals.sample import Sample
from crazyem.signals.vocabulary import BlockDecoder, decoders

if TYPE_CHECKING:  # the recorder takes results and does not compute them
    from crazyem.estimation.result import Estimate

FORMAT_VERSION = "1"
PROFILE = "crazyem"
CHUNK_BYTES = 256 * 1024
FLUSH_EVERY = 0.5  # s
POSE_EVERY = 0.04  # s of firmware time between poses, which are for viewers only
WORLD, BODY = "world", "crazyflie"


class Setpoint(Protocol):
    """What `RecordingWriter.setpoint` needs of a reference: m, m/s, m/s^2 (world), rad, rad/s."""

    @property
    def position(self) -> Sequence[float]: ...
    @property
    def velocity(self) -> Sequence[float]: ...
    @property
    def acceleration(self) -> Sequence[float]: ...
    @property
    def yaw(self) -> float: ...
    @property
    def yaw_rate(self) -> float: ...


class RecordingWriter:
    """A recording in progress. All methods but `close` return at once and may be called from any thread.

    Args:
        path: the file; its folder must exist, an existing file is replaced.
        metadata: section -> key -> text, written first: run configuration, vehicle TOML, parameter table.

    Attributes:
        path: the file, as text.
        failure: why writing stopped (disk full, ...), "" while all is well. Flying goes on regardless.

    Raises: UsageError if the file cannot be created.
    """

    def __init__(self, path: str | Path, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        self.path = str(path)
        self.failure = ""
        try:
            self._file = open(path, "wb")  # noqa: SIM115 - closed by `close`
        except OSError as error:
            raise UsageError(f"{path} cannot be written: {error.strerror or error}.") from error
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._queue: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._codecs: dict[int, tuple[int, schemas.BlockCodec]] = {}
        self._blocks: dict[int, Block] = {}
        self._decoders: dict[int, BlockDecoder] = {}
        self._channels: dict[str, int] = {}
        self._attitude: tuple[float, ...] | None = None
        self._pose_time = -math.inf
        self._sequence = 0
        self._log_time = 0
        self._closed = False
        self._lock = threading.Lock()
        try:
            self._begin(metadata or {})
        except OSError as error:
            raise UsageError(f"{path} cannot be written: {error.strerror or error}.") from error
        self._thread = threading.Thread(target=self._run, name="crazyem-recorder", daemon=True)
        self._thread.start()

    def _begin(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        self._writer.start(profile=PROFILE, library=f"crazyem {_version('crazyem')}")
        versions = {name: _version(name) for name in ("crazyem", "cflib", "mcap", "numpy")}
        self._writer.add_metadata("crazyem", {"format": FORMAT_VERSION, **versions})
        for section, entries in metadata.items():
            self._write_metadata(section, {k: str(v) for k, v in entries.items()})
        self._writer.flush()

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- what to record ---------------------------------------------------------------------------------------------

    def metadata(self, section: str, entries: Mapping[str, str]) -> None:
        """Add one section of metadata."""
        self._put(self._write_metadata, section, {k: str(v) for k, v in entries.items()})

    def blocks(self, blocks: Sequence[Block]) -> None:
        """Announce log blocks; packets of a block are recorded from then on."""
        self._put(self._write_blocks, tuple(blocks))

    def packet(self, packet: Packet) -> None:
        """A log packet as it came."""
        self._put(self._write_packet, packet)

    def setpoint(self, time: float, reference: Setpoint) -> None:
        """A setpoint sent, `time` in s on the firmware clock."""
        self._put(self._write_setpoint, time, _now(), reference)

    def parameter_write(self, write: ParameterWrite) -> None:
        """A parameter write and what became of it."""
        self._put(self._write_parameter, write)

    def estimate(self, estimate: "Estimate") -> None:
        """An update of the estimator."""
        self._put(self._write_estimate, _now(), estimate)

    def event(self, text: str, level: str = "INFO") -> None:
        """A remark: a phase of the flight, a warning. `level` is one of foxglove.Log's."""
        self._put(self._write_event, _now(), text, level)

    def close(self) -> None:
        """Write everything out and finish the file; safe to call twice."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._queue.put(None)
        self._thread.join()

    def _put(self, function: Callable[..., None], *arguments: Any) -> None:
        with self._lock:
            if not self._closed:
                self._queue.put((function, arguments))

    # --- the writing thread -----------------------------------------------------------------------------------------

    def _run(self) -> None:
        ended = False
        try:
            due = time.monotonic() + FLUSH_EVERY
            while True:
                try:
                    item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                except queue.Empty:
                    item = (self._writer.flush, ())
                if item is None:
                    break
                item[0](*item[1])
                if time.monotonic() >= due:
                    self._writer.flush()
                    due = time.monotonic() + FLUSH_EVERY
            ended = True
            self._writer.finish()
        except (OSError, ValueError, TypeError) as error:
            self.failure = f"{self.path}: recording stopped: {error}."
            while not ended:  # keep the queue empty until the end, so that memory does not grow
                ended = self._queue.get() is None
        finally:
            try:
                self._file.close()
            except OSError as error:
                self.failure = self.failure or f"{self.path}: recording stopped: {error}."

    def _message(self, channel: int, host_time: float, data: bytes) -> None:
        if math.isfinite(host_time):
            self._log_time = max(self._log_time, int(host_time * 1e9))
        self._sequence += 1
        self._writer.add_message(
            channel, self._log_time, data, publish_time=self._log_time, sequence=self._sequence & 0xFFFFFFFF
        )

    def _channel(self, topic: str, schema_name: str) -> int:
        if topic not in self._channels:
            schema = self._writer.register_schema(schema_name, "protobuf", schemas.schema_data(schema_name))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema)
        return self._channels[topic]

    def _write_metadata(self, section: str, entries: dict[str, str]) -> None:
        self._writer.add_metadata(section, entries)

    def _write_blocks(self, blocks: tuple[Block, ...]) -> None:
        for block in blocks:
            if block.identifier in self._blocks:
                continue
            codec = schemas.BlockCodec(block)
            schema = self._writer.register_schema(codec.schema_name, "protobuf", codec.schema_data())
            topic = f"/log/{block.identifier}"
            channel = self._writer.register_channel(topic, "protobuf", schema, codec.metadata())
            self._codecs[block.identifier] = (channel, codec)
            self._blocks[block.identifier] = block
        shown = decoders(self._blocks.values())
        # only what a viewer's pose needs is decoded here
        self._decoders = {
            i: BlockDecoder(d.block, wanted)
            for i, d in shown.items()
            if (wanted := {"position", "attitude"}.intersection(d.signals))
        }

    def _write_packet(self, packet: Packet) -> None:
        known = self._codecs.get(packet.block)
        if known is None:
            return
        self._message(known[0], packet.host_time, known[1].encode(packet))
        decoder = self._decoders.get(packet.block)
        if decoder is not None and packet.firmware_time_ms / 1000.0 - self._pose_time >= POSE_EVERY:
            self._write_pose(decoder.decode(packet))

    def _write_pose(self, samples: list[Sample]) -> None:
        """foxglove.PoseInFrame and FrameTransform, for the 3D panels of viewers."""
        position = None
        for sample in samples:
            if sample.signal == "attitude":
                self._attitude = sample.value
            else:
                position = sample
        if position is None or self._attitude is None:
            return
        self._pose_time = position.time
        host_time = position.host_time
        translation = dict(zip("xyz", position.value, strict=True))
        rotation = dict(zip("xyzw", self._attitude, strict=True))
        stamp = _timestamp(host_time)
        pose = schemas.message_class("foxglove.PoseInFrame")(
            timestamp=stamp, frame_id=WORLD, pose={"position": translation, "orientation": rotation}
        )
        self._message(self._channel("/pose", "foxglove.PoseInFrame"), host_time, pose.SerializeToString())
        frame = schemas.message_class("foxglove.FrameTransform")(
            timestamp=stamp, parent_frame_id=WORLD, child_frame_id=BODY, translation=translation, rotation=rotation
        )
        self._message(self._channel("/tf", "foxglove.FrameTransform"), host_time, frame.SerializeToString())

    def _write_setpoint(self, time: float, host_time: float, reference: Setpoint) -> None:
        fields = {"time": time, "host_time": host_time, "yaw": reference.yaw, "yaw_rate": reference.yaw_rate}
        for what in ("position", "velocity", "acceleration"):
            for axis, value in zip("xyz", getattr(reference, what), strict=True):
                fields[f"{what}_{axis}"] = float(value)
        self._write("/setpoint", "crazyem.Setpoint", host_time, fields)

    def _write_parameter(self, write: ParameterWrite) -> None:
        fields = {
            "host_time": write.host_time,
            "name": write.name,
            "value": float(write.value),
            "echoed": math.nan if write.echoed is None else float(write.echoed),
            "verified": write.verified,
        }
        self._write("/parameter_write", "crazyem.ParameterWrite", write.host_time, fields)

    def _write_estimate(self, host_time: float, estimate: "Estimate") -> None:
        parameters = [
            {
                "name": name,
                "value": float(p.value),
                "sd": float(p.sd),
                "ci95_low": float(p.ci95[0]),
                "ci95_high": float(p.ci95[1]),
                "unit": p.unit,
                "identifiable": bool(p.identifiable),
                "reason": p.reason,
            }
            for name, p in estimate.parameters.items()
        ]
        fields = {
            "time": float(estimate.time),
            "host_time": host_time,
            "parameters": parameters,
            "samples": int(estimate.samples),
            "updates": int(estimate.updates),
            "converged": bool(estimate.converged),
        }
        self._write("/estimate", "crazyem.Estimate", host_time, fields)

    def _write_event(self, host_time: float, text: str, level: str) -> None:
        fields = {"timestamp": _timestamp(host_time), "level": level, "message": text, "name": "crazyem"}
        self._write("/events", "foxglove.Log", host_time, fields)

    def _write(self, topic: str, schema: str, host_time: float, fields: dict[str, Any]) -> None:
        self._message(
            self._channel(topic, schema), host_time, schemas.message_class(schema)(**fields).SerializeToString()
        )


def _now() -> float:
    return time.time()


def _timestamp(host_time: float) -> dict[str, int]:
    nanoseconds = int(host_time * 1e9) if math.isfinite(host_time) else 0
    return {"seconds": nanoseconds // 10**9, "nanos": nanoseconds % 10**9}


def _version(package: str) -> str:
    try:
        return package_metadata.version(package)
    except package_metadata.PackageNotFoundError:
        return "unknown"
