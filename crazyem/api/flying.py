"""Fly a drone, or the simulated firmware, and estimate its mass and inertia in flight."""

import contextlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import urlsplit

from crazyem.api.inputs import VehicleLike, vehicle_of
from crazyem.control.named_trajectories import DEFAULT_HEIGHT, TrajectoryMaker, trajectory_maker
from crazyem.errors import CrazyemError, UsageError
from crazyem.estimation.steps import estimator_for
from crazyem.live.controllers import controller_named
from crazyem.live.flight import Flight, FlightInterruptedError, FlightPlan, Interrupts, MotorsCutError
from crazyem.live.flight_monitor import monitor_for
from crazyem.live.flight_result import FlightResult
from crazyem.live.history import Recorder
from crazyem.live.policy import Policy, WriteRules, load_policy
from crazyem.live.runner import connect, finished, open_session, warm_up
from crazyem.live.session import LOG_RATE, RECONNECT_WITHIN, Session
from crazyem.live.simulator import Simulator
from crazyem.monitoring.fault import Fault
from crazyem.physics import folding
from crazyem.planning.informative import GOAL, SEGMENT, Informative
from crazyem.vehicle import Vehicle

Progress = Callable[[str, float], None]  # phase of the flight, and seconds in it


@dataclass(frozen=True)
class FlightSettings:
    """One flight; the attributes are the arguments of `fly`."""

    uri: str | None
    vehicle: Vehicle
    controller: str = "lee"
    trajectory: tuple[str, ...] | TrajectoryMaker = ("hover",)
    duration: float = 20.0
    goal: float = GOAL
    push: bool = True
    rules: WriteRules = field(default_factory=WriteRules)
    record: str | None = None
    append: bool = False
    scenario: str | None = None
    seed: int | None = None
    speed: float | None = None
    rate: float = LOG_RATE
    reconnect: float = RECONNECT_WITHIN
    window: int = 800
    every: int = 4
    monitor: bool | None = None
    false_alarms_per_hour: float | None = None
    on_fault: Callable[[Fault], None] | None = None

    @property
    def trajectory_name(self) -> str:
        """The trajectory in words."""
        return " ".join(self.trajectory) if isinstance(self.trajectory, tuple) else "a trajectory of the caller's"


class FlightObserver:
    """Callbacks of a flight. These do nothing; the command `fly` shows lines, a live view and a stream."""

    def say(self, sentence: str) -> None:
        """Receives a sentence about the progress before the flight."""

    def recorder(self, recorder: Recorder | None) -> Recorder | None:
        """Returns the recorder for the session; may wrap the given one."""
        return recorder

    def interrupts(self) -> Interrupts:
        """Returns the counter of the user's requests to end the flight; called once, before connecting the drone."""
        return Interrupts()

    def progress(self, session: Session, interrupts: Interrupts) -> AbstractContextManager[Progress]:
        """Returns a context manager around the flight; it yields a function that is called once a second."""
        return contextlib.nullcontext(lambda phase, seconds: None)


