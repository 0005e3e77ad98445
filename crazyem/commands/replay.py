"""`crazyem replay FILE`: the estimator of the live loop over a recording, sample by sample in the recorded order."""

import argparse
import time

from crazyem.commands.common import new_estimator, plot_path, report, say, say_steps
from crazyem.commands.files import read_options
from crazyem.doctor.thrust import kind_objection, signal_for, vehicle_for, weight_objection
from crazyem.errors import DataError
from crazyem.live.history import History, Push
from crazyem.live.pipeline import Pipeline
from crazyem.live.summary import check_writable, live_line
from crazyem.physics import folding
from crazyem.recordings import Finding, Grade, Recording, open_recording
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.attitudes import onboard_attitude
from crazyem.signals.sample import ESTIMATOR_SIGNALS
from crazyem.vehicle import Vehicle

SCALE_NOTICE = (
    "mass and thrust scale are one parameter in this data: the value is as right as the thrust law of the vehicle "
    "file (a thrust law x % too strong reads as a mass x % too high), and the interval does not include that."
)


def required_signals(recording: Recording, vehicle: Vehicle) -> tuple[str, list[str]]:
    """The signal that thrust is computed from, and all that the estimator needs of this recording.

    Raises:
        DataError: there is nothing to compute thrust from, or its voltage is not known.
    """
    if other := kind_objection(recording):
        raise DataError(f"{recording.path}: {other}.")
    name, why = signal_for(recording, vehicle)
    if not name:
        raise DataError(f"{recording.path}: nothing says what the rotors did: {why}.")
    names = {n for n, a in recording.signals.items() if a.time.size}
    if name == "motor_command" and "voltage" not in names:
        absent = recording.metadata.get("not_measured", {}).get("voltage", "")
        raise DataError(
            f"{recording.path}: the recording has no voltage{f' ({absent})' if absent else ''}, and without one "
            "motor_command is no thrust; crazyem diagnose can take a voltage from the flight."
        )
    inputs = {"motor_command": ["motor_command", "voltage"], "wrench_command": ["wrench_command"]}.get(name, [])
    return name, ["position", "attitude", *inputs, *(n for n in ("velocity", "body_rate") if n in names)]


def check_flown(recording: Recording, vehicle: Vehicle, air: Airtime, samples: int | None = None) -> None:
    """Raise DataError, saying why, if nothing was flown: by the recording, or (`samples` 0) by the estimator's gate."""
    if air.known and not air.airborne:
        raise DataError(f"{recording.path}: nothing was flown in this recording: {air.reason}.")
    if samples == 0:
        why = weight_objection(recording, vehicle, air) or "no sample of position and attitude is off the ground"
        raise DataError(f"{recording.path}: {air.seconds:.1f} s in the air, but nothing to estimate from: {why}.")


def doctors_findings(recording: Recording) -> list[Finding]:
    """What the doctor finds that bears on an estimate: more than harmless, of a signal that the estimator uses."""
    from crazyem.doctor import examine

    used = {*ESTIMATOR_SIGNALS, ""}
    # the weight is judged by the vehicle of the replay
    found = [f for f in examine(recording) if f.grade is not Grade.HARMLESS and f.check != "weight"]
    return [f for f in found if f.signal in used]


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
            told = say_steps(pipeline.history, told)


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    plot = plot_path(arguments, arguments.json, arguments.file)
    for path in (arguments.json, plot):
        check_writable(path)
    recording = open_recording(arguments.file, read_options(arguments))
    vehicle, left_out = folding.fold(vehicle_for(recording, arguments.vehicle))
    configured = recording.metadata.get("configuration", {})
    for name, default in (("window", "800"), ("every", "4")):
        if getattr(arguments, name) is None:
            setattr(arguments, name, int(configured.get(name, default)))
    thrust_from, required = required_signals(recording, vehicle)
    recording.check(required)
    air = airtime(recording)
    check_flown(recording, vehicle, air)
    findings = doctors_findings(recording)
    history = History()
    take_events(recording, history)
    # a live flight takes what comes first, and a replay must do the same; but never what says nothing
    unfit = [n for n in ("rotor_speed", "motor_command") if n in recording.signals and n != thrust_from]
    chosen = thrust_from if unfit or thrust_from == "wrench_command" else None
    estimator = new_estimator(vehicle, arguments, onboard=onboard_attitude(recording), input_signal=chosen)
    pipeline = Pipeline(estimator, history=history)
    pipeline.estimate_until = history.marks.get("estimate_end", pipeline.estimate_until)
    replay(recording, pipeline)
    check_flown(recording, vehicle, air, max((e.samples for e in history.estimates), default=0))
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
        extra={
            "source": recording.source,
            "duration_s": recording.duration,
            "airborne_s": air.seconds,
            "findings": [f.to_dict() for f in findings],
        },
        notices=(
            SCALE_NOTICE,
            *filter(None, [folding.notice(left_out), sentence(weight_objection(recording, vehicle, air))]),
            *recording.notices,
            *(f"the doctor says ({f.grade}): {f.text}" for f in findings if f not in recording.findings),
        ),
    )
    return 0


def sentence(clause: str) -> str:
    """A clause as a sentence; "" stays."""
    return clause[:1].upper() + clause[1:]


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
