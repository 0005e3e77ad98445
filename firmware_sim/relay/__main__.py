"""Command line of the fault relay: `python -m firmware_sim.relay udp://127.0.0.1:19850 --drop 0.05`."""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from firmware_sim.errors import FirmwareSimError
from firmware_sim.relay.faults import DOWN, FATES, UP, Engine, Fault
from firmware_sim.relay.kinds import KIND_NAMES, RelayError
from firmware_sim.relay.relay import Relay, parse_target
from firmware_sim.relay.schedule import load_schedule
from firmware_sim.start import stop_on_signals

_EPILOG = f"""\
kinds: {", ".join(sorted(set(KIND_NAMES.values())))}; "log" is all of log.*
a schedule is a TOML file:
  seed = 1
  [[fault]]                  # what: drop duplicate reorder delay corrupt silence die
  what = "drop"
  rate = 0.2                 # share; burst = mean number lost in a row
  direction = "down"         # up: host to drone, down: drone to host, both
  kinds = ["log.data"]
  from = 5.0                 # s since the host's first packet
  until = 8.0
  skip = 0                   # packets that pass first
  count = 0                  # packets harmed at most, 0 = no limit
"""


def _window(text: str) -> tuple[float, float]:
    """ "2-5" in s; "2-" for ever."""
    start, dash, end = text.partition("-")
    try:
        return float(start), float(end) if end else float("inf")
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'"{text}" is no stretch of time such as 2-5{"" if dash else " or 2-"}'
        ) from None


def _one_way(text: str) -> tuple[str, float, float]:
    """ "down:2-5"."""
    direction, colon, rest = text.partition(":")
    if not colon or direction not in (UP, DOWN, "both"):
        raise argparse.ArgumentTypeError(f'"{text}" is no silence such as down:2-5')
    return direction, *_window(rest)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="python -m firmware_sim.relay",
        description="Stands between a host and a Crazyflie on UDP and harms packets, by rate, kind and schedule.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("target", help="the drone, such as udp://127.0.0.1:19850")
    p.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    p.add_argument("--port", type=int, default=0, help="port to listen on (default: any free one)")
    p.add_argument("--seed", type=int, help="of every random number (default: the schedule's, or 0)")
    p.add_argument("--schedule", type=Path, metavar="FILE.toml", help="faults with times; comes after the options'")
    p.add_argument("--direction", choices=(UP, DOWN, "both"), default="both", help="of the faults by rate")
    p.add_argument("--kinds", default="", metavar="A,B", help="packets that the faults by rate concern (default: all)")
    for name, text in (
        ("drop", "lost"), ("duplicate", "that come twice"), ("reorder", "that the next overtakes"),
        ("corrupt", "with a flipped bit"),
    ):  # fmt: skip
        p.add_argument(f"--{name}", type=float, metavar="SHARE", help=f"share of packets {text}")
    p.add_argument("--burst", type=float, default=1.0, metavar="N", help="of --drop: mean number lost in a row")
    p.add_argument("--delay", type=float, metavar="MS", help="ms that every packet takes longer")
    p.add_argument("--jitter", type=float, default=0.0, metavar="MS", help="and up to that many more, at random")
    p.add_argument("--silence", type=_one_way, action="append", default=[], metavar="WAY:S-S",
                   help="nothing passes that way (up, down, both) between two times, such as down:2-5")  # fmt: skip
    p.add_argument("--die", type=_window, action="append", default=[], metavar="S-S",
                   help="the port is closed between two times: the host is told")  # fmt: skip
    p.add_argument("--duration", type=float, metavar="S", help="end by itself after that long")
    p.add_argument("--json", action="store_true", help="counts at the end as JSON")
    return p


def faults_of(arguments: argparse.Namespace) -> tuple[list[Fault], int]:
    """Faults and seed of a command line. Raises RelayError."""
    kinds = frozenset(k.strip() for k in arguments.kinds.split(",") if k.strip())
    common: dict[str, Any] = {"direction": arguments.direction, "kinds": kinds}
    faults = []
    for what in ("drop", "duplicate", "reorder", "corrupt"):
        share = getattr(arguments, what)
        if share is not None:
            burst = {"burst": arguments.burst} if what == "drop" else {}
            faults.append(Fault(what, rate=share, **common, **burst))
    if arguments.delay is not None or arguments.jitter:
        faults.append(Fault("delay", ms=arguments.delay or 0.0, jitter_ms=arguments.jitter, **common))
    faults += [Fault("silence", direction=way, start=start, end=end) for way, start, end in arguments.silence]
    faults += [Fault("die", start=start, end=end) for start, end in arguments.die]
    seed = None
    if arguments.schedule is not None:
        more, seed = load_schedule(arguments.schedule)
        faults += more
    if arguments.seed is not None and arguments.seed < 0:
        raise RelayError("--seed must not be negative")
    return faults, arguments.seed if arguments.seed is not None else seed or 0


def account(engine: Engine) -> dict[str, Any]:
    """Counts of a run, for JSON."""
    return {
        "seed": engine.seed,
        **{way: {fate: engine.counts.fates[way][fate] for fate in FATES} for way in (UP, DOWN)},
        "harmed": {way: dict(sorted(engine.counts.harmed[way].items())) for way in (UP, DOWN)},
        "faults": [
            {"what": f.what, "direction": f.direction, "kinds": sorted(f.kinds), "harmed": n} for f, n in engine.strikes
        ],
    }


def _text(engine: Engine) -> str:
    lines = []
    for way, label in ((UP, "host to drone"), (DOWN, "drone to host")):
        fates = engine.counts.fates[way]
        lines.append(f"{label}: " + (", ".join(f"{fates[f]} {f}" for f in FATES if fates[f]) or "nothing"))
        for kind, number in sorted(engine.counts.harmed[way].items()):
            lines.append(f"  {kind}: {number} harmed")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Relay until SIGINT or SIGTERM. Returns 0 then, 2 after an error of the user (one sentence)."""
    arguments = parser().parse_args(argv)
    try:
        faults, seed = faults_of(arguments)
        if not 0 <= arguments.port <= 65535:
            raise RelayError(f"{arguments.port} is no UDP port")
        engine = Engine(faults, seed)
        relay = Relay(parse_target(arguments.target), engine, host=arguments.host, port=arguments.port)
    except FirmwareSimError as error:
        print(f"relay: {error}", file=sys.stderr)
        return 2
    stop_on_signals(relay)
    print(f"relay: {relay.uri} -> udp://{relay.target[0]}:{relay.target[1]} seed {seed}", flush=True)
    end = float("inf") if arguments.duration is None else time.monotonic() + arguments.duration
    try:
        relay.run(lambda: time.monotonic() >= end)
    except FirmwareSimError as error:  # another program took the port while it was closed
        print(f"relay: {error}", file=sys.stderr)
        return 2
    print(json.dumps(account(engine), indent=2) if arguments.json else _text(engine), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
