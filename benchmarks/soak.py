"""One long flight over a bad link, watched for what only time shows: memory, queues, writes, clocks, the recording.

    python -m benchmarks.soak run --minutes 30 --out out/soak      # half an hour; 100 Hz; out/soak/soak.json, soak.mcap
    python -m benchmarks.soak run --minutes 60 --speed 2 --out ... # an hour of flight in half an hour
    python -m benchmarks.soak docs out/soak/soak.json              # its tables into docs/results/soak.md

The simulated firmware, the fault relay and the host (this process) are three processes. The drone flies the excitation
all the time, estimates are pushed under the shipped policy, and once a second a parameter that no flight uses is
written and read back, so that a write that is lost shows. Linux only: memory is read from /proc.
"""

import argparse
import contextlib
import json
import math
import os
import platform
import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.in_process import OPEN_GATE
from crazyem.control.named_trajectories import trajectory_maker
from crazyem.errors import CrazyemError
from crazyem.estimation.online import OnlineEstimator
from crazyem.links import open_link
from crazyem.links.base import ParameterWrite
from crazyem.live.controllers import LEE
from crazyem.live.flight import Flight, FlightPlan
from crazyem.live.history import History, open_recorder
from crazyem.live.policy import WriteRules, load_policy
from crazyem.live.push import Pusher
from crazyem.live.runner import warm_up
from crazyem.live.session import Session
from crazyem.live.simulator import Simulator
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle

PROBE = "hlCommander.vtoff"  # take-off speed of commands without a duration; all our commands have one
ROWS = 400  # of the series, at most
IN_TOUCH = 0.5  # s since the newest packet
SETTLED = 0.4  # share of the flight after which memory should be constant
# A large battery, and a mass that the firmware does not know
SCENARIO = "[vehicle]\nmass = 0.032\n[battery]\ncapacity = 50.0\n"
DOCS = Path(__file__).resolve().parents[1] / "docs" / "results" / "soak.md"
MARKS = ("<!-- soak: table -->", "<!-- /soak -->")


def faults(minutes: float) -> list[dict[str, Any]]:
    """Faults of the link; times in s of the host's clock, rates of all packets unless kinds are named."""
    out: list[dict[str, Any]] = [
        {"what": "drop", "rate": 0.02, "burst": 2.0},
        {"what": "drop", "rate": 0.1, "direction": "down", "kinds": ["param.write"]},
        {"what": "duplicate", "rate": 0.01},
        {"what": "reorder", "rate": 0.01},
        {"what": "delay", "ms": 2.0, "jitter_ms": 6.0},
    ]
    end = 60.0 * minutes
    # Short silences from the drone every half minute; every five minutes a long one (an outage with a reconnection).
    out += [silence(t, 0.3) for t in np.arange(45.0, end, 30.0) if t % 300.0 != 75.0]
    return out + [silence(t, 3.0) for t in np.arange(75.0, end, 300.0)]


def silence(start: float, seconds: float) -> dict[str, Any]:
    """A fault: no packets from the drone for `seconds`."""
    return {"what": "silence", "direction": "down", "from": float(start), "until": float(start + seconds)}


def schedule(wanted: list[dict[str, Any]], seed: int) -> str:
    """The faults as the relay's TOML."""
    lines = [f"seed = {seed}"]
    for fault in wanted:
        lines += ["[[fault]]", *(f"{key} = {json.dumps(value)}" for key, value in fault.items())]
    return "\n".join(lines) + "\n"


class RelayProcess:
    """`python -m firmware_sim.relay` for the length of a `with` block; `account`: its counts at the end."""

    def __init__(self, target: str, file: Path) -> None:
        self._command = [sys.executable, "-m", "firmware_sim.relay", target, "--schedule", str(file), "--json"]
        self.account: dict[str, Any] = {}

    def __enter__(self) -> "RelayProcess":
        self.process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True, start_new_session=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if "udp://" not in line:
            raise RuntimeError("the relay did not start")
        self.uri = line.split()[1]
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        with contextlib.suppress(json.JSONDecodeError, subprocess.TimeoutExpired):
            self.account = json.loads(self.process.communicate(timeout=10.0)[0])
        if self.process.poll() is None:
            self.process.kill()


