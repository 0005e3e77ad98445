"""The live stream: a recording's topics and messages, over a WebSocket on this host, read by somebody else's client."""

import json
import re
import socket
import struct
import sys

import pytest
from fake_drone import FakeEstimator, FakeLink
from fake_flight import Recorder

from crazyem.cli import main
from crazyem.errors import UsageError
from crazyem.live import foxglove as live
from crazyem.live.session import Session
from crazyem.recordings.mcap.layout import foxglove_layout, swarm_layout
from crazyem.recordings.mcap.schemas import message_class
from crazyem.vehicle import load_vehicle


def test_without_the_extra_there_is_one_sentence(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(UsageError, match=r"pip install 'crazyem\[live\]'"):
        live.FoxgloveServer(0)
    assert main(["watch", "udp://127.0.0.1:9", "--foxglove"]) == 2
    assert "--foxglove needs foxglove, which is not installed" in capsys.readouterr().err


def test_a_file_and_a_stream_get_the_same_and_the_file_counts():
    file, stream = Recorder("a.mcap"), Recorder("never")
    file.failure, stream.failure = "disk full", "irrelevant"
    both = live.Both(file, stream)
    assert (both.path, both.failure) == ("a.mcap", "disk full")
    both.event("x")
    both.packet(1)
    both.link(2, 0.1)
    both.residual(1.0, [0.0], [1.0])
    both.close()
    assert file.calls == stream.calls
    assert [name for name, _ in file.calls] == ["event", "packet", "link", "residual", "close"]
    alone = live.Both(None, stream)
    assert (alone.path, alone.failure) == ("", "")


@pytest.fixture
def server():
    pytest.importorskip("foxglove")
    with live.FoxgloveServer(0) as one:
        yield one


def test_it_listens_on_this_host_only_and_a_port_in_use_is_one_sentence(server):
    assert server.url == f"ws://127.0.0.1:{server.port}"
    with pytest.raises(UsageError, match=f"cannot listen on 127.0.0.1:{server.port}"):
        live.FoxgloveServer(server.port)
    with socket.socket() as other:
        other.settimeout(2.0)
        assert other.connect_ex(("127.0.0.2", server.port)) != 0


def stream_of(server, session, *, enough, name=""):
    """What a viewer that takes everything gets until it is `enough`: topics announced, and (topic, data) as it came."""
    client = pytest.importorskip("websockets.sync.client")
    topics, got = {}, []
    session.recorder = server.recorder(name)
    session.start()
    with client.connect(server.url, subprotocols=["foxglove.sdk.v1"], close_timeout=0.1) as socket_:
        while not enough(set(topics.values()), [topic for topic, _ in got]):
            message = socket_.recv(timeout=120.0)
            if isinstance(message, bytes):
                kind, number, _ = struct.unpack_from("<BIQ", message)
                if kind == 1:
                    got.append((topics[number - 1000], message[13:]))
                continue
            said = json.loads(message)
            if said["op"] == "advertise":
                new = said["channels"]
                topics.update({c["id"]: c["topic"] for c in new})
                subscriptions = [{"id": c["id"] + 1000, "channelId": c["id"]} for c in new]
                socket_.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
    return topics, got


@pytest.fixture
def session(server):
    link = FakeLink(speed=10.0)
    link.motors, link.wanted = True, (0.2, 0.1, 1.0)
    one = Session(link, vehicle=load_vehicle("cf2"), estimator=FakeEstimator())
    yield one
    one.close()
    one.recorder.close()
    link.close()


def test_a_viewer_gets_what_a_recording_would_have(server, session):
    def enough(topics, came):
        wanted = {"/estimate", "/link", "/log/0", "/log/1", "/pose", "/tf"}
        return wanted <= topics and came.count("/estimate") > 100 and came.count("/log/0") > 100 and "/pose" in came

    _, got = stream_of(server, session, enough=enough)
    estimates = [message_class("crazyem.Estimate").FromString(d) for t, d in got if t == "/estimate"]
    mass = next(p for p in estimates[-1].parameters if p.name == "mass")
    assert mass.value == pytest.approx(0.036)
    pose = message_class("foxglove.PoseInFrame").FromString(next(d for t, d in got if t == "/pose"))
    assert pose.pose.position.x == pytest.approx(0.2)
    # every topic of the shipped layout that such a session has is there
    shown = json.dumps(foxglove_layout())
    assert all(topic in shown for topic in ("/estimate", "/link", "/pose"))


def test_topics_and_frames_of_a_swarm_have_the_drones_name(server, session):
    # what the layout of a swarm shows of a drone is announced under the same names, as far as this session has it
    shown = {m[0] for m in re.findall(r'"((/alpha/[a-z]+(/\d+)?))[."]', json.dumps(swarm_layout(["alpha", "beta"])))}
    assert {"/alpha/pose", "/alpha/estimate", "/alpha/link", "/alpha/log/1"} <= shown
    wanted = (shown | {"/alpha/log/0"}) - {"/alpha/residual", "/alpha/events"}

    _, got = stream_of(server, session, enough=lambda topics, came: wanted <= topics and "/tf" in came, name="alpha")
    frame = message_class("foxglove.FrameTransform").FromString(next(d for t, d in got if t == "/tf"))
    assert (frame.parent_frame_id, frame.child_frame_id) == ("world", "alpha")