def fly(
    uri: str | None = None,
    *,
    vehicle: VehicleLike = "cf2",
    controller: str = "lee",
    trajectory: str | Sequence[str] | TrajectoryMaker = "hover",
    duration: float = 20.0,
    goal: float = GOAL,
    push: bool | None = None,
    dry_run: bool = False,
    policy: Policy | str | Path | None = None,
    record: str | Path | None = None,
    append: bool = False,
    scenario: str | Path | None = None,
    seed: int | None = None,
    speed: float | None = None,
    rate: float = LOG_RATE,
    reconnect: float = RECONNECT_WITHIN,
    window: int = 800,
    every: int = 4,
    monitor: bool | None = None,
    false_alarms_per_hour: float | None = None,
    on_fault: Callable[[Fault], None] | None = None,
) -> FlightResult:
    """Take off, fly a trajectory, land, and estimate mass and inertia during the whole flight.

    An exception in the flight, such as KeyboardInterrupt, lands the drone before the exception goes on.

    Args:
        uri: of the drone; None starts the simulated firmware.
        vehicle: the nominal model: a Vehicle, a preset's name or a file.
        controller: "lee", "mellinger", "indi" or "lqg".
        trajectory: "hover", "figure8", "excite", "informative", ("waypoints", "FILE"), ("plan", "FILE"), or
            a maker of trajectories.
        duration: of a named trajectory, s; of "informative", at most.
        goal: of "informative": relative half width of the 95 % intervals of mass, Ixx, Iyy, Izz at which it ends.
        push: write the estimates to the controller: True, False, or None: to simulators only.
        dry_run: decide which values would be written, but write nothing.
        policy: rules of the guard on writes; None: the shipped policy.
        record, append: MCAP file for the recording; whether to add to an existing file as a new session.
        scenario, seed, speed: of the simulated firmware: file with the true parameters, noise, multiple of real time.
        rate, reconnect: log rate, Hz; time for which a lost link is tried again, s.
        window, every: newest samples that an update uses; samples between updates.
        monitor: whether to look for faults in flight; None: as in the policy.
        false_alarms_per_hour: of the monitor; None: as in the policy.
        on_fault: called in the estimator's thread with every report of the monitor (`Fault`); must return at once.

    Raises:
        UsageError: an argument that does not fit. LinkError: no drone, or the drone was lost.
        DataError: the flight gave no usable data for an estimate. CrazyemError: the flight ended early.
    """
    chosen = (trajectory,) if isinstance(trajectory, str) else trajectory
    settings = FlightSettings(
        vehicle=vehicle_of(vehicle),
        trajectory=chosen if callable(chosen) else tuple(chosen),
        push=push is not False,
        rules=write_rules_for(uri or "", push=push, dry_run=dry_run, policy=policy),
        record=None if record is None else str(record),
        scenario=None if scenario is None else str(scenario),
        uri=uri, controller=controller, duration=duration, goal=goal, append=append, seed=seed, speed=speed, rate=rate,
        reconnect=reconnect, window=window, every=every,
        monitor=monitor, false_alarms_per_hour=false_alarms_per_hour, on_fault=on_fault,
    )  # fmt: skip
    result, error = observed_flight(settings, FlightObserver())
    if error is not None or result is None:
        raise error or CrazyemError("the flight gave no result.")
    return result


def simulated(uri: str) -> bool:
    """Whether a URI is a simulator's: UDP on this host, or an empty URI, which starts one. Others may be drones."""
    if not uri:
        return True
    try:
        parts = urlsplit(uri)
        return parts.scheme == "udp" and parts.hostname == "127.0.0.1"
    except ValueError:
        return False


def write_rules_for(
    uri: str, *, push: bool | None = None, dry_run: bool = False, policy: Policy | str | Path | None = None
) -> WriteRules:
    """Policy and mode of the guard: it writes to simulators by default, to drones only if `push` is true.

    Raises:
        UsageError: no such policy. FileFormatError: the file is no policy.
    """
    meant = push or (push is None and simulated(uri))
    loaded = policy if isinstance(policy, Policy) else load_policy(policy)
    return WriteRules(loaded, dry_run=dry_run or not meant)


