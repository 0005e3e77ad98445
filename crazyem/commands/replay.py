"""`crazyem replay FILE`: the estimator of the live loop over a recording, sample by sample in the recorded order."""

import argparse
import time

from crazyem.commands.common import new_estimator, plot_path, report, say, tell_steps
from crazyem.commands.files import read_options
from crazyem.errors import DataError
from crazyem.live.history import History, Push
from crazyem.live.pipeline import Pipeline
from crazyem.live.summary import check_writable, live_line
from crazyem.physics import folding
from crazyem.recordings import Recording, open_recording
from crazyem.recordings.attitudes import onboard_attitude
from crazyem.vehicle import Vehicle

SCALE_NOTICE = (
    "mass and thrust scale are one parameter in this data: the value is as right as the thrust law of the vehicle "
    "file (a thrust law x % too strong reads as a mass x % too high), and the interval does not include that."
)


def vehicle_of(recording: Recording, given: str | None) -> Vehicle:
    """--vehicle, else the vehicle the recording was flown with, else cf2."""
    if given:
        return folding.load(given)
    stored = recording.metadata.get("vehicle", {}).get("toml")
    return folding.parse(stored, where=f"vehicle in {recording.path}") if stored else folding.load("cf2")


def required_signals(recording: Recording, vehicle: Vehicle) -> list[str]:
    """What the estimator needs of this recording.

    Raises:
        DataError: there is nothing to compute thrust from.
    """
    names = {n for n, a in recording.signals.items() if a.time.size}
    if "motor_command" in names and vehicle.thrust_curve:
        inputs = ["motor_command", "voltage"]
    elif "rotor_speed" in names and vehicle.rotor_constant is not None:
        inputs = []  # NaN means a missing speed there
    elif "wrench_command" in names:
        inputs = ["wrench_command"]
    else:
        raise DataError(
            f"{recording.path}: there are no motor commands, rotor speeds or commanded thrust that the vehicle "
            f"'{vehicle.name}' can turn into forces."
        )
    return ["position", "attitude", *inputs, *(n for n in ("velocity", "body_rate") if n in names)]


def replay(recording: Recording, pipeline: Pipeline, *, progress: bool = True) -> None:
    """Run every sample of a recording through the pipeline."""
    shown = time.monotonic()
    first, told = None, 0
    for sample in recording.samples():
        first = sample.time if first is None else first
        pipeline.sample(sample)
        if progress and time.monotonic() - shown > 1.0:
            shown = time.monotonic()
            newest = pipeline.history.estimates[-1] if pipeline.history.estimates else None
            say(live_line("replay", sample.time - first, newest, lost=0, pushes=0))
            told = tell_steps(pipeline.history, told)


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    plot = plot_path(arguments, arguments.json, arguments.file)
    for path in (arguments.json, plot):
        check_writable(path)
    recording = open_recording(arguments.file, read_options(arguments))
    vehicle, left_out = folding.fold(vehicle_of(recording, arguments.vehicle))
    configured = recording.metadata.get("configuration", {})
    for name, default in (("window", "800"), ("every", "4")):
        if getattr(arguments, name) is None:
            setattr(arguments, name, int(configured.get(name, default)))
    recording.check(required_signals(recording, vehicle))
    history = History()
    take_events(recording, history)
    estimator = new_estimator(vehicle, arguments, onboard=onboard_attitude(recording))
    pipeline = Pipeline(estimator, history=history)
    pipeline.estimate_until = history.marks.get("estimate_end", pipeline.estimate_until)
    replay(recording, pipeline)
    if not any(e.samples for e in history.estimates):
        raise DataError(f"{recording.path}: nothing in this recording was flown (no samples off the ground).")
    received, lost = packet_counts(recording)
    report(
        arguments,
        pipeline=pipeline,
        vehicle=vehicle,
        log=arguments.file,
        plot=plot,
        title=f"crazyem replay {recording.path.rsplit('/', 1)[-1]}, vehicle {vehicle.name}",
        received=received,
        lost=lost,
        extra={"source": recording.source, "duration_s": recording.duration},
        notices=(SCALE_NOTICE, *filter(None, [folding.notice(left_out)]), *recording.notices),
    )
    return 0


def packet_counts(recording: Recording) -> tuple[int, int]:
    """Log packets received and lost, as counted in flight; of a foreign file samples, and those that carry nothing."""
    counted = recording.metadata.get("statistics", {})
    if "received" in counted:
        return int(counted["received"]), int(counted["lost"])
    total = sum(a.time.size for a in recording.signals.values())
    marked = sum(int(a.marked.sum()) for a in recording.signals.values())
    return total, marked


def take_events(recording: Recording, history: History) -> None:
    """Phases and pushes of a flight of ours, so that the summary can tell before from after."""
    for event in recording.events:
        text = str(event.data.get("message", ""))
        if event.kind == "log" and text.startswith("mark "):
            _, name, value = text.split(" ", 2)
            history.marks[name] = float(value)
        elif event.kind == "parameter_write":
            name, written = str(event.data.get("name", "")), event.data.get("value")
            if name.startswith("ctrl") and isinstance(written, int | float):
                when = drone_time(recording, event.time)
                history.pushes.append(Push(when, name, float(written), bool(event.data.get("verified"))))


def drone_time(recording: Recording, host_time: float) -> float:
    """Drone time [s] of the newest position that had arrived at a host time; NaN without any."""
    position = recording.signals.get("position")
    if position is None or not position.time.size:
        return float("nan")
    index = int(position.host_time.searchsorted(host_time, side="right")) - 1
    return float(position.time[max(index, 0)])
