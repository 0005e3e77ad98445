"""One small valid file of every format, and ways to damage it: what the fuzz tests and the fuzzer start from."""

import gzip
import io
import random
import struct
from pathlib import Path

INTERESTING = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1)


def seeds(folder: Path) -> dict[str, bytes]:
    """Format -> bytes of a small valid file. `folder` is for scratch files."""
    from test_recordings_cfclient import STATE, as_cfclient, rows_of
    from test_recordings_csv import rows, text
    from test_recordings_tlog import flight as tlog
    from test_recordings_ulog import flight as ulog
    from test_recordings_usd import small_log

    nanobench = text(rows(12)).encode()
    return {
        "usd1": small_log(1)[2], "usd2": small_log(2)[2], "ulog": ulog(rows=6)[0], "tlog": tlog(rows=4)[0],
        "cfclient": as_cfclient(STATE, rows_of(STATE)).encode(),
        "nanobench": nanobench,
        "nanobench.gz": gzip.compress(nanobench, mtime=0),
        "long": _long(), "mcap": _ours(folder / "ours.mcap"), "imported": _imported(folder, nanobench),
        "exported": _exported(folder, nanobench), "rosbag2": _rosbag2(folder / "bag.mcap"),
    }  # fmt: skip


def _long() -> bytes:
    lines = ["host_t,block,fw_ms,name,value"]
    for i in range(8):
        for name, value in (("stateEstimateZ.x", 5 * i), ("stateEstimateZ.y", -i), ("stateEstimateZ.z", 1000)):
            lines.append(f"{1.7e9 + 0.01 * i:.6f},pos,{1000 + 10 * i},{name},{value}")
        lines.append(f"{1.7e9 + 0.01 * i:.6f},ref,,ref.x,{0.1 * i}")
    return ("\n".join(lines) + "\n").encode()


def _ours(path: Path) -> bytes:
    from crazyem.recordings.mcap.writer import RecordingWriter
    from crazyem.signals.sample import Block, Packet, Variable

    block = Block(3, tuple(Variable(f"stateEstimate.{v}", "float") for v in ("x", "y", "z", "vx", "vy", "vz")), 10)
    with RecordingWriter(path, {"configuration": {"window": "800"}}) as writer:
        writer.blocks([block])
        for i in range(30):
            writer.packet(Packet(3, 1000 + 10 * i, 1.7e9 + 0.01 * i, (0.1 * i, 1.0, -1.0, 0.0, 2.0, 3.0)))
        writer.event("the end")
    return path.read_bytes()


def _imported(folder: Path, content: bytes) -> bytes:
    from crazyem.recordings import open_recording
    from crazyem.recordings.mcap.signals import write_recording

    source, target = folder / "seed.csv", folder / "imported.mcap"
    source.write_bytes(content)
    target.unlink(missing_ok=True)
    write_recording(open_recording(source), target)
    return target.read_bytes()


def _exported(folder: Path, content: bytes) -> bytes:
    from crazyem.cli import main

    source, target = folder / "seed.csv", folder / "exported.csv"
    source.write_bytes(content)
    assert main(["export", str(source), "-o", str(target), "--force"]) == 0
    return target.read_bytes()


def _rosbag2(path: Path) -> bytes:
    from mcap_ros2.writer import Writer

    vector = "float64 x\nfloat64 y\nfloat64 z\n"
    parts = {
        "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
        "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        "geometry_msgs/Point": vector,
        "geometry_msgs/Quaternion": f"{vector}float64 w\n",
    }
    definition = "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    definition += "".join(f"{'=' * 80}\nMSG: {name}\n{text}" for name, text in parts.items())
    stream = io.BytesIO()
    writer = Writer(stream)
    schema = writer.register_msgdef("geometry_msgs/msg/PoseStamped", definition)
    for i in range(10):
        stamp = {"sec": 1_700_000_000, "nanosec": 10_000_000 * i}
        pose = {"position": {"x": 0.1 * i, "y": 0.0, "z": 1.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
        message = {"header": {"stamp": stamp, "frame_id": "world"}, "pose": pose}
        time = 10**9 * 1_700_000_000 + 10_000_000 * i
        writer.write_message("/cf1/pose", schema, message, log_time=time, publish_time=time)
    writer.finish()
    return stream.getvalue()


def damage(data: bytes, rng: random.Random) -> bytes:
    """A damaged copy: one to six random edits of the kinds that break parsers."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        if not out:
            break
        at = rng.randrange(len(out))
        kind = rng.randrange(7)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.randrange(256)
        elif kind == 2:  # a length or a count that lies
            width = rng.choice((1, 2, 4, 8))
            value = rng.choice(INTERESTING) % (1 << 8 * width)
            out[at : at + width] = value.to_bytes(width, rng.choice(("little", "big")))
        elif kind == 3:
            del out[at:]
        elif kind == 4:
            del out[at : at + rng.randint(1, 40)]
        elif kind == 5:
            end = min(len(out), at + rng.randint(1, 200))
            out[at:at] = rng.choice((out[at:end] * rng.randint(1, 3), rng.randbytes(rng.randint(1, 40))))
        else:
            out[at : at + 8] = struct.pack("<d", rng.choice((float("nan"), float("inf"), -1e308, 1e-320, 2.0**63)))
    return bytes(out)
