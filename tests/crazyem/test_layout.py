"""The viewer's layout: every path in it is in the messages we write, every panel is placed, once."""

import argparse
import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.cli import main
from crazyem.commands import layout as command
from crazyem.errors import UsageError
from crazyem.recordings.mcap import schemas
from crazyem.recordings.mcap.layout import foxglove_layout, swarm_layout
from crazyem.recordings.mcap.schemas import EVENT_TOPICS
from crazyem.signals.vocabulary import MOTOR_BLOCK, ROTOR_SPEED_BLOCK, block_plan

PATH = re.compile(r"(?P<topic>(?:/\w+)+)\.(?P<fields>.+)")
FILTER = re.compile(r'\[:\]\{(?P<key>\w+)=="(?P<value>\w+)"\}')


def paths(layout):
    return [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", ())]


def placed(node):
    if isinstance(node, str):
        return [node]
    return [name for key in ("first", "second") for name in placed(node[key])]


def descriptor_of(topic):
    schema = dict(EVENT_TOPICS.values())[topic]
    return schemas.message_class(schema).DESCRIPTOR


def resolve(descriptor, fields):
    """Walk a path such as `parameters[:]{name=="mass"}.value` through a message; raises KeyError."""
    for part in re.sub(FILTER, lambda m: f"[{m['key']}]", fields).split("."):
        name, _, key = part.partition("[")
        field = descriptor.fields_by_name[name]
        descriptor = field.message_type
        if key:
            assert key.rstrip("]") in descriptor.fields_by_name
    return field


LAYOUTS = {"a drone": foxglove_layout(), "a swarm": swarm_layout(["alpha", "beta-2"])}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_every_path_is_in_the_messages(layout):
    found = [path.removeprefix("/alpha").removeprefix("/beta-2") for path in paths(layout)]
    assert len(found) > 20
    for path in found:
        match = PATH.fullmatch(path)
        topic, fields = match["topic"], match["fields"]
        if topic.startswith("/log/"):
            continue
        assert resolve(descriptor_of(topic), fields).type in (1, 3, 5), path  # a number


@pytest.mark.parametrize("rotors", [False, True])
def test_log_paths_are_in_the_blocks_of_a_flight(rotors):
    """The motors' block is the second of the plan; each fits one packet, so blocks are numbered as planned."""
    from crazyem.links.packing import pack

    available = [
        f"stateEstimateZ.{n}" for n in ["x", "y", "z", "vx", "vy", "vz", "quat", "rateRoll", "ratePitch", "rateYaw"]
    ]
    available += [*MOTOR_BLOCK, *(ROTOR_SPEED_BLOCK if rotors else ())]
    types = dict.fromkeys(available, "uint16_t") | {"stateEstimateZ.quat": "uint32_t"}
    numbered = []
    for variables in block_plan(available):
        numbered += pack(variables, types, 10, first_identifier=len(numbered))
    names = {f"/log/{b.identifier}": schemas.BlockCodec(b).schema_data() for b in numbered}
    for path in paths(foxglove_layout()):
        if path.startswith("/log/"):
            topic, field = path.split(".")
            assert field.encode() in names[topic]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_panels_are_placed_once_and_no_tab_is_inside_another(layout):
    shown = placed(layout["layout"])
    for panel in layout["configById"].values():
        inside = [name for tab in panel.get("tabs", ()) for name in placed(tab["layout"])]
        assert not [name for name in inside if name.startswith("Tab!")]
        shown += inside
    assert sorted(shown) == sorted(layout["configById"])


def test_a_drone_has_panels_of_every_kind_and_it_is_json():
    layout = json.loads(json.dumps(foxglove_layout(), allow_nan=False))
    assert {name.split("!")[0] for name in layout["configById"]} == {"3D", "Plot", "RawMessages", "RosOut", "Tab"}
    for name in ("mass", "Ixx", "Iyy", "Izz", "motor_time_constant"):
        for field in ("value", "ci95_low", "ci95_high"):
            assert f'/estimate.parameters[:]{{name=="{name}"}}.{field}' in paths(layout)


NAMES = st.lists(st.from_regex(r"[A-Za-z0-9_-]{1,12}", fullmatch=True), min_size=1, max_size=6, unique=True)


@given(NAMES)
def test_every_drone_of_a_swarm_has_every_panel_of_a_single_one(names):
    layout = json.loads(json.dumps(swarm_layout(names), allow_nan=False))
    panels, tabs = layout["configById"], layout["configById"]["Tab!drones"]["tabs"]
    assert [tab["title"] for tab in tabs] == ["All", *names]
    alone = foxglove_layout()["configById"]
    for tab, name in zip(tabs[1:], names, strict=True):
        shown = placed(tab["layout"])
        assert len(shown) == sum(not key.startswith(("3D", "Tab")) for key in alone)
        own = [p["value"] for key in shown for p in panels[key].get("paths", ())]
        assert sorted(own) == sorted(f"/{name}{path}" for path in paths({"configById": alone}))
        others = {panels[key].get(field) for key in shown for field in ("topicPath", "topicToRender")} - {None}
        assert others == {f"/{name}/estimate", f"/{name}/events"}
        assert f"/{name}/pose" in panels["3D!pose"]["topics"]
        assert f"frame:{name}" in panels["3D!pose"]["transforms"]


def test_the_command_takes_names_from_words_or_a_swarm_file(tmp_path, capsys):
    def told(**given):
        words = {"output": None, "json": None, "force": False, "drones": None, "swarm": None, **given}
        assert command.run(argparse.Namespace(**words)) == 0
        return json.loads(capsys.readouterr().out)

    swarm = tmp_path / "swarm.toml"
    swarm.write_text('[[drone]]\nname = "left"\nuri = "udp://127.0.0.1:1"\n[[drone]]\nuri = "udp://127.0.0.1:2"\n')
    assert told(swarm=str(swarm)) == swarm_layout(["left", "drone1"])
    assert told(drones=["a", "b"]) == swarm_layout(["a", "b"])
    assert told() == foxglove_layout()
    out = tmp_path / "layout.json"
    assert main(["layout", "-o", str(out)]) == 0
    assert json.loads(out.read_text()) == foxglove_layout()
    capsys.readouterr()
    for words in ({"drones": ["a", "a"]}, {"drones": ["a/b"]}, {"drones": ["a"], "swarm": str(swarm)}):
        with pytest.raises(UsageError):
            told(**words)
    for names in ([], ["a", "a"]):
        with pytest.raises(ValueError, match="of their own"):
            swarm_layout(names)
