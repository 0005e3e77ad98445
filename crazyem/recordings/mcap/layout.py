"""Layouts for Foxglove and Lichtblick that show a flight: pose, parameters, residuals, link, motors, voltage.

`flight_layout.json` is the layout for one drone and its recording, in the exchange format of the viewers. The layout
for several live drones is made of the same panels, with /NAME before their topics (live/foxglove.py).
"""

import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

_COLOURS = ("#4e98e2", "#f5774d", "#6ac27c", "#b678d9", "#e2c84e", "#4ed0d0", "#e27fb4", "#9a9a9a")  # one per drone


def foxglove_layout() -> dict[str, Any]:
    """The layout of a flight recorded by `crazyem fly` or `crazyem watch`, ready for JSON."""
    text = (resources.files("crazyem.recordings.mcap") / "flight_layout.json").read_text(encoding="utf-8")
    layout = json.loads(text)
    assert isinstance(layout, dict)
    return layout


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
        panels |= {own[k]: _of_drone(single[k], name) for k in own}
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
    return {**panel, **_titles(panel, title), "paths": paths}


def _of_drone(panel: dict[str, Any], name: str) -> dict[str, Any]:
    """A panel of the layout for one drone, with the name of the drone before its topics."""
    moved = dict(panel)
    for key in ("topicPath", "topicToRender"):
        if key in panel:
            moved[key] = f"/{name}{panel[key]}"
    if "paths" in panel:
        moved["paths"] = [{**p, "value": f"/{name}{p['value']}"} for p in panel["paths"]]
    moved.update(_titles(panel, f"{name}: {panel.get('title', '')}"))
    return moved


def _titles(panel: dict[str, Any], title: str) -> dict[str, Any]:
    """The new title under each title key of the panel."""
    return {key: title for key in ("foxglovePanelTitle", "title") if key in panel}


def _side_by_side(own: dict[str, str]) -> dict[str, Any]:
    """All panels of a drone in one tab: estimates, residuals, link and power, messages."""
    left = _columns(_columns(own["Plot!mass"], own["Plot!inertia"]), _columns(own["Plot!lag"], own["RosOut!log"]))
    residuals = _columns(own["Plot!position_residual"], own["Plot!attitude_residual"])
    middle = _columns(residuals, own["Plot!rate_residual"])
    link, power = (own["Plot!link"], own["Plot!latency"]), (own["Plot!motors"], own["Plot!voltage"])
    right = _columns(_columns(*link), _columns(*power))
    return _rows(_rows(left, middle), _rows(right, own["RawMessages!estimate"]))


def _tab(title: str, layout: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "layout": layout}


def _columns(first: Any, second: Any) -> dict[str, Any]:
    """One above the other."""
    return {"direction": "column", "first": first, "second": second}


def _rows(first: Any, second: Any) -> dict[str, Any]:
    """One beside the other."""
    return {"direction": "row", "first": first, "second": second}