def resident_mb(pid: int | str) -> float:
    """Memory of a process in MB, NaN once it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Writer:
    """Writes a new value of the probe once a second, by the pusher's own code, and reads it back."""

    controller, stopped = LEE, ""  # the attributes of a guard that the pusher uses

    def __init__(self, session: Session, seed: int) -> None:
        self._session, self._random = session, random.Random(seed)
        self._stop = threading.Event()
        self.counts = {"written": 0, "confirmed": 0, "confirmed_again": 0, "unacknowledged": 0, "lost": 0,
                       "wrong": 0, "unread": 0}  # fmt: skip
        self.slowest = 0.0
        self._pusher = Pusher(session.link, self, gate=OPEN_GATE,  # type: ignore[arg-type]
                              history=History(), on_write=self._attempted,
                              wait_for_link=session.wait_for_link,
                              outages=lambda: len(session.outages) + session.reconnecting)  # fmt: skip
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self, reason: str) -> None:
        """Called by the pusher after a failed write; the soak goes on."""

    def _attempted(self, write: ParameterWrite) -> None:
        self.counts["unacknowledged"] += not write.verified
        if self._session.recorder is not None:
            self._session.recorder.parameter_write(write)

    def close(self) -> None:
        """End the thread after its present write."""
        self._stop.set()
        self._thread.join(60.0)
        self._pusher.close()

    def _run(self) -> None:
        while not self._stop.wait(1.0):
            if self._session.lost is not None:
                return
            self._write(0.25 + self._random.randrange(1024) / 1024.0)  # the same in single precision

    def _write(self, value: float) -> None:
        begun, before = time.monotonic(), self.counts["unacknowledged"]
        self.counts["written"] += 1
        why, _ = self._pusher._write(self._session.clock.newest, PROBE, value)
        if why:
            self.counts["lost"] += 1
            return
        self.counts["confirmed" if self.counts["unacknowledged"] == before else "confirmed_again"] += 1
        self.slowest = max(self.slowest, time.monotonic() - begun)
        self._check(value)

    def _check(self, value: float) -> None:
        try:
            self.counts["wrong"] += self._session.link.read_parameter(PROBE) != value
        except CrazyemError:
            self.counts["unread"] += 1


class Watcher:
    """Samples processes, queues and clocks."""

    NAMES = ("t", "host_mb", "firmware_mb", "relay_mb", "packets_waiting", "samples_waiting", "writes_waiting",
             "recorder_waiting", "received", "lost", "clock_offset", "clock_rate", "round_trip", "outages",
             "firmware_time", "newest_late")  # fmt: skip

    def __init__(self, session: Session, every: float, firmware: int, relay: int) -> None:
        self._session, self._every, self._pids = session, every, (firmware, relay)
        self.rows: list[list[float]] = []
        self._stop = threading.Event()
        self._begun = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            self.rows.append(self._row())
            self._stop.wait(self._every)

    def _row(self) -> list[float]:
        session, s = self._session, self._session.link.statistics()
        pusher, recorder = session.pusher, session.recorder
        waiting = getattr(recorder, "_queue", None)
        newest = session.clock.newest
        late = time.time() - (s.clock_offset + s.clock_rate * newest)
        return [
            time.monotonic() - self._begun,
            resident_mb("self"),
            *(resident_mb(pid) for pid in self._pids),
            session.link.packets.qsize(),
            session._samples.qsize(),
            0 if pusher is None else pusher._pending,
            0 if waiting is None else waiting.qsize(),
            s.received, s.lost, s.clock_offset, s.clock_rate, s.round_trip, s.outages, newest, late,
        ]  # fmt: skip