def observed_flight(
    settings: FlightSettings, observer: FlightObserver
) -> tuple[FlightResult | None, BaseException | None]:
    """The flight of `fly` with an observer.

    Returns: the result, None if nothing could be estimated; and the error that ended the flight early, or None.

    Raises:
        CrazyemError: nothing has flown.
    """
    if (settings.uri or "").startswith("mavlink:"):
        raise UsageError("a MAVLink drone is flown by its own ground station: use crazyem watch, with --push to write.")
    chosen = (settings.scenario, settings.speed, settings.seed)
    if settings.uri and any(value is not None for value in chosen):
        raise UsageError("--scenario, --seed and --speed belong to the built-in simulator: leave out the URI.")
    nominal, left_out = folding.fold(settings.vehicle)
    settings = replace(settings, vehicle=nominal)
    words = settings.trajectory
    informative = _informative(settings, nominal) if words == ("informative",) else None
    maker = informative or (trajectory_maker(words, settings.duration) if isinstance(words, tuple) else words)
    plan = FlightPlan(
        trajectory=maker,
        controller=controller_named(settings.controller),
        height=DEFAULT_HEIGHT,
        push=settings.push,
        rules=settings.rules,
    )
    estimator_for(nominal, window=settings.window, every=settings.every)  # raises here if the window is invalid
    with contextlib.ExitStack() as stack:
        if informative is not None:
            stack.callback(informative.close)
            observer.say("planning the first manoeuvre")
            informative.start()
        uri, simulator = settings.uri, None
        if not uri:
            simulator = Simulator(scenario=settings.scenario, seed=settings.seed or 0, speed=settings.speed or 1.0)
            stack.callback(simulator.stop)
            simulator.launch()  # simulator and estimator may both have to compile, so they do it in parallel
        if seconds := warm_up(nominal):
            observer.say(f"compiled the estimator in {seconds:.0f} s (once per installation)")
        if simulator is not None:
            uri = simulator.start()
            observer.say(f"simulated firmware at {uri}")
        return _flown(settings, plan, observer, observer.interrupts(), str(uri), left_out)


def _informative(settings: FlightSettings, vehicle: Vehicle) -> Informative:
    """The informative trajectory. Raises UsageError: the flight is too short, or the vehicle has no rotor data."""
    if settings.duration < SEGMENT:
        raise UsageError(f"--trajectory informative needs at least {SEGMENT:g} s.")
    if not vehicle.arm[0] or not vehicle.torque_per_thrust:
        raise UsageError(f"vehicle {vehicle.name} has no rotors in its file, so nothing can be planned for it.")
    return Informative(vehicle, duration=settings.duration, goal=settings.goal, seed=settings.seed or 0)


def _flown(
    settings: FlightSettings,
    plan: FlightPlan,
    observer: FlightObserver,
    interrupts: Interrupts,
    uri: str,
    left_out: list[str],
) -> tuple[FlightResult | None, BaseException | None]:
    error: BaseException | None = None
    with contextlib.ExitStack() as stack:
        link = connect(stack, uri)
        observer.say(f"connected to {uri}: {len(link.log_variables)} log variables, {len(link.parameters)} parameters")
        configuration = {
            "command": "fly",
            "uri": uri,
            "controller": plan.controller.name,
            "trajectory": settings.trajectory_name,
            "duration": settings.duration,
            "rate": settings.rate,
            "window": settings.window,
            "every": settings.every,
            "push": plan.push,
            "guard": settings.rules.mode if plan.push else "no push",
            "seed": settings.seed or 0 if not settings.uri else None,
        }
        session = open_session(
            stack, link, vehicle=settings.vehicle, left_out=left_out, configuration=configuration,
            estimator=estimator_for(settings.vehicle, window=settings.window, every=settings.every),
            record=settings.record, append=settings.append, rate=settings.rate, reconnect=settings.reconnect,
            wrench=plan.controller.wrench, wrap=observer.recorder, on_fault=settings.on_fault,
            monitor=monitor_for(
                settings.vehicle, settings.rules.policy.monitor, enabled=settings.monitor,
                false_alarms_per_hour=settings.false_alarms_per_hour,
            ),
        )  # fmt: skip
        if isinstance(plan.trajectory, Informative):
            plan.trajectory.estimate = lambda: session.estimate
        try:
            session.start()
            with observer.progress(session, interrupts) as progress:
                Flight(session, plan, interrupts=interrupts, progress=progress).fly()
        except (FlightInterruptedError, MotorsCutError) as ended:
            error = ended
            session.history.notice("the flight was ended by the user.")
        except CrazyemError as failed:
            error = failed
            session.history.notice(str(failed))
        session.close()
        title = f"crazyem fly: {settings.trajectory_name}, {plan.controller.name}, vehicle {settings.vehicle.name}"
        extra = {k: configuration[k] for k in ("uri", "controller", "trajectory", "seed")}
        return finished(session, title=title, log=settings.record, extra=extra, error=error)
