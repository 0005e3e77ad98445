"""Run the estimator of the live loop on a recording, sample by sample in the recorded order."""

from collections.abc import Callable

from crazyem.api.inputs import RecordingLike, VehicleLike, recording_of, vehicle_of
from crazyem.doctor import examine
from crazyem.errors import DataError
from crazyem.estimation.steps import StepAwareEstimator, estimator_for
from crazyem.live.flight_monitor import monitor_for
from crazyem.live.flight_result import FlightResult, result_of
from crazyem.live.history import History, Push
from crazyem.live.pipeline import Pipeline
from crazyem.live.policy import FaultRules
from crazyem.physics import folding
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording, crazyflie_attitude, onboard_attitude
from crazyem.recordings.thrust import kind_objection, signal_for, weight_objection
from crazyem.signals.sample import ESTIMATOR_SIGNALS
from crazyem.vehicle import Vehicle

WINDOW, EVERY = 800, 4  # samples in the window, and between updates: defaults without values of user or recording
Progress = Callable[[float, History], None]  # seconds since the first sample, and the history up to then


def replay(
    recording: RecordingLike,
    vehicle: VehicleLike | None = None,
    *,
    window: int | None = None,
    every: int | None = None,
    options: ReadOptions | None = None,
    progress: Progress | None = None,
    monitor: bool = False,
    false_alarms_per_hour: float | None = None,
) -> FlightResult:
    """Estimate mass and inertia from a recording, as the live loop would have done.

    Args:
        recording: a recording, or the path of one of any known format.
        vehicle: the nominal model: a Vehicle, a preset's name or a file; None: the one that was flown.
        window: newest samples that an update uses; None: as in the flight, else 800.
        every: samples between updates; None: as in the flight, else 4.
        options: how a path is read.
        progress: called after every sample.
        monitor: whether to look for faults as in flight; `history.faults` has them.
        false_alarms_per_hour: of the monitor; None: as in the shipped policy.

    Raises:
        UsageError: no such file or vehicle. FileFormatError: no recording, or no vehicle.
        DataError: nothing was flown, or a signal that the estimator needs is missing or not a number.
    """
    recording = recording_of(recording, options)
    nominal, left_out = folding.fold(vehicle_of(vehicle, recording))
    thrust_from, required = required_signals(recording, nominal)
    recording.check(required)
    air = airtime(recording)
    check_flown(recording, nominal, air)
    findings = doctors_findings(recording)
    history = History()
    take_events(recording, history)
    estimator = _estimator_of(recording, nominal, thrust_from, **_window_of(recording, window, every))
    watching = monitor_for(nominal, FaultRules(), enabled=monitor, false_alarms_per_hour=false_alarms_per_hour)
    pipeline = Pipeline(estimator, history=history, monitor=watching)
    pipeline.estimate_until = history.marks.get("estimate_end", pipeline.estimate_until)
    _feed(pipeline, recording, progress)
    check_flown(recording, nominal, air, max((e.samples for e in history.estimates), default=0))
    received, lost = packet_counts(recording)
    return result_of(
        pipeline,
        nominal,
        title=f"crazyem replay {recording.path.rsplit('/', 1)[-1]}, vehicle {nominal.name}",
        log=recording.path,
        received=received,
        lost=lost,
        extra={
            "source": recording.source,
            "duration_s": recording.duration,
            "airborne_s": air.seconds,
            "findings": [f.to_dict() for f in findings],
        },
        notices=_notices(recording, findings, folding.notice(left_out), weight_objection(recording, nominal, air)),
    )


def _feed(pipeline: Pipeline, recording: Recording, progress: Progress | None) -> None:
    """Give every sample to the pipeline, in the order of the live loop."""
    first: float | None = None
    for sample in recording.samples():
        first = sample.time if first is None else first
        pipeline.sample(sample)
        if progress is not None:
            progress(sample.time - first, pipeline.history)


def _notices(recording: Recording, findings: list[Finding], left_out: str, weight: str) -> list[str]:
    said = [f"the doctor says ({f.grade}): {f.text}" for f in findings if f not in recording.findings]
    weight = weight[:1].upper() + weight[1:]
    return [SCALE_NOTICE, *filter(None, [left_out, weight]), *recording.notices, *said]


def _estimator_of(
    recording: Recording, nominal: Vehicle, thrust_from: str, *, window: int, every: int
) -> StepAwareEstimator:
    """The estimator for a replay, with the first input signal as in flight, except if that signal is unusable."""
    unfit = [n for n in ("rotor_speed", "motor_command") if n in recording.signals and n != thrust_from]
    return estimator_for(
        nominal, onboard=onboard_attitude(recording), crazyflie=crazyflie_attitude(recording), window=window,
        every=every, input_signal=thrust_from if unfit or thrust_from == "wrench_command" else None,
    )  # fmt: skip


def _window_of(recording: Recording, window: int | None, every: int | None) -> dict[str, int]:
    """Window and samples between updates: the arguments, else the values of the flight, else the defaults."""
    configured = recording.metadata.get("configuration", {})
    return {
        "window": int(configured.get("window", WINDOW)) if window is None else window,
        "every": int(configured.get("every", EVERY)) if every is None else every,
    }


SCALE_NOTICE = (
    "mass and thrust scale are one parameter in this data: the value is as right as the thrust law of the vehicle "
    "file (a thrust law x % too strong reads as a mass x % too high), and the interval does not include that."
)


def required_signals(recording: Recording, vehicle: Vehicle) -> tuple[str, list[str]]:
    """The signal from which thrust is computed, and all signals that the estimator needs from this recording.

    Raises:
        DataError: no signal gives the thrust, or the voltage for it is unknown.
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
    """Raise DataError with the reason if nothing was flown, by the recording or as the estimator used 0 `samples`."""
    if air.known and not air.airborne:
        raise DataError(f"{recording.path}: nothing was flown in this recording: {air.reason}.")
    if samples == 0:
        why = weight_objection(recording, vehicle, air) or "no sample of position and attitude is off the ground"
        raise DataError(f"{recording.path}: {air.seconds:.1f} s in the air, but nothing to estimate from: {why}.")


def doctors_findings(recording: Recording) -> list[Finding]:
    """Findings of the doctor that matter for an estimate: not harmless, on a signal that the estimator uses."""
    used = {*ESTIMATOR_SIGNALS, ""}
    # the weight check is left out: `weight_objection` uses the vehicle of the replay
    found = [f for f in examine(recording) if f.grade is not Grade.HARMLESS and f.check != "weight"]
    return [f for f in found if f.signal in used]


def packet_counts(recording: Recording) -> tuple[int, int]:
    """Log packets received and lost, as counted in flight; for a foreign file, all samples and the marked samples."""
    counted = recording.metadata.get("statistics", {})
    if "received" in counted:
        return int(counted["received"]), int(counted["lost"])
    total = sum(a.time.size for a in recording.signals.values())
    marked = sum(int(a.marked.sum()) for a in recording.signals.values())
    return total, marked


def take_events(recording: Recording, history: History) -> None:
    """Copy phases and pushes of a crazyem flight to the history, so that the summary can compare before and after."""
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
