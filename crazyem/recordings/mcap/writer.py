"""Record a flight to MCAP while flying: a call takes microseconds, a separate thread writes.

Chunks are closed twice a second (or at 256 KiB), so a process killed in flight loses at most the last second. Messages
are in the file in the order of the calls, with log times that never decrease, so a replay equals the live flight.
"""

import math
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from crazyem.errors import UsageError
from crazyem.links.base import LinkStatistics, ParameterWrite
from crazyem.recordings.mcap import schemas
from crazyem.recordings.mcap.output import Output, reopen
from crazyem.signals.sample import Block, Packet, Sample
from crazyem.signals.vocabulary import BlockDecoder, decoders

if TYPE_CHECKING:  # for type checks only: the recorder does not compute estimates
    from crazyem.estimation.result import Estimate

FLUSH_PERIOD = 0.5  # s


class Setpoint(Protocol):
    """Interface of a reference for `RecordingWriter.setpoint`: m, m/s, m/s^2 (world), rad, rad/s."""

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
        path: the file; its folder must exist.
        metadata: section -> key -> text, written first: run configuration, vehicle TOML, parameter table.
        append: continue an existing recording (finished or cut off) as a new session instead of replacing it. Channels
            are announced again, sequence numbers and log times continue, sections of metadata are named
            "session 2: configuration". The file changes with the first write of the new session, which replaces only
            the summary at the end; `close` writes a new summary.
        output: takes the messages instead of a file: an object with the methods of `Output` and `close`.

    Attributes:
        path: the file, as text.
        failure: why writing stopped (disk full, ...), "" without failure. The flight continues after a failure.
        session: number of this session in the file, from 1.

    Raises: UsageError if the file cannot be created; with `append`, FileFormatError if it cannot be continued.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        *,
        append: bool = False,
        output: Any = None,
    ) -> None:
        self.path = str(path)
        self.failure = ""
        self.session = 1
        self._sequence = 0
        self._log_time = 0
        self._queue: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._codecs: dict[int, tuple[int, schemas.BlockCodec]] = {}
        self._blocks: dict[int, Block] = {}
        self._decoders: dict[int, BlockDecoder] = {}
        self._channels: dict[str, int] = {}
        self._attitude: tuple[float, ...] | None = None
        self._pose_time = -math.inf
        self._link_before: tuple[float, int, int] | None = None
        self._closed = False
        self._lock = threading.Lock()
        self._file: Any = None
        self._output: Any = None
        try:
            if output is not None:
                self._file = self._output = output
            elif append and Path(path).exists() and Path(path).stat().st_size:
                self._reopen(Path(path))
            else:
                self._file = open(path, "wb")  # noqa: SIM115 - closed by `close`
                self._output = Output(self._file)
            self._begin(metadata or {})
        except OSError as error:
            raise UsageError(f"{path} cannot be written: {error.strerror or error}.") from error
        self._thread = threading.Thread(target=self._run, name="crazyem-recorder", daemon=True)
        self._thread.start()

    def _reopen(self, path: Path) -> None:
        before = reopen(path)
        self._file = before.stream
        self._output = Output(self._file, book=before.book, offset=before.offset)
        self.session = before.sessions + 1
        self._sequence, self._log_time = before.sequence, before.log_time

    def _begin(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        if self.session == 1:
            self._output.start(schemas.PROFILE, f"crazyem {schemas.versions()['crazyem']}")
        self._write_metadata("crazyem", schemas.versions())
        for section, entries in metadata.items():
            self._write_metadata(section, {k: str(v) for k, v in entries.items()})
        self._output.flush(sync=True)

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
        """Record a log packet, unchanged."""
        self._put(self._write_packet, packet)

    def frame(self, host_time: float, data: bytes) -> None:
        """Record a MAVLink frame, unchanged, as a tlog does; `host_time` in s since the epoch."""
        self._put(self._write_frame, host_time, data)

    def setpoint(self, time: float, reference: Setpoint) -> None:
        """Record a setpoint; `time` in s on the firmware clock."""
        self._put(self._write_setpoint, time, _now(), reference)

    def parameter_write(self, write: ParameterWrite) -> None:
        """Record a write of a parameter and its result."""
        fields = {"host_time": write.host_time, "name": write.name, "verified": write.verified}
        fields |= {"value": float(write.value), "echoed": math.nan if write.echoed is None else float(write.echoed)}
        self._put(self._write, *schemas.EVENT_TOPICS["parameter_write"], write.host_time, fields)

    def estimate(self, estimate: "Estimate") -> None:
        """Record an update of the estimator."""
        self._put(self._write_estimate, _now(), estimate)

    def link(self, statistics: LinkStatistics, latency: float = math.nan) -> None:
        """Record the packets so far (received, lost, late), once a second; `latency` in s, if known."""
        self._put(self._write_link, _now(), statistics, latency)

    def residual(self, time: float, values: Sequence[float], sd: Sequence[float]) -> None:
        """Record the residual of the newest sample: measured minus predicted.

        Args:
            time: s on the firmware clock.
            values: (12,) position [m], velocity [m/s], attitude [rad], body rate [rad/s]; NaN where not measured.
            sd: (12,) their expected standard deviations.
        """
        fields = {"time": float(time), "host_time": _now()}
        for name, value, deviation in zip(schemas.RESIDUALS.split(), values, sd, strict=True):
            fields |= {name: float(value), f"{name}_sd": float(deviation)}
        self._put(self._write, *schemas.EVENT_TOPICS["residual"], fields["host_time"], fields)

    def event(self, text: str, level: str = "INFO") -> None:
        """Record a message such as a phase of the flight or a warning; `level` as in foxglove.Log."""
        now = _now()
        stamp = schemas.timestamp(_nanoseconds(now))
        fields = {"timestamp": stamp, "level": level, "message": text, "name": "crazyem"}
        self._put(self._write, *schemas.EVENT_TOPICS["log"], now, fields)

    def close(self) -> None:
        """Write all data and finish the file; may be called twice."""
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
            due = time.monotonic() + FLUSH_PERIOD
            while True:
                try:
                    item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                except queue.Empty:
                    item = (self._flush, ())
                if item is None:
                    break
                item[0](*item[1])
                if time.monotonic() >= due:
                    self._flush()
                    due = time.monotonic() + FLUSH_PERIOD
            ended = True
            self._output.finish()
        except (OSError, ValueError, TypeError) as error:
            self.failure = f"{self.path}: recording stopped: {error}."
            while not ended:  # keep the queue empty until the end, so that memory does not grow
                ended = self._queue.get() is None
        finally:
            try:
                self._file.close()
            except OSError as error:
                self.failure = self.failure or f"{self.path}: recording stopped: {error}."

    def _flush(self) -> None:
        self._output.flush(sync=True)  # data that are not on the disk are lost at a power loss

    def _message(self, channel: int, host_time: float, data: bytes) -> None:
        if math.isfinite(host_time):
            self._log_time = min(max(self._log_time, int(host_time * 1e9)), 2**63 - 1)
        self._sequence += 1
        self._output.message(channel, self._log_time, data, publish_time=self._log_time, sequence=self._sequence)

    def _channel(self, topic: str, schema_name: str) -> int:
        if topic not in self._channels:
            schema = self._output.schema(schema_name, "protobuf", schemas.schema_data(schema_name))
            self._channels[topic] = self._output.channel(topic, "protobuf", schema)
        return self._channels[topic]

    def _write_metadata(self, section: str, entries: dict[str, str]) -> None:
        name = section if self.session == 1 else f"session {self.session}: {section}"
        self._output.metadata(name, entries)

    def _write_blocks(self, blocks: tuple[Block, ...]) -> None:
        for block in blocks:
            if block.identifier in self._blocks:
                continue
            codec = schemas.BlockCodec(block)
            schema = self._output.schema(codec.schema_name, "protobuf", codec.schema_data())
            metadata = {**codec.metadata(), "session": str(self.session)}
            channel = self._output.channel(f"/log/{block.identifier}", "protobuf", schema, metadata)
            self._codecs[block.identifier] = (channel, codec)
            self._blocks[block.identifier] = block
        shown = decoders(self._blocks.values())
        # decode only signals for the pose in viewers
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
        if decoder is not None and packet.firmware_time_ms / 1000.0 - self._pose_time >= schemas.POSE_PERIOD:
            self._write_pose(decoder.decode(packet))

    def _write_frame(self, host_time: float, data: bytes) -> None:
        if schemas.FRAMES_TOPIC not in self._channels:
            self._channels[schemas.FRAMES_TOPIC] = self._output.channel(
                schemas.FRAMES_TOPIC, "mavlink", 0
            )  # 0: there is no schema
        self._message(self._channels[schemas.FRAMES_TOPIC], host_time, data)

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
        for topic, schema, fields in schemas.pose_messages(_nanoseconds(host_time), translation, rotation):
            self._write(topic, schema, host_time, fields)

    def _write_setpoint(self, time: float, host_time: float, reference: Setpoint) -> None:
        fields = {"time": time, "host_time": host_time, "yaw": reference.yaw, "yaw_rate": reference.yaw_rate}
        for what in ("position", "velocity", "acceleration"):
            for axis, value in zip("xyz", getattr(reference, what), strict=True):
                fields[f"{what}_{axis}"] = float(value)
        self._write(*schemas.EVENT_TOPICS["setpoint"], host_time, fields)

    def _write_estimate(self, host_time: float, estimate: "Estimate") -> None:
        parameters = []
        for name, p in estimate.parameters.items():
            numbers = dict(
                zip(("value", "sd", "ci95_low", "ci95_high"), map(float, (p.value, p.sd, *p.ci95)), strict=True)
            )
            about = {"name": name, "unit": p.unit, "identifiable": bool(p.identifiable), "reason": p.reason}
            parameters.append(about | numbers)
        fields = {"time": float(estimate.time), "host_time": host_time, "parameters": parameters}
        fields |= {"samples": int(estimate.samples), "updates": int(estimate.updates)}
        fields["converged"] = bool(estimate.converged)
        self._write(*schemas.EVENT_TOPICS["estimate"], host_time, fields)

    def _write_link(self, host_time: float, statistics: LinkStatistics, latency: float) -> None:
        names = ("received", "lost", "late", "round_trip", "clock_offset", "clock_rate", "outages")
        fields: dict[str, Any] = {name: getattr(statistics, name) for name in names}
        fields |= {"host_time": host_time, "latency": latency, "rate": math.nan, "loss": math.nan}
        before = self._link_before
        if before is not None and host_time > before[0]:
            received, lost = statistics.received - before[1], statistics.lost - before[2]
            fields["rate"] = received / (host_time - before[0])
            fields["loss"] = lost / (received + lost) if received + lost > 0 else math.nan
        self._link_before = (host_time, statistics.received, statistics.lost)
        self._write(*schemas.EVENT_TOPICS["link"], host_time, fields)

    def _write(self, topic: str, schema: str, host_time: float, fields: dict[str, Any]) -> None:
        self._message(self._channel(topic, schema), host_time, schemas.encode(schema, fields))


def _now() -> float:
    return time.time()


def _nanoseconds(host_time: float) -> int:
    return int(min(max(host_time, 0.0), 9.0e9) * 1e9) if math.isfinite(host_time) else 0
