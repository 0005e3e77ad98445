"""`crazyem fly` and `crazyem watch` with several drones: one process; estimator, recording and result for each drone.

A failure of one drone (not reachable, refused, lost) is printed and does not affect the others. If two planned paths
come too close, no drone flies.
"""

import argparse
import concurrent.futures
import contextlib
import functools
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crazyem.commands.flights import (
    Stream,
    SwarmInterrupts,
    Viewed,
    follow,
    interrupts,
    live_stream,
    live_view,
    wants_view,
    write_rules,
)
from crazyem.commands.output import LiveLine, compile_kernels, new_estimator, put, say
from crazyem.control.named_trajectories import DEFAULT_HEIGHT, duration_note, trajectory_maker
from crazyem.errors import CrazyemError, LinkError, UsageError
from crazyem.links.base import Link
from crazyem.live.controllers import controller_named
from crazyem.live.flight import Flight, FlightInterruptedError, FlightPlan, Interrupts, MotorsCutError
from crazyem.live.flight_result import FlightResult
from crazyem.live.runner import connect, finished, open_session
from crazyem.live.scheduler import Scheduler, UpdateThrottle
from crazyem.live.session import Session
from crazyem.live.summary import check_writable, interval_text, write_json
from crazyem.live.swarm import (
    Course,
    Member,
    check_distances,
    members_of,
    read_swarm,
    shorten_switch_interval,
    with_offset,
)
from crazyem.physics import folding

CONNECTIONS_AT_ONCE, CLOSINGS_AT_ONCE = 3, 8  # parallel connections being opened, and closed; more would be slower
POSITION_TIMEOUT = 10.0  # s
RESULT_SUFFIXES = (".csv.gz", ".csv", ".mcap", ".json", ".png")


@dataclass
class Drone:
    """One drone of a running command.

    Attributes:
        stack: closes its session, recording and link.
        error: the error that ended the session early, or None. outcome: in a few words. result: of the flight.
    """

    member: Member
    vehicle: Any
    left_out: list[str]
    log: str | None = None
    plot: str | None = None
    plan: FlightPlan | None = None
    stack: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    session: Session | None = None
    estimator: UpdateThrottle | None = None
    shown: Viewed | None = None
    interrupts: Interrupts = field(default_factory=Interrupts)
    error: BaseException | None = None
    outcome: str = ""
    result: FlightResult | None = None

    @property
    def name(self) -> str:
        return self.member.name

    @property
    def problem(self) -> dict[str, Any]:
        """The error for the summary; empty without one, or if the user ended the flight."""
        if not isinstance(self.error, CrazyemError):
            return {}
        return {"error": str(self.error), "exit_code": self.error.exit_code}

    def failed(self, error: BaseException) -> None:
        """Record an error that ends this drone's part; the first error counts."""
        self.error = self.error or error
        stopped = isinstance(error, FlightInterruptedError | MotorsCutError)
        self.outcome = "landed on request" if isinstance(error, FlightInterruptedError) else "motors cut"
        sentence = "the flight was ended by the user." if stopped else str(error)
        if not stopped:
            self.outcome = sentence
            say(f"{self.name}: {sentence}")
        if self.session is not None:
            self.session.history.notice(sentence)
        if self.shown is not None:
            self.shown.ended = self.outcome


def path_for(base: str | None, name: str) -> str | None:
    """`flights.mcap` -> `flights.NAME.mcap`."""
    if base is None:
        return None
    path = Path(base)
    ending = next((s for s in RESULT_SUFFIXES if path.name.endswith(s) and path.name != s), path.suffix)
    stem = path.name.removesuffix(ending)
    return str(path.with_name(f"{stem}.{name}{ending}"))


def members(arguments: argparse.Namespace, trajectory: Sequence[str] = ("hover",)) -> list[Member]:
    """The drones of the command line or of a swarm file. Raises UsageError, FileFormatError: they cannot be used."""
    uris = [*([arguments.uri] if arguments.uri else []), *arguments.uris]
    if arguments.swarm and uris:
        raise UsageError("give the drones in a swarm file or on the command line, not both.")
    if arguments.swarm:
        return read_swarm(arguments.swarm, vehicle=arguments.vehicle, trajectory=trajectory)
    return members_of(uris, vehicle=arguments.vehicle, trajectory=trajectory)


def fly(arguments: argparse.Namespace) -> int:
    """Fly all drones; returns the exit code, that of the first error."""
    if arguments.scenario or arguments.speed is not None or arguments.seed is not None:
        raise UsageError("--scenario, --seed and --speed belong to one drone in the built-in simulator.")
    drones = _drones(arguments, members(arguments, arguments.trajectory))
    controller = controller_named(arguments.controller)
    for note in {duration_note(list(d.member.trajectory), arguments.duration): None for d in drones}:
        if note:
            say(note)
    for drone in drones:
        m = drone.member
        if m.uri.startswith("mavlink:"):
            raise UsageError(f"{m.name}: a MAVLink drone is flown by its own ground station: use crazyem watch.")
        make = with_offset(trajectory_maker(list(m.trajectory), arguments.duration), m.offset)
        rules = write_rules(arguments, m.uri, name=m.name)
        drone.plan = FlightPlan(make, controller, height=DEFAULT_HEIGHT, push=not arguments.no_push, rules=rules)
    return _run(arguments, drones)


