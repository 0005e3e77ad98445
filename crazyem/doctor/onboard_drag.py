"""Check: an onboard estimator with a drag model (kalman.dragB_*), so that its velocity follows this model."""

import math
from collections.abc import Mapping

from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording

_AXES = ("x", "y", "z")


def check(recording: Recording) -> list[Finding]:
    """Finding if a drag is in the parameters read at connect or written later; none for files without parameters."""
    values = _parameters(recording)
    drag = {axis: values.get(f"kalman.dragB_{axis}", 0.0) for axis in _AXES}
    if not any(drag.values()):
        return []
    place = {axis: values.get(f"kalman.cop_{axis}", 0.0) for axis in _AXES}
    text = (
        "The onboard estimate used a drag: "
        + ", ".join(f"kalman.dragB_{axis} {value:g}" for axis, value in drag.items())
        + " 1/s (drag over mass)"
    )
    if any(place.values()):
        text += ", at " + ", ".join(f"kalman.cop_{axis} {value:g}" for axis, value in place.items()) + " m"
    return [
        Finding(
            "onboard_drag",
            Grade.HARMLESS,
            text + ". Its velocity follows that model where the sensors say little.",
            signal="velocity" if "velocity" in recording.signals else "",
            evidence={f"dragB_{axis}_per_s": value for axis, value in drag.items()},
            advice="Take a drag found from the onboard velocity with care: a part of it was put in. A tracking system "
            "tells, or a flight with kalman.dragB_* at 0.",
        )
    ]


def _parameters(recording: Recording) -> dict[str, float]:
    """Drag parameters of the onboard filter by name, as read at connect or last written in the recording."""
    values = _numbers(recording.metadata.get("parameter_values", {}))
    for event in recording.events:
        if event.kind == "parameter_write" and event.data.get("verified") is not False:
            values |= _numbers({str(event.data.get("name")): str(event.data.get("value"))})
    return values


def _numbers(told: Mapping[str, str]) -> dict[str, float]:
    found = {}
    for name, text in told.items():
        if name.startswith(("kalman.dragB_", "kalman.cop_")):
            try:
                value = float(text)
            except ValueError:
                continue
            if math.isfinite(value):
                found[name] = value
    return found