def run(minutes: float, speed: float, seed: int, folder: Path) -> dict[str, Any]:
    """Fly; the result as it goes to JSON. minutes: of the firmware's clock."""
    folder.mkdir(parents=True, exist_ok=True)
    scenario, plan_file, file = folder / "soak.toml", folder / "faults.toml", folder / "soak.mcap"
    scenario.write_text(SCENARIO, encoding="utf-8")
    wall = minutes / speed
    wanted = faults(wall)
    plan_file.write_text(schedule(wanted, seed), encoding="utf-8")
    vehicle = load_vehicle("cf2")
    warm_up(vehicle)
    with contextlib.ExitStack() as stack:
        simulator = stack.enter_context(Simulator(scenario=scenario, seed=seed, speed=speed))
        assert simulator._process is not None
        relay = stack.enter_context(RelayProcess(simulator.uri, plan_file))
        link = open_link(relay.uri)
        stack.callback(link.close)
        link.connect(60.0)
        recorder = open_recorder(str(file), configuration={"soak": minutes}, vehicle=vehicle, link=link)
        assert recorder is not None
        session = Session(link, vehicle=vehicle, estimator=OnlineEstimator(vehicle), recorder=recorder)
        session.start()
        watcher = Watcher(session, max(1.0, 60.0 * wall / ROWS), simulator._process.pid, relay.process.pid)
        writer = Writer(session, seed)
        plan = FlightPlan(
            trajectory_maker(["excite"], 60.0 * minutes), LEE, push=True, rules=WriteRules(load_policy(None))
        )
        error = ""
        try:
            Flight(session, plan).fly()
        except CrazyemError as e:
            error = str(e)
        writer.close()
        watcher.close()
        session.close()
        statistics = link.statistics()
        recorder.close()
    return {
        "minutes": minutes, "speed": speed, "seed": seed, "error": error, "recorder_failure": recorder.failure,
        "machine": {"cores": os.cpu_count(), "python": platform.python_version(), "load": os.getloadavg()[0]},
        "faults": [f for f in wanted if f["what"] != "silence"],
        "silences": len([f for f in wanted if f["what"] == "silence"]),
        "relay": relay.account,
        "probe": {**writer.counts, "slowest_s": writer.slowest},
        "pushes": {"written": len(session.history.pushes),
                   "unconfirmed": sum(not p.verified for p in session.history.pushes)},
        "mass": session.estimate["mass"].value if session.estimate is not None else math.nan,
        "notices": session.history.notices[-20:],
        "received": statistics.received, "lost": statistics.lost, "late": statistics.late,
        "outages": [(o.before_ms, o.after_ms, o.reason) for o in session.outages],
        "recording": recording_of(file, {b.identifier: statistics.per_block.get(b.identifier) for b in session.blocks}),
        "names": Watcher.NAMES,
        "series": [[round(v, 6) for v in row] for row in watcher.rows],
    }  # fmt: skip


def recording_of(file: Path, blocks: dict[int, Any]) -> dict[str, Any]:
    """The content of the recording, read by our reader with every checksum."""
    from mcap.reader import make_reader

    counts: dict[str, int] = {}
    with file.open("rb") as stream:
        for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    recording = open_recording(file)
    writes = sum(e.kind == "parameter_write" for e in recording.events)
    received = {str(k): v[0] for k, v in blocks.items() if v is not None}
    return {"bytes": file.stat().st_size, "messages": counts, "writes": writes, "received": received}


def summary(result: dict[str, Any]) -> dict[str, Any]:
    """The figures of a run: growth of memory after it has settled, queues, clock."""
    names = list(result["names"])
    rows = np.array(result["series"], dtype=float)
    t = rows[:, 0] / 60.0  # min of the host's clock
    late = t >= SETTLED * t[-1]
    out: dict[str, Any] = {}
    for name in ("host_mb", "firmware_mb", "relay_mb"):
        column = rows[:, names.index(name)]
        ok = late & np.isfinite(column)
        slope = np.polyfit(t[ok], column[ok], 1)[0] if np.sum(ok) > 2 else math.nan
        out[name] = {"first": column[0], "settled": float(column[ok][0]), "last": float(column[ok][-1]),
                     "growth_per_minute": float(slope)}  # fmt: skip
    for name in ("packets_waiting", "samples_waiting", "writes_waiting", "recorder_waiting"):
        column = rows[:, names.index(name)]
        out[name] = {"p99": float(np.percentile(column, 99)), "max": float(column.max()), "end": float(column[-1])}
    rate, newest_late = (rows[late, names.index(n)] for n in ("clock_rate", "newest_late"))
    told = newest_late < IN_TOUCH  # in an outage the newest packet is old for another reason than the clocks
    slope = np.polyfit(t[late][told], 1e3 * newest_late[told], 1)[0] if np.sum(told) > 2 else math.nan
    out["clock"] = {
        "drift_ppm": float(1e6 * (rate[-1] * result["speed"] - 1.0)),
        "late_ms": [float(v) for v in np.percentile(1e3 * newest_late[told], [50, 99])],
        "late_ms_per_minute": float(slope),
    }
    share = result["lost"] / max(result["received"] + result["lost"], 1)
    out["link"] = {"lost_share": share, "outages": len(result["outages"])}
    return out


