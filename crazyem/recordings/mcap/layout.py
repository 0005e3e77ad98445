"""Layouts for Foxglove and Lichtblick that show a flight: pose, parameters, residuals, link, motors, voltage.

The layout for one drone and its recording, in the exchange format of the viewers. The layout for several live drones is
made of the same panels, with /NAME before their topics (live/foxglove.py).
"""

from collections.abc import Sequence
from typing import Any

_COLOURS = ("#4e98e2", "#f5774d", "#6ac27c", "#b678d9", "#e2c84e", "#4ed0d0", "#e27fb4", "#9a9a9a")  # one per drone
_GREY = "#888888"
_SCENE: dict[str, Any] = {
    "foxglovePanelTitle": "pose",
    "followTf": "world",
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
    "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "frameId": "world", "size": 10, "divisions": 10}},
    "publish": {},
    "imageMode": {},
}


def foxglove_layout() -> dict[str, Any]:
    """The layout of a flight recorded by `crazyem fly` or `crazyem watch`, ready for JSON."""
    panels = {"3D!pose": dict(_SCENE), **_panels()}
    estimate = _columns(_columns("Plot!mass", "Plot!inertia"), "Plot!lag")
    residuals = _columns(_columns("Plot!position_residual", "Plot!attitude_residual"), "Plot!rate_residual")
    link = _columns(_columns("Plot!link", "Plot!latency"), _columns("Plot!motors", "Plot!voltage"))
    tabs = {"Estimate": estimate, "Residuals": residuals, "Link and power": link, "Messages": "RawMessages!estimate"}
    panels["Tab!right"] = {"activeTabIdx": 0, "tabs": [_tab(title, layout) for title, layout in tabs.items()]}
    left = {**_columns("3D!pose", "RosOut!log"), "splitPercentage": 70}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {**_rows(left, "Tab!right"), "splitPercentage": 45},
    }


def _panels(topics: str = "", head: str = "") -> dict[str, Any]:
    """All panels but the scene, by identifier; `topics` begins their topics, `head` the titles of their plots."""

    def plot(title: str, paths: list[dict[str, Any]], **more: float) -> dict[str, Any]:
        moved = [{**path, "value": topics + path["value"]} for path in paths]
        return {**more, "foxglovePanelTitle": head + title, "title": head + title, "paths": moved, **_PLOT}

    def residual(title: str, name: str) -> dict[str, Any]:
        """The plot of a residual and its expected standard deviation."""
        lines = _paths({f"/residual.{name}_{axis}": axis for axis in "xyz"})
        return plot(title, [*lines, _path(f"/residual.{name}_x_sd", "expected sd of x", _GREY)])

    inertia = [path for name, colour in zip(("Ixx", "Iyy", "Izz"), _COLOURS) for path in _estimate(name, colour)]
    link = {"/link.rate": "packets a second", "/link.lost": "lost", "/link.late": "late"}
    return {
        "Plot!mass": plot("mass [kg], 95 % interval", _estimate("mass", _COLOURS[0])),
        "Plot!inertia": plot("inertia [kg m^2], 95 % intervals", inertia, minYValue=0, maxYValue=6e-05),
        "Plot!lag": plot("motor time constant [s], 95 % interval", _estimate("motor_time_constant", _COLOURS[3])),
        "Plot!position_residual": residual("position residual [m]", "position"),
        "Plot!attitude_residual": residual("attitude residual [rad]", "attitude"),
        "Plot!rate_residual": residual("body rate residual [rad/s]", "body_rate"),
        "Plot!link": plot("link: packets a second, late, lost", _paths(link)),
        "Plot!latency": plot("link: delay over the promptest packets [s]", _paths({"/link.latency": "delay"})),
        "Plot!motors": plot("motor commands", _paths({f"/log/1.motor_m{n}": f"m{n}" for n in range(1, 5)})),
        "Plot!voltage": plot("battery voltage", _paths({"/log/1.pm_vbatMV": "voltage"})),
        "RawMessages!estimate": {"topicPath": f"{topics}/estimate", "diffEnabled": False, "expansion": "all"},
        "RosOut!log": {"topicToRender": f"{topics}/events", "searchTerms": [], "minLogLevel": 1},
    }


def _path(value: str, label: str, colour: str, width: float = 1.5) -> dict[str, Any]:
    """A line of a plot."""
    return {
        "value": value,
        "label": label,
        "enabled": True,
        "timestampMethod": "receiveTime",
        "color": colour,
        "lineSize": width,
        "showLine": True,
    }