def watch(arguments: argparse.Namespace) -> int:
    """Watch all drones; returns the exit code, that of the first error."""
    if arguments.push or arguments.confirm:
        raise UsageError("several drones at once are watched only: nothing is written to them.")
    return _run(arguments, _drones(arguments, members(arguments)))


def _drones(arguments: argparse.Namespace, chosen: Sequence[Member]) -> list[Drone]:
    """The drones, with all checks that are possible before connecting."""
    drones = []
    for m in chosen:
        vehicle, left_out = folding.fold(folding.load(m.vehicle))
        log, plot = path_for(arguments.record, m.name), path_for(arguments.plot, m.name)
        for path in (log, plot):
            check_writable(path)
        drones.append(Drone(m, vehicle, left_out, log, plot))
    check_writable(arguments.json)
    new_estimator(drones[0].vehicle, arguments)  # raises here if the window is invalid
    return drones


def _run(arguments: argparse.Namespace, drones: list[Drone]) -> int:
    view = wants_view(arguments)
    compile_kernels(drones[0].vehicle)
    shorten_switch_interval()
    with contextlib.ExitStack() as stack:
        everyone = SwarmInterrupts([d.interrupts for d in drones])
        stack.enter_context(interrupts(everyone))
        stream = stack.enter_context(live_stream(arguments.foxglove))
        scheduler = Scheduler()
        stack.callback(scheduler.close)
        try:
            begin = functools.partial(_begin, arguments, of=len(drones), stream=stream, scheduler=scheduler)
            _connect(drones, begin, everyone)
            _check_separation([d for d in drones if d.plan is not None and d.error is None])
            with live_view(view, lambda: [d.shown for d in drones if d.shown is not None]) as showing:
                try:
                    _together(drones, arguments.duration, quiet=showing)
                finally:
                    for session in (d.session for d in drones if d.session is not None):
                        session.stop_pushing()  # for all drones, before anything else ends
        finally:
            with concurrent.futures.ThreadPoolExecutor(CLOSINGS_AT_ONCE, thread_name_prefix="crazyem-close") as pool:
                list(pool.map(_close, drones))
        return _report(arguments, drones)


def _connect(drones: Sequence[Drone], begin: Callable[[Drone, Link, int], None], everyone: Interrupts) -> None:
    """Open links, recordings and sessions; a drone that cannot be reached is left out."""

    def reach(number: int) -> None:
        drone = drones[number]
        if everyone.count:
            drone.failed(FlightInterruptedError())
            return
        try:
            link = connect(drone.stack, drone.member.uri)
            begin(drone, link, number)
            say(f"{drone.name}: connected to {drone.member.uri}")
        except CrazyemError as error:
            drone.failed(error)
        except Exception as error:  # a program error with one drone must not end the others
            drone.failed(CrazyemError(f"connecting failed: {error!r}."))

    with concurrent.futures.ThreadPoolExecutor(CONNECTIONS_AT_ONCE, thread_name_prefix="crazyem-connect") as pool:
        list(pool.map(reach, range(len(drones))))


def _begin(
    arguments: argparse.Namespace, drone: Drone, link: Link, number: int, *, of: int, stream: Stream,
    scheduler: Scheduler,
) -> None:  # fmt: skip
    m, plan = drone.member, drone.plan
    configuration = {
        "command": arguments.command, "uri": m.uri, "drone": m.name, "of": of, "rate": arguments.rate,
        "window": arguments.window, "every": arguments.every,
    }  # fmt: skip
    if plan is not None:
        configuration |= {
            "controller": plan.controller.name, "trajectory": " ".join(m.trajectory), "offset": list(m.offset),
            "duration": arguments.duration, "push": plan.push,
            "guard": plan.rules.mode if plan.push and plan.rules is not None else "no push",
        }  # fmt: skip
    drone.estimator = estimator = UpdateThrottle(
        new_estimator(drone.vehicle, arguments), number=number, of=of, late=arguments.every / arguments.rate
    )
    drone.session = session = open_session(
        drone.stack,
        link,
        vehicle=drone.vehicle,
        left_out=drone.left_out,
        estimator=estimator,
        configuration=configuration,
        record=drone.log,
        append=arguments.append,
        rate=arguments.rate,
        reconnect=arguments.reconnect,
        wrench="" if plan is not None else "ctrlLee",
        wrap=lambda recorder: stream(recorder, m.name),
        scheduler=scheduler,
    )
    estimator.newest = lambda: session.clock.newest
    land = drone.interrupts.land if plan is not None else None
    drone.shown = Viewed(session, LiveLine(session, prefix=f"{m.name:<8} "), name=m.name, land=land)
    session.start()