def table(result: dict[str, Any]) -> str:
    """The run as Markdown."""
    s, probe = summary(result), result["probe"]
    lines = [
        f"{result['minutes']:g} minutes of flight at speed {result['speed']:g}, seed {result['seed']}, "
        f"{result['machine']['cores']} cores with a load of {result['machine']['load']:.1f}, "
        f"Python {result['machine']['python']}; ended {'with: ' + result['error'] if result['error'] else 'landed'}.",
        "", "| memory, MB | at the start | settled | at the end | growth per minute |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for name, label in (("host_mb", "host"), ("firmware_mb", "simulated firmware"), ("relay_mb", "relay")):
        m = s[name]
        lines.append(
            f"| {label} | {m['first']:.1f} | {m['settled']:.1f} | {m['last']:.1f} | {m['growth_per_minute']:+.3f} |"
        )
    lines += ["", "| queue | 99 % of the time at most | longest | at the end |", "|---|---|---|---|"]
    for name, label in (
        ("packets_waiting", "packets for the session"), ("samples_waiting", "samples for the estimator"),
        ("writes_waiting", "sets for the pusher"), ("recorder_waiting", "messages for the recording"),
    ):  # fmt: skip
        q = s[name]
        lines.append(f"| {label} | {q['p99']:g} | {q['max']:g} | {q['end']:g} |")
    kept = result["recording"]
    lines += [
        "", "| | |", "|---|---|",
        f"| writes of the probe | {probe['written']} |",
        f"| confirmed at once, at a later attempt | {probe['confirmed']}, {probe['confirmed_again']} |",
        f"| attempts without an echo | {probe['unacknowledged']} |",
        f"| lost, wrong when read back, not readable | {probe['lost']}, {probe['wrong']}, {probe['unread']} |",
        f"| slowest write until confirmed | {probe['slowest_s']:.2f} s |",
        f"| pushes of the guard, unconfirmed | {result['pushes']['written']}, {result['pushes']['unconfirmed']} |",
        f"| log packets received, lost | {result['received']}, {100 * s['link']['lost_share']:.2f} % |",
        f"| outages, each mended | {s['link']['outages']} |",
        f"| drone's clock against the host's | {s['clock']['drift_ppm']:+.1f} ppm |",
        f"| newest packet late by the clocks' relation: median, 99 % | {s['clock']['late_ms'][0]:.1f} ms, "
        f"{s['clock']['late_ms'][1]:.1f} ms |",
        f"| the same, growth | {s['clock']['late_ms_per_minute']:+.2f} ms per minute |",
        f"| recording | {kept['bytes'] / 1e6:.1f} MB, every checksum right, {kept['writes']} writes in it |",
        f"| estimated mass at the end (true 32 g) | {1e3 * result['mass']:.2f} g |",
    ]  # fmt: skip
    return "\n".join(lines)


def write_docs(result: dict[str, Any]) -> None:
    """Put the tables between the marks of docs/results/soak.md."""
    head, rest = DOCS.read_text(encoding="utf-8").split(MARKS[0])
    tail = rest.split(MARKS[1])[1]
    DOCS.write_text(f"{head}{MARKS[0]}\n\n{table(result)}\n\n{MARKS[1]}{tail}", encoding="utf-8")


def main() -> int:
    """Fly, or write the page of a flight."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    fly = commands.add_parser("run", help="fly and write soak.json")
    fly.add_argument("--minutes", type=float, default=30.0, help="of flight, firmware's clock (default %(default)g)")
    fly.add_argument("--speed", type=float, default=1.0, help="of the simulator (default %(default)g)")
    fly.add_argument("--seed", type=int, default=0)
    fly.add_argument("--out", type=Path, default=Path("out/soak"))
    page = commands.add_parser("docs", help="tables of a soak.json into docs/results/soak.md")
    page.add_argument("file", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "docs":
        write_docs(json.loads(arguments.file.read_text(encoding="utf-8")))
        return 0
    result = run(arguments.minutes, arguments.speed, arguments.seed, arguments.out)
    (arguments.out / "soak.json").write_text(json.dumps(result), encoding="utf-8")
    print(table(result))
    return 1 if result["error"] or result["probe"]["lost"] or result["probe"]["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