def _paths(labels: dict[str, str]) -> list[dict[str, Any]]:
    """Lines of values with these labels, in different colours."""
    return [_path(value, label, colour) for (value, label), colour in zip(labels.items(), _COLOURS, strict=False)]


def _estimate(name: str, colour: str) -> list[dict[str, Any]]:
    """The estimate of a parameter and its 95 % interval."""
    value = f'/estimate.parameters[:]{{name=="{name}"}}'
    ends = [_path(f"{value}.ci95_{end}", f"{name}, {end}", colour, 0.75) for end in ("low", "high")]
    return [_path(f"{value}.value", name, colour), *ends]


_PLOT = {
    "showXAxisLabels": True,
    "showYAxisLabels": True,
    "showLegend": True,
    "legendDisplay": "left",
    "showPlotValuesInLegend": False,
    "isSynced": True,
    "xAxisVal": "timestamp",
    "sidebarDimension": 170,
}


def swarm_layout(names: Sequence[str]) -> dict[str, Any]:
    """The layout of several live drones: one scene and one tab for all, and a tab for each drone.

    Tabs cannot contain tabs, so the tab of a drone shows all its panels side by side.

    Args:
        names: of the drones, as in their topics (/NAME/estimate).

    Raises: ValueError if there are no names or a name occurs twice.
    """
    if not names or len(set(names)) < len(names):
        raise ValueError("a layout needs drones with a name of their own each")
    layout = foxglove_layout()
    single = layout["configById"]
    scene = single["3D!pose"]
    scene["transforms"] = {"frame:world": {"visible": True}} | {f"frame:{n}": {"visible": True} for n in names}
    scene["topics"] = {f"/{n}/pose": scene["topics"]["/pose"] for n in names}
    panels: dict[str, Any] = {
        "3D!pose": scene,
        "Plot!mass": _together(single["Plot!mass"], "mass [kg]", names),
        "Plot!lost": _together(single["Plot!link"], "link: packets lost", names, path="/link.lost"),
        "Plot!voltage": _together(single["Plot!voltage"], "battery voltage", names),
    }
    tabs = [_tab("All", _columns(_columns("Plot!mass", "Plot!lost"), "Plot!voltage"))]
    for name in names:
        own = {k: f"{k}_{name}" for k in single if k.split("!")[0] not in ("3D", "Tab")}
        panels |= {own[k]: panel for k, panel in _panels(f"/{name}", f"{name}: ").items()}
        tabs.append(_tab(name, _side_by_side(own)))
    panels["Tab!drones"] = {"activeTabIdx": 0, "tabs": tabs}
    return {**layout, "configById": panels, "layout": {**_rows("3D!pose", "Tab!drones"), "splitPercentage": 30}}


def _together(panel: dict[str, Any], title: str, names: Sequence[str], *, path: str = "") -> dict[str, Any]:
    """A plot for all drones from the plot for one: one path (by default the first) and one colour per drone."""
    first = panel["paths"][0]
    paths = [
        {**first, "value": f"/{name}{path or first['value']}", "label": name, "color": _COLOURS[i % len(_COLOURS)]}
        for i, name in enumerate(names)
    ]
    return {**panel, "foxglovePanelTitle": title, "title": title, "paths": paths}


def _side_by_side(own: dict[str, str]) -> dict[str, Any]:
    """All panels of a drone in one tab: estimates, residuals, link and power, messages."""
    left = _columns(_columns(own["Plot!mass"], own["Plot!inertia"]), _columns(own["Plot!lag"], own["RosOut!log"]))
    residuals = _columns(own["Plot!position_residual"], own["Plot!attitude_residual"])
    middle = _columns(residuals, own["Plot!rate_residual"])
    link, power = (own["Plot!link"], own["Plot!latency"]), (own["Plot!motors"], own["Plot!voltage"])
    right = _columns(_columns(*link), _columns(*power))
    return _rows(_rows(left, middle), _rows(right, own["RawMessages!estimate"]))


def _tab(title: str, layout: Any) -> dict[str, Any]:
    return {"title": title, "layout": layout}


def _columns(first: Any, second: Any) -> dict[str, Any]:
    """One above the other."""
    return {"direction": "column", "first": first, "second": second}


def _rows(first: Any, second: Any) -> dict[str, Any]:
    """One beside the other."""
    return {"direction": "row", "first": first, "second": second}
