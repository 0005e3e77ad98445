"""Layouts for Foxglove and Lichtblick that show a flight: pose, parameters, residuals, link, motors, voltage.

One for a drone and its recording, one for several drones streamed live: /NAME before their topics (live/foxglove.py).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from crazyem.recordings.mcap.messages import WORLD_FRAME

_INERTIA_SHOWN = 6e-5  # kg m^2, top of the axis: intervals of the first second would flatten all that follows
_COLOURS = ("#4e98e2", "#f5774d", "#6ac27c", "#b678d9")
_MORE_COLOURS = (*_COLOURS, "#e2c84e", "#4ed0d0", "#e27fb4", "#9a9a9a")  # one a drone, then again from the first


def foxglove_layout(topics: Mapping[str, Sequence[str]] | None = None) -> dict[str, Any]:
    """The layout, ready for JSON; import it in the viewer's layout menu.

    Args:
        topics: topic -> field names of a recording, to plot what it has (`topics_of`); None: the topics of a flight
            recorded by `crazyem fly` or `crazyem watch`.
    """
    motors = _found(topics, "motor_command_m{}", "motor_m{}", "/log/1")
    voltage = _found(topics, "voltage", "pm_vbatMV", "/log/1")
    panels: dict[str, Any] = {
        "3D!pose": _scene(),
        "Plot!mass": _plot("mass [kg], 95 % interval", _interval("mass")),
        "Plot!inertia": _plot(
            "inertia [kg m^2], 95 % intervals",
            [path for i, n in enumerate(("Ixx", "Iyy", "Izz")) for path in _interval(n, _COLOURS[i])],
            most=_INERTIA_SHOWN,
        ),
        "Plot!lag": _plot("motor time constant [s], 95 % interval", _interval("motor_time_constant", _COLOURS[3])),
        "Plot!position_residual": _plot("position residual [m]", _residual("position")),
        "Plot!attitude_residual": _plot("attitude residual [rad]", _residual("attitude")),
        "Plot!rate_residual": _plot("body rate residual [rad/s]", _residual("body_rate")),
        "Plot!link": _plot(
            "link: packets a second, late, lost",
            [
                _path("/link.rate", "packets a second", 0),
                _path("/link.lost", "lost", 1),
                _path("/link.late", "late", 2),
            ],
        ),
        "Plot!latency": _plot("link: delay over the promptest packets [s]", [_path("/link.latency", "delay", 0)]),
        "Plot!motors": _plot(
            "motor commands", [_path(motors.format(i), f"m{i}", i - 1) for i in (1, 2, 3, 4)] if motors else []
        ),
        "Plot!voltage": _plot("battery voltage", [_path(voltage, "voltage", 0)] if voltage else []),
        "RawMessages!estimate": {"topicPath": "/estimate", "diffEnabled": False, "expansion": "all"},
        "RosOut!log": {"topicToRender": "/events", "searchTerms": [], "minLogLevel": 1},
    }
    tabs = (
        ("Estimate", _columns(_columns("Plot!mass", "Plot!inertia"), "Plot!lag")),
        ("Residuals", _columns(_columns("Plot!position_residual", "Plot!attitude_residual"), "Plot!rate_residual")),
        ("Link and power", _columns(_columns("Plot!link", "Plot!latency"), _columns("Plot!motors", "Plot!voltage"))),
        ("Messages", "RawMessages!estimate"),
    )
    picture = {"direction": "column", "first": "3D!pose", "second": "RosOut!log", "splitPercentage": 70}
    whole = {"direction": "row", "first": picture, "second": "Tab!right", "splitPercentage": 45}
    return _document({**panels, "Tab!right": _tabs(tabs)}, whole)


def swarm_layout(names: Sequence[str]) -> dict[str, Any]:
    """The layout of several drones that are streamed live: all in one scene and one tab, and a tab for each.

    Tabs do not go into tabs, so a drone's tab shows its panels side by side.

    Args:
        names: of the drones, as in their topics (/NAME/estimate). Raises ValueError: there are none, or one twice.
    """
    if not names or len(set(names)) < len(names):
        raise ValueError("a layout needs drones with a name of their own each")
    colour = {name: _MORE_COLOURS[i % len(_MORE_COLOURS)] for i, name in enumerate(names)}

    def together(title: str, path: str) -> dict[str, Any]:
        return _plot(title, [_path(f"/{n}{path}", n, colour=colour[n]) for n in names])

    scene = _scene()
    scene["transforms"] = {"frame:world": {"visible": True}} | {f"frame:{n}": {"visible": True} for n in names}
    scene["topics"] = {f"/{n}/pose": {"visible": True, "type": "axis", "axisScale": 0.2} for n in names}
    panels: dict[str, Any] = {
        "3D!pose": scene,
        "Plot!mass": together("mass [kg]", '/estimate.parameters[:]{name=="mass"}.value'),
        "Plot!lost": together("link: packets lost", "/link.lost"),
        "Plot!voltage": together("battery voltage", "/log/1.pm_vbatMV"),
    }
    tabs = [("All", _columns(_columns("Plot!mass", "Plot!lost"), "Plot!voltage"))]
    single = foxglove_layout()["configById"]
    for name in names:
        own = {k: f"{k}_{name}" for k in single if k.split("!")[0] not in ("3D", "Tab")}
        panels |= {own[k]: _of_drone(single[k], name) for k in own}
        left = _columns(_columns(own["Plot!mass"], own["Plot!inertia"]), _columns(own["Plot!lag"], own["RosOut!log"]))
        middle = _columns(
            _columns(own["Plot!position_residual"], own["Plot!attitude_residual"]), own["Plot!rate_residual"]
        )
        right = _columns(
            _columns(own["Plot!link"], own["Plot!latency"]), _columns(own["Plot!motors"], own["Plot!voltage"])
        )
        tabs.append((name, _rows(_rows(left, middle), _rows(right, own["RawMessages!estimate"]))))
    whole = {**_rows("3D!pose", "Tab!drones"), "splitPercentage": 30}
    return _document({**panels, "Tab!drones": _tabs(tabs)}, whole)


def _of_drone(panel: dict[str, Any], name: str) -> dict[str, Any]:
    """A panel of the layout for one drone with the name before its topics."""
    moved = dict(panel)
    if "paths" in panel:
        moved["paths"] = [{**p, "value": f"/{name}{p['value']}"} for p in panel["paths"]]
    for key in ("topicPath", "topicToRender"):
        if key in panel:
            moved[key] = f"/{name}{panel[key]}"
    for key in ("title", "foxglovePanelTitle"):
        if key in panel:
            moved[key] = f"{name}: {panel[key]}"
    return moved


def topics_of(announced: Sequence[Any]) -> dict[str, list[str]]:
    """Topic -> field names of the protobuf channels among schemas and channels (records of the mcap library)."""
    from google.protobuf import descriptor_pb2

    schemas = {record.id: record for record in announced if not hasattr(record, "topic")}
    found: dict[str, list[str]] = {}
    for channel in announced:
        schema = schemas.get(getattr(channel, "schema_id", -1)) if hasattr(channel, "topic") else None
        if schema is None or schema.encoding != "protobuf":
            continue
        try:
            files = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
        except Exception:  # protobuf's DecodeError has no public base across its back ends
            continue
        for file in files:
            for message in file.message_type:
                if f"{file.package}.{message.name}" == schema.name:
                    found[channel.topic] = [field.name for field in message.field]
    return found


def _found(topics: Mapping[str, Sequence[str]] | None, signal: str, variable: str, topic: str) -> str:
    """Path of a signal of an imported recording, or of a variable of a log block; "" if the recording has neither."""
    if topics is None:
        return f"{topic}.{variable}"
    for field in (signal, variable):
        for name, fields in topics.items():
            if field.format(1) in fields:
                return f"{name}.{field}"
    return ""


def _interval(name: str, colour: str = _COLOURS[0]) -> list[dict[str, Any]]:
    """The value and both ends of the interval of a parameter."""
    where = f'/estimate.parameters[:]{{name=="{name}"}}'
    return [
        _path(f"{where}.value", name, colour=colour),
        _path(f"{where}.ci95_low", f"{name}, low", colour=colour, width=0.75),
        _path(f"{where}.ci95_high", f"{name}, high", colour=colour, width=0.75),
    ]


def _residual(what: str) -> list[dict[str, Any]]:
    """Three components and the standard deviation expected of the first."""
    paths = [_path(f"/residual.{what}_{axis}", axis, i) for i, axis in enumerate("xyz")]
    return [*paths, _path(f"/residual.{what}_x_sd", "expected sd of x", colour="#888888")]


def _path(value: str, label: str, number: int = 0, *, colour: str = "", width: float = 1.5) -> dict[str, Any]:
    return {
        "value": value,
        "label": label,
        "enabled": True,
        "timestampMethod": "receiveTime",
        "color": colour or _COLOURS[number],
        "lineSize": width,
        "showLine": True,
    }


def _plot(title: str, paths: list[dict[str, Any]], *, most: float | None = None) -> dict[str, Any]:
    limits = {} if most is None else {"minYValue": 0, "maxYValue": most}
    return {
        **limits,
        "foxglovePanelTitle": title,
        "title": title,
        "paths": paths,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "left",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 170,
    }


def _scene() -> dict[str, Any]:
    return {
        "foxglovePanelTitle": "pose",
        "followTf": WORLD_FRAME,
        "followMode": "follow-none",
        "cameraState": {
            "perspective": True,
            "distance": 3,
            "phi": 60,
            "thetaOffset": 45,
            "targetOffset": [0, 0, 0.5],
            "target": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.01,
            "far": 500,
        },
        "scene": {"transforms": {"axisScale": 0.3, "labelSize": 0.05}},
        "transforms": {"frame:world": {"visible": True}, "frame:crazyflie": {"visible": True}},
        "topics": {"/pose": {"visible": True, "type": "axis", "axisScale": 0.2}},
        "layers": {
            "grid": {"layerId": "foxglove.Grid", "visible": True, "frameId": WORLD_FRAME, "size": 10, "divisions": 10}
        },
        "publish": {},
        "imageMode": {},
    }


def _columns(first: Any, second: Any) -> dict[str, Any]:
    """One above the other."""
    return {"direction": "column", "first": first, "second": second}


def _rows(first: Any, second: Any) -> dict[str, Any]:
    """One beside the other."""
    return {"direction": "row", "first": first, "second": second}


def _tabs(tabs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {"activeTabIdx": 0, "tabs": [{"title": title, "layout": layout} for title, layout in tabs]}


def _document(panels: Mapping[str, Any], layout: Mapping[str, Any]) -> dict[str, Any]:
    """What the viewer reads: the panels' settings and how the window is divided among them."""
    return {
        "configById": dict(panels),
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": dict(layout),
    }