def _check_separation(drones: Sequence[Drone]) -> None:
    """Wait for positions, then check the distances of all paths. Raises UsageError: two would come too close."""
    until = time.monotonic() + POSITION_TIMEOUT
    courses = {}
    for drone in drones:
        assert drone.session is not None
        assert drone.plan is not None
        telemetry = drone.session.telemetry
        while telemetry.position is None and time.monotonic() < until:
            time.sleep(0.02)
        if telemetry.position is None:
            drone.failed(LinkError("the drone sends no position."))
            continue
        x, y, z = telemetry.position
        dx, dy, dz = drone.member.offset
        start = (x, y, z + drone.plan.height)
        path = drone.plan.trajectory(start, telemetry.yaw)
        courses[drone.name] = Course((x, y, z), (x + dx, y + dy, start[2] + dz), path)
    check_distances(courses)


def _together(drones: Sequence[Drone], duration: float | None, *, quiet: Callable[[], bool]) -> None:
    """Fly each drone in a separate thread, or watch it for `duration` [s]; returns when all have ended."""

    def one(drone: Drone) -> None:
        assert drone.session is not None
        assert drone.shown is not None
        drone.shown.line.quiet = quiet
        try:
            if drone.plan is not None:
                Flight(drone.session, drone.plan, interrupts=drone.interrupts, progress=drone.shown.line).fly()
            else:
                follow(drone.session, drone.interrupts, duration, drone.shown.line)
            drone.outcome = drone.shown.ended = "landed" if drone.plan is not None else "watched"
        except (CrazyemError, FlightInterruptedError, MotorsCutError) as error:
            drone.failed(error)
        except Exception as error:
            drone.failed(CrazyemError(f"flying failed: {error!r}."))

    threads = [
        threading.Thread(target=one, args=(d,), name=f"crazyem-drone-{d.name}") for d in drones if d.error is None
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        while thread.is_alive():
            thread.join(timeout=0.1)  # short timeout, so that Ctrl-C is handled


def _close(drone: Drone) -> None:
    """Close session, recording and link, and make the result; an error stays with this drone."""
    try:
        with drone.stack:
            if drone.session is None or drone.estimator is None:
                return
            drone.session.close()
            skipped = drone.estimator.skipped
            if drone.session.recorder is not None:
                drone.session.recorder.metadata("estimator", {"updates_left_out": str(skipped)})
            if skipped:
                drone.session.history.notice(
                    f"{skipped} updates were left out because this computer could not keep up; every sample was used."
                )
            extra = {
                "plot": drone.plot, "updates_left_out": skipped,
                "trajectory": " ".join(drone.member.trajectory) if drone.plan is not None else None,
                "offset": list(drone.member.offset) if drone.plan is not None else None,
            }  # fmt: skip
            title = f"{drone.name}, vehicle {drone.vehicle.name}"
            drone.result, error = finished(drone.session, title=title, log=drone.log, extra=extra, error=drone.error)
            if error is not drone.error and error is not None:
                drone.failed(error)
    except CrazyemError as error:
        drone.failed(error)


def _row(drone: Drone) -> dict[str, Any]:
    """The summary of one drone's flight, if there was one; draws its plot."""
    try:
        if drone.result is not None:
            if drone.plot is not None:
                drone.result.plot(drone.plot)
            return dict(drone.result.summary)
    except CrazyemError as error:
        if drone.error is None:
            drone.failed(error)
    notices = list(drone.session.history.notices) if drone.session is not None else []
    return {"log": drone.log, "vehicle": drone.vehicle.name, "notices": notices}


def _report(arguments: argparse.Namespace, drones: Sequence[Drone]) -> int:
    results = [_row(drone) for drone in drones]
    problems = [d.problem for d in drones if d.problem]
    stopped = any(d.error is not None for d in drones)
    code = problems[0]["exit_code"] if problems else 130 if stopped else 0
    rows = [
        {"name": d.name, "uri": d.member.uri, "outcome": d.outcome, **row, **d.problem}
        for d, row in zip(drones, results)
    ]
    text = table(rows)
    if arguments.json == "-":
        say(text)
    else:
        put(text)
    if arguments.json:
        write_json({"command": arguments.command, "drones": rows}, arguments.json)
    return code


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A line per drone for people; a parameter that is not identifiable has a question mark."""
    head = (
        f"{'drone':<12} {'mass g':>15} {'Ixx':>13} {'Iyy':>13} {'Izz e-6 kg m2':>15} {'writes':>6} {'lost':>5}  outcome"
    )
    lines = [head]
    for row in rows:
        values = []
        for name, width, scale in (("mass", 15, 1e3), ("Ixx", 13, 1e6), ("Iyy", 13, 1e6), ("Izz", 15, 1e6)):
            p = row.get("estimates", {}).get(name)
            text = "-" if p is None else interval_text(p["value"], p["ci95"], p["identifiable"], scale=scale)
            values.append(f"{text:>{width}}")
        lost = row.get("samples", {}).get("lost", "-")
        lines.append(
            f"{row['name']:<12.12} {' '.join(values)} {len(row.get('pushes', ())):>6} {lost:>5}  {row['outcome']}"
        )
    lines += [f"{row['name']}: note: {n}" for row in rows for n in row.get("notices", ()) if n != row.get("error")]
    return "\n".join(lines)
