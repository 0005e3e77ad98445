"""Shared by both writers of MCAP files: topics of events, poses for viewers, versions."""

from importlib import metadata as package_metadata
from typing import Any

PROFILE = "crazyem"
FORMAT_VERSION = "1"
WORLD_FRAME, BODY_FRAME = "world", "crazyflie"
POSE_PERIOD = 0.04  # s between poses, which are for viewers only

# kind of event -> topic, schema
EVENT_TOPICS: dict[str, tuple[str, str]] = {
    "setpoint": ("/setpoint", "crazyem.Setpoint"),
    "parameter_write": ("/parameter_write", "crazyem.ParameterWrite"),
    "estimate": ("/estimate", "crazyem.Estimate"),
    "log": ("/events", "foxglove.Log"),
    "link": ("/link", "crazyem.Link"),
    "residual": ("/residual", "crazyem.Residual"),
}
OTHER_EVENT_TOPIC = ("/other_events", "crazyem.Event")
FINDINGS_TOPIC = "/findings"
FRAMES_TOPIC = "/mavlink"  # unchanged frames, message encoding "mavlink"; for other programs, never read back


def pose_messages(
    nanoseconds: int, translation: dict[str, float], rotation: dict[str, float]
) -> list[tuple[str, str, dict[str, Any]]]:
    """Topic, schema and fields of a pose (m, quaternion body to world) for viewers; time since 1970."""
    stamp = timestamp(nanoseconds)
    pose = {"position": translation, "orientation": rotation}
    frame = {
        "parent_frame_id": WORLD_FRAME,
        "child_frame_id": BODY_FRAME,
        "translation": translation,
        "rotation": rotation,
    }
    return [
        ("/pose", "foxglove.PoseInFrame", {"timestamp": stamp, "frame_id": WORLD_FRAME, "pose": pose}),
        ("/tf", "foxglove.FrameTransform", {"timestamp": stamp, **frame}),
    ]


def timestamp(nanoseconds: int) -> dict[str, int]:
    """Fields of google.protobuf.Timestamp."""
    return {"seconds": nanoseconds // 10**9, "nanos": nanoseconds % 10**9}


def fields_of(message: Any) -> dict[str, object]:
    """All fields of a message by name; nested messages as dictionaries, NaN is kept (echo that never arrived)."""
    result: dict[str, object] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            result[field.name] = value
        elif isinstance(value, (list, tuple)) or hasattr(value, "add"):
            result[field.name] = [fields_of(item) for item in value]
        else:
            result[field.name] = fields_of(value)
    return result


def versions() -> dict[str, str]:
    """Versions of the format and of the packages that write a file."""
    names = ("crazyem", "cflib", "mcap", "numpy")
    return {"format": FORMAT_VERSION, **{name: _version(name) for name in names}}


def _version(package: str) -> str:
    try:
        return package_metadata.version(package)
    except package_metadata.PackageNotFoundError:
        return "unknown"
