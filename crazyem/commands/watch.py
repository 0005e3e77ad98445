"""`crazyem watch URI`: estimate with a drone that another program flies; sends no commands.

Only the hover thrust of MAVLink drones can be written, under the guard and with --push or --confirm. Without these
options the guard does a dry run and only reports the values that it would write.
"""

import argparse
import contextlib
import math

from crazyem.commands.flights import (
    Stream,
    Viewed,
    confirm_in_terminal,
    follow,
    interrupts,
    live_stream,
    live_view,
    wants_view,
)
from crazyem.commands.output import LiveLine, compile_kernels, new_estimator, plot_path, report, say
from crazyem.errors import CrazyemError, LinkError, UsageError
from crazyem.links import open_link
from crazyem.links.base import Link
from crazyem.live.flight_monitor import monitor_for
from crazyem.live.policy import Policy, WriteRules, load_policy
from crazyem.live.push import hover_afterwards
from crazyem.live.runner import connect, finished, open_session
from crazyem.live.session import Session
from crazyem.live.summary import check_writable
from crazyem.live.telemetry import FLYING
from crazyem.physics import folding
from crazyem.vehicle import Vehicle


def run(arguments: argparse.Namespace) -> int:
    """Watch until Ctrl-C, --duration or loss of the drone; then print the summary."""
    if arguments.uris or arguments.swarm:
        from crazyem.commands.swarm import watch as watch_many

        return watch_many(arguments)
    if not arguments.uri:
        raise UsageError("watch needs a URI, such as radio://0/80/2M or udp://127.0.0.1:19850 (see crazyem links).")
    view = wants_view(arguments)
    rules = write_rules(arguments)
    policy = rules.policy if rules is not None else load_policy()
    vehicle, left_out = folding.fold(folding.load(arguments.vehicle))
    plot = plot_path(arguments, arguments.record, arguments.json)
    for path in (arguments.json, arguments.record, plot):
        check_writable(path)
    new_estimator(vehicle, arguments)
    compile_kernels(vehicle)
    error: BaseException | None = None
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(interrupts())
        stream = stack.enter_context(live_stream(arguments.foxglove))
        link = connect(stack, arguments.uri)
        say(f"watching {arguments.uri} (Ctrl-C ends)")
        session = _open_session(arguments, stack, link, stream, vehicle, left_out, policy)
        try:
            session.start()
            if rules is not None:
                say(f"guard: {rules.mode}. {session.push_to_controller(rules)}")
                session.pipeline.push_from = -math.inf
            line = LiveLine(session)
            shown = [Viewed(session, line, name=vehicle.name)]
            with live_view(view, lambda: shown) as line.quiet:
                try:
                    follow(session, stop, arguments.duration, line)
                finally:
                    session.stop_pushing()  # before anything else ends
        except CrazyemError as e:
            error = e
            session.history.notice(str(e))
        session.end_pushing(_outcome(session, error))
        session.close()
        if (supervisor := session.write_supervisor) is not None and (pusher := session.pusher) is not None:
            target, before = supervisor.guard.controller, supervisor.originals
            session.history.notice(hover_afterwards(target, now=pusher.known, before=before))
        title, extra = f"crazyem watch {arguments.uri}, vehicle {vehicle.name}", {"uri": arguments.uri}
        result, error = finished(session, title=title, log=arguments.record, extra=extra, error=error)
        try:
            if result is not None:
                report(arguments, result, plot=plot)
        except CrazyemError as e:
            error = error or e
    if error is not None:
        raise error
    return 0


def _open_session(
    arguments: argparse.Namespace, stack: contextlib.ExitStack, link: Link, stream: Stream, vehicle: Vehicle,
    left_out: list[str], policy: Policy,
) -> Session:  # fmt: skip
    """Open the session of a drone that another program flies."""
    names = ("uri", "window", "every", "rate")
    monitor = monitor_for(
        vehicle, policy.monitor, enabled=arguments.monitor, false_alarms_per_hour=arguments.false_alarms_per_hour
    )
    return open_session(
        stack,
        link,
        vehicle=vehicle,
        left_out=left_out,
        configuration={"command": "watch", **{name: getattr(arguments, name) for name in names}},
        estimator=new_estimator(vehicle, arguments, crazyflie=not arguments.uri.startswith("mavlink:")),
        record=arguments.record,
        append=arguments.append,
        rate=arguments.rate,
        reconnect=arguments.reconnect,
        wrap=lambda recorder: stream(recorder, ""),
        monitor=monitor,
    )


def write_rules(arguments: argparse.Namespace) -> WriteRules | None:
    """Policy and mode of the guard; None for a drone that is not MAVLink, or with --no-push.

    Raises: UsageError: a write option for a drone to which only `crazyem fly` writes; no such policy. FileFormatError.
    """
    mavlink = arguments.uri.startswith("mavlink:")
    writes = arguments.push or arguments.confirm
    if not mavlink and (writes or arguments.dry_run or arguments.policy):
        raise UsageError("watch writes to MAVLink drones only: use crazyem fly, or crazyem.attach in a script.")
    if not mavlink or arguments.no_push:
        return None
    open_link(arguments.uri)  # raises here if the address is wrong, before compiling
    confirm = confirm_in_terminal if arguments.confirm else None
    return WriteRules(load_policy(arguments.policy), dry_run=not writes, confirm=confirm)


def _outcome(session: Session, error: BaseException | None) -> str:
    """How the session ended, for the policy: written values are restored only on the ground."""
    if session.lost is not None or isinstance(error, LinkError):
        return "link_lost"
    if error is not None:
        return "failed"
    return "interrupted" if session.telemetry.has(FLYING) else "landed"
