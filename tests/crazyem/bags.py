"""Writes rosbag2 MCAP files for tests, with mcap-ros2-support."""

import io
from collections.abc import Iterable
from typing import Any

import numpy as np
from mcap.writer import Writer as PlainWriter
from mcap_ros2.writer import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

START = 1_700_000_000_000_000_000  # ns since 1970
LINE = "=" * 80
_STORE = get_typestore(Stores.ROS2_HUMBLE)
HEADER = f"{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
HEADER += f"{LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
POINT = f"{LINE}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
VECTOR = f"{LINE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
QUATERNION = f"{LINE}\nMSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
POSE = f"{LINE}\nMSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n{POINT}{QUATERNION}"
TWIST = f"{LINE}\nMSG: geometry_msgs/Twist\nVector3  linear\nVector3  angular\n{VECTOR}"
PUBLISHED = ("nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage", "std_msgs/msg/String")
DEFINITIONS = {kind: _STORE.generate_msgdef(kind, ros_version=2)[0] for kind in PUBLISHED} | {
    "geometry_msgs/msg/PoseStamped": f"# a pose\nstd_msgs/Header header\ngeometry_msgs/Pose pose\n{HEADER}{POSE}",
    "crazyflie_interfaces/msg/LogDataGeneric": "std_msgs/Header header  # when it was received\n"
    f"uint32 timestamp # in ms\nfloat32[] values\n{HEADER}",
    "crazyflie_interfaces/msg/Status": "uint16 SUPERVISOR_INFO_CAN_BE_ARMED = 1\nuint16 SUPERVISOR_INFO_IS_FLYING=16\n"
    "std_msgs/Header header\nuint16 supervisor_info\nfloat32 battery_voltage\nuint8 pm_state\nuint8 rssi\n"
    f"uint32 num_rx_broadcast\nuint32 num_tx_broadcast\nuint32 num_rx_unicast\nuint32 num_tx_unicast\n{HEADER}",
    "crazyflie_interfaces/msg/FullState": "std_msgs/Header header\ngeometry_msgs/Pose pose\ngeometry_msgs/Twist twist\n"
    f"geometry_msgs/Vector3 acc\n{HEADER}{POSE}{TWIST}",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": "std_msgs/Header header\nNamedPose[] poses\n"
    f"{LINE}\nMSG: motion_capture_tracking_interfaces/NamedPose\nstring name\ngeometry_msgs/Pose pose\n{HEADER}{POSE}",
}

Message = tuple[str, str, int, Any]  # topic, type, log time, message


def bag(messages: Iterable[Message], chunk: int = 2000) -> bytes:
    output = io.BytesIO()
    writer = Writer(output, chunk_size=chunk)
    schemas: dict[str, Any] = {}
    for topic, kind, log, message in messages:
        if kind not in schemas:
            schemas[kind] = writer.register_msgdef(kind, DEFINITIONS[kind])
        writer.write_message(topic, schemas[kind], message, log_time=log, publish_time=log)
    writer.finish()
    return output.getvalue()


def raw_bag(kind: str, definition: str, payloads: Iterable[bytes], chunk: int = 1 << 20) -> bytes:
    """A bag of any bytes as messages of the topic /cf1/a."""
    output = io.BytesIO()
    writer = PlainWriter(output, chunk_size=chunk)
    writer.start(profile="ros2", library="")
    schema = writer.register_schema(kind, "ros2msg", definition.encode())
    channel = writer.register_channel("/cf1/a", "cdr", schema)
    for payload in payloads:
        writer.add_message(channel, START, payload, START)
    writer.finish()
    return output.getvalue()


def stamp(ns: int, frame: str = "world") -> dict[str, Any]:
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame}


def vector(values: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def quaternion(values: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=True))


def pose(values: Any) -> dict[str, Any]:
    return {"position": vector(values[:3]), "orientation": quaternion(values[3:7])}


def random_poses(n: int, seed: int = 1) -> np.ndarray:
    turns = Rotation.random(n, random_state=seed).as_quat()
    return np.column_stack([np.random.default_rng(seed).normal(size=(n, 3)), turns])


def pose_message(topic: str, ns: int, values: Any, late: int = 700_000) -> Message:
    return topic, "geometry_msgs/msg/PoseStamped", ns + late, {"header": stamp(ns), "pose": pose(values)}


def pose_messages(values: Iterable[Any], first: int = START, step: int = 10**7) -> list[Message]:
    """Poses of the topic /cf1/pose, by default 100 a second."""
    return [pose_message("/cf1/pose", first + i * step, v) for i, v in enumerate(values)]


def odometry(topic: str, ns: int, values: Any, linear: Any, angular: Any = (0, 0, 0), child: str = "") -> Message:
    message = {
        "header": stamp(ns),
        "child_frame_id": child,
        "pose": {"pose": pose(values), "covariance": [0.0] * 36},
        "twist": {"twist": {"linear": vector(linear), "angular": vector(angular)}, "covariance": [0.0] * 36},
    }
    return topic, "nav_msgs/msg/Odometry", ns, message


def log_block(topic: str, ns: int, firmware_ms: int, values: Any, late: int = 0) -> Message:
    message = {"header": stamp(ns + late), "timestamp": firmware_ms, "values": [float(v) for v in values]}
    return topic, "crazyflie_interfaces/msg/LogDataGeneric", ns + late, message


def status(topic: str, ns: int, info: int, volts: float) -> Message:
    names = ("pm_state", "rssi", "num_rx_broadcast", "num_tx_broadcast", "num_rx_unicast", "num_tx_unicast")
    message = {"header": stamp(ns), "supervisor_info": info, "battery_voltage": volts, **dict.fromkeys(names, 0)}
    return topic, "crazyflie_interfaces/msg/Status", ns, message
