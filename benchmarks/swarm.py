"""How many drones one process can estimate for: latency of the updates and processor time per drone, 1 to 50 drones.

    python benchmarks/swarm.py [--drones 1 2 5 10 20 50] [--seconds 10] [--repeat 3] [--json FILE] [--plot FILE.png]
    python benchmarks/swarm.py --source simulator --drones 1 2 5        # through UDP and cflib, watched, not flown

`streams`: synthetic flights (`flight.py`) as log packets in two blocks of 100 Hz a drone, put into the links' queues at
the pace of a clock; all that follows is what `crazyem watch` runs: receiving thread, decoding, estimator, recording
(--record). `simulator`: `python -m firmware_sim --swarm N` in a process of its own on the same cores, and sessions over
cflib; each drone is flown by its high-level commander. Windows are full (800 samples) before anything is measured.

Latency is from the arrival of the packet that makes an update possible to the estimate being handed out. The newest
sample that the update uses is two packets (20 ms) older: more of its instant, and the commands until then, might have
come. Each number of drones is a process of its own.
"""

import argparse
import json
import math
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

BUDGET = 0.040  # s: four samples at 100 Hz
PREFED = 900  # samples before the clock starts
SETTLING = 4.0  # s flown before anything is measured: two updates of a window do not settle the estimates
SLOTS = 5  # moments within 10 ms at which some of the drones' packets arrive


class StreamLink:
    """A link with prepared packets; it has the parts of `crazyem.links.base.Link` that a watch needs."""

    def __init__(self, seed: int, seconds: float) -> None:
        from flight import VOLTAGE, simulate

        from crazyem.live.telemetry import FLYING
        from crazyem.signals.vocabulary import MOTOR_BLOCK, STATE_VARIABLES, compress_quaternion

        self.uri = f"stream://{seed}"
        self.packets: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.log_variables = dict.fromkeys((*STATE_VARIABLES, *MOTOR_BLOCK), "float")
        self.parameters: dict[str, str] = {}
        self.count = 0
        flown = simulate(seed=seed, seconds=seconds)
        self.rows = []
        for y, duty in zip(flown.measured, flown.command, strict=True):
            state = (*(1e3 * y[:6]), float(compress_quaternion(y[6:10])), *(1e3 * y[10:13] * (1.0, -1.0, 1.0)))
            self.rows.append((tuple(map(float, state)), (*map(float, 65535.0 * duty), 1e3 * VOLTAGE, float(FLYING))))

    def subscribe(self, variables: Sequence[str], rate_hz: float) -> Any:
        from crazyem.signals.sample import Block, Variable

        self.count += 1
        block = Block(self.count - 1, tuple(Variable(v, "float") for v in variables), round(1000 / rate_hz))
        return (block,)

    def statistics(self) -> Any:
        from crazyem.links.base import LinkStatistics

        return LinkStatistics()

    def send(self, k: int) -> None:
        """Row `k` arrives now."""
        from crazyem.signals.sample import Packet

        now = time.time()
        for block in (1, 0):  # motors first: a command is in force at its stamp
            self.packets.put(Packet(block, 10 * k + 1000, now, self.rows[k][block]))


class Watched:
    """A session whose latencies are measured."""

    def __init__(self, link: Any, *, number: int, of: int, scheduler: Any, folder: str | None, window: int) -> None:
        from crazyem.estimation.online import OnlineEstimator
        from crazyem.live.history import open_recorder
        from crazyem.live.scheduler import UpdateThrottle
        from crazyem.live.session import Session
        from crazyem.vehicle import load_vehicle

        vehicle = load_vehicle("cf2")
        self.link, self.latencies, self.measuring = link, [], False
        self.arrived: dict[int, float] = {}
        path = None if folder is None else str(Path(folder) / f"{number}.mcap")
        recorder = open_recorder(path, configuration={}, vehicle=vehicle, link=link)
        estimator: Any = OnlineEstimator(vehicle, window=window)
        if scheduler is not None:
            estimator = UpdateThrottle(estimator, number=number, of=of)
        self.session = Session(
            link,
            vehicle=vehicle,
            estimator=estimator,
            recorder=recorder,
            on_estimate=self._estimated,
            scheduler=scheduler,
        )
        self.estimator = estimator
        if isinstance(estimator, UpdateThrottle):
            estimator.newest = lambda: self.session.clock.newest
        take = self.session._packet

        def packet(item: Any) -> None:
            self.arrived.setdefault(item.firmware_time_ms, time.monotonic())
            take(item)

        self.session._packet = packet  # type: ignore[method-assign]

    def _estimated(self, estimate: Any) -> None:
        if self.measuring:
            at = self.arrived.get(round(1000 * estimate.time) + 20)
            if at is not None:
                self.latencies.append(time.monotonic() - at)

    def begin(self) -> None:
        """Start the measurement."""
        self.latencies.clear()
        self.costs = len(self.estimator.update_seconds)
        self.skipped = getattr(self.estimator, "skipped", 0)
        self.measuring = True

    def end(self) -> dict[str, Any]:
        self.measuring = False
        return {
            "latency": self.latencies,
            "cost": list(self.estimator.update_seconds[self.costs :]),
            "skipped": getattr(self.estimator, "skipped", 0) - self.skipped,
            "behind": getattr(self.estimator, "behind", 0.0),
        }


def prefeed(link: StreamLink, watched: Watched) -> None:
    """Fill the window at once, with two updates instead of two hundred."""
    from crazyem.signals.sample import Packet

    inner = getattr(watched.estimator, "inner", watched.estimator)
    every, inner.every = inner.every, PREFED // 2
    decoders = watched.session._decoders
    for k in range(PREFED):
        for block in (1, 0):
            for sample in decoders[block].decode(Packet(block, 10 * k + 1000, 0.0, link.rows[k][block])):
                inner.feed(sample)
    inner.every, inner._since = every, 0  # else all drones would update at once, now and from then on


def run_streams(count: int, *, seconds: float, workers: int | None, record: bool, window: int, cold: bool) -> Any:
    """Measure one number of drones; returns raw numbers."""
    from crazyem.live.runner import warm_up
    from crazyem.live.scheduler import Scheduler
    from crazyem.live.swarm import shorten_switch_interval
    from crazyem.vehicle import load_vehicle

    warm_up(load_vehicle("cf2"))
    shorten_switch_interval()
    scheduler = Scheduler(workers) if workers != 0 else None
    skip = 0 if cold else PREFED
    flown = min(count, 5)  # different flights; making one takes a second
    links = [StreamLink(1 + i % flown, seconds + skip / 100 + SETTLING + 2.0) for i in range(flown)]
    with tempfile.TemporaryDirectory() as scratch:
        watched = []
        for i in range(count):
            link = links[i] if i < flown else _twin(links[i % flown], i)
            one = Watched(
                link, number=i, of=count, scheduler=scheduler, folder=scratch if record else None, window=window
            )
            one.session.start()
            if not cold:
                prefeed(link, one)
            watched.append(one)
        settling = 0 if cold else round(100 * SETTLING)
        since = (0.0, 0.0, 0.0)  # by the clock, of the processor, of it the feeder's
        first = time.monotonic()

        def feed() -> None:
            nonlocal since
            for k in range(settling + round(100 * seconds)):
                if k == settling:
                    since = (time.monotonic(), time.process_time(), time.thread_time())
                    for one in watched:
                        one.begin()
                for slot in range(SLOTS):
                    due = first + 0.01 * k + 0.01 * slot / SLOTS
                    time.sleep(max(due - time.monotonic(), 0.0))
                    for one in watched[slot::SLOTS]:
                        one.link.send(skip + k)
            feeder_seconds.append(time.thread_time() - since[2])

        feeder_seconds: list[float] = []
        feeder = threading.Thread(target=feed)
        feeder.start()
        feeder.join()
        took, spent = time.monotonic() - since[0], time.process_time() - since[1]
        results = [one.end() for one in watched]
        for one in watched:
            one.session.close()
            if one.session.recorder is not None:
                one.session.recorder.close()
            if one.session.failure is not None:
                raise SystemExit(f"a session failed: {one.session.failure}")
    return {"seconds": took, "cpu": spent - feeder_seconds[0], "feeder_cpu": feeder_seconds[0], "drones": results}


def _twin(link: StreamLink, number: int) -> StreamLink:
    twin = object.__new__(StreamLink)
    twin.__dict__.update(link.__dict__, packets=queue.SimpleQueue(), count=0, uri=f"stream://twin/{number}")
    return twin


def run_simulator(count: int, *, seconds: float, workers: int | None, record: bool, window: int) -> Any:
    """The same over UDP and cflib: the swarm simulator runs on the same cores, each drone hovers."""
    from crazyem.links import open_link
    from crazyem.live.runner import warm_up
    from crazyem.live.scheduler import Scheduler
    from crazyem.live.swarm import shorten_switch_interval
    from crazyem.vehicle import load_vehicle

    warm_up(load_vehicle("cf2"))
    port = 24000 + os.getpid() % 4000
    command = [sys.executable, "-m", "firmware_sim", "--swarm", str(count), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulator, tempfile.TemporaryDirectory() as f:
        try:
            for line in simulator.stdout or ():
                if "ready" in line:
                    break
            shorten_switch_interval()
            scheduler = Scheduler(workers) if workers != 0 else None
            watched = []
            for i in range(count):
                link = open_link(f"udp://127.0.0.1:{port + i}")
                link.connect(timeout=60.0)
                one = Watched(
                    link, number=i, of=count, scheduler=scheduler, folder=f if record else None, window=window
                )
                one.session.start()
                watched.append(one)
            for one in watched:
                one.link.take_off(1.0, 2.0)
            time.sleep(3.0 + window / 100.0)
            before = [one.link.statistics() for one in watched]
            begin, spent, simulated = time.monotonic(), time.process_time(), _processor_seconds(simulator.pid)
            for one in watched:
                one.begin()
            time.sleep(seconds)
            took, spent = time.monotonic() - begin, time.process_time() - spent
            simulated = _processor_seconds(simulator.pid) - simulated
            results = [one.end() for one in watched]
            for one, b, result in zip(watched, before, results):
                s = one.link.statistics()
                result["packets"], result["lost"] = s.received - b.received, s.lost - b.lost
            for one in watched:
                one.session.close()
                if one.session.recorder is not None:
                    one.session.recorder.close()
                one.link.close()
        finally:
            simulator.terminate()
    return {"seconds": took, "cpu": spent, "simulator_cpu": simulated, "drones": results}


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def summarised(raw: Any, count: int) -> dict[str, Any]:
    """Percentiles over all drones, and the worst drone's."""
    latency = 1e3 * np.array([v for d in raw["drones"] for v in d["latency"]])
    cost = 1e3 * np.array([v for d in raw["drones"] for v in d["cost"]])
    updates = len(cost)
    skipped = sum(d["skipped"] for d in raw["drones"])
    row = {
        "drones": count,
        "seconds": raw["seconds"],
        "updates_per_s_and_drone": updates / raw["seconds"] / count,
        "skipped_share": skipped / max(1, updates + skipped),
        "latency_ms": _percentiles(latency),
        "latency_ms_p99_worst_drone": max(
            (1e3 * float(np.percentile(d["latency"], 99)) for d in raw["drones"] if d["latency"]), default=math.nan
        ),
        "late_share": float(np.mean(latency > 1e3 * BUDGET)) if latency.size else math.nan,
        "behind_at_end_ms_worst_drone": 1e3 * max(d["behind"] for d in raw["drones"]),
        "cost_ms": _percentiles(cost),
        "cores": raw["cpu"] / raw["seconds"],
        "cores_per_drone": raw["cpu"] / raw["seconds"] / count,
        "load_average_before": raw.get("load"),
    }
    if "simulator_cpu" in raw:
        row["simulator_cores"] = raw["simulator_cpu"] / raw["seconds"]
        row["packets_per_s_and_drone"] = sum(d["packets"] for d in raw["drones"]) / raw["seconds"] / count
        row["lost"] = sum(d["lost"] for d in raw["drones"])
    return row


def _percentiles(values: Any) -> dict[str, float]:
    if not values.size:
        return {"p50": math.nan, "p99": math.nan, "max": math.nan}
    return {
        "p50": float(np.percentile(values, 50)),
        "p99": float(np.percentile(values, 99)),
        "max": float(values.max()),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: medians of the repetitions, for some figures with their range."""
    lines = [
        "| drones | latency p50 ms | p99 ms (min..max of runs) | later than 40 ms | cost p50 ms | p99 ms "
        "| updates a second and drone | left out | cores | of a core per drone |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for count in sorted({r["drones"] for r in rows}):
        some = [r for r in rows if r["drones"] == count]

        def median(*keys: str, of: Sequence[dict[str, Any]] = some) -> float:
            values: list[Any] = list(of)
            for key in keys:
                values = [v[key] for v in values]
            return float(np.median(values))

        p99 = [r["latency_ms"]["p99"] for r in some]
        lines.append(
            f"| {count} | {median('latency_ms', 'p50'):.1f} | {np.median(p99):.1f} ({min(p99):.1f}..{max(p99):.1f}) "
            f"| {100 * median('late_share'):.2g} % | {median('cost_ms', 'p50'):.2f} | {median('cost_ms', 'p99'):.1f} "
            f"| {median('updates_per_s_and_drone'):.1f} | {100 * median('skipped_share'):.2g} % "
            f"| {median('cores'):.2f} | {100 * median('cores_per_drone'):.1f} % |"
        )
    return "\n".join(lines)


def plot(rows: Sequence[dict[str, Any]], path: str, title: str) -> None:
    """The scaling curve: latency, and processor time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
    counts = sorted({r["drones"] for r in rows})
    for key, label in (("p50", "median"), ("p99", "99th percentile")):
        left.plot(counts, [np.median([r["latency_ms"][key] for r in rows if r["drones"] == c]) for c in counts], "o-",
                  label=label)  # fmt: skip
    left.axhline(1e3 * BUDGET, color="grey", lw=1, ls="--", label="budget")
    left.set(xlabel="drones", ylabel="from sample to estimate [ms]", xscale="log", yscale="log")
    right.plot(counts, [np.median([r["cores"] for r in rows if r["drones"] == c]) for c in counts], "o-", label="cores")
    right.plot(counts, [np.median([25 * r["skipped_share"] for r in rows if r["drones"] == c]) for c in counts], "s-",
               label="updates left out, of 25 a second")  # fmt: skip
    right.set(xlabel="drones", xscale="log")
    for axes in (left, right):
        axes.set_xticks(counts, [str(c) for c in counts])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def child(arguments: argparse.Namespace) -> int:
    """Measure one number of drones and print its row as JSON."""
    load = os.getloadavg()[0]
    options = {"workers": arguments.workers, "record": arguments.record, "window": arguments.window}
    if arguments.source == "streams":
        raw = run_streams(arguments.one, seconds=arguments.seconds, cold=arguments.cold, **options)
    else:
        raw = run_simulator(arguments.one, seconds=arguments.seconds, **options)
    print(json.dumps(summarised({**raw, "load": load}, arguments.one)))
    sys.stdout.flush()
    os._exit(0)  # do not wait for threads of links that are slow to end


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; prints a table, optionally writes JSON and the curve."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", choices=("streams", "simulator"), default="streams")
    parser.add_argument("--drones", type=int, nargs="+", default=[1, 2, 5, 10, 20, 50])
    parser.add_argument("--seconds", type=float, default=10.0, help="measured, per number of drones")
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--workers", type=int, help="estimating threads (default: one a core); 0: a thread a drone")
    parser.add_argument("--window", type=int, default=800)
    parser.add_argument("--record", action="store_true", help="a recording a drone, as in flight")
    parser.add_argument("--cold", action="store_true", help="all take off at once, with empty windows")
    parser.add_argument("--json", help="write the numbers to this file")
    parser.add_argument("--plot", help="write the scaling curve to this file")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.one:
        return child(arguments)
    given = list(argv if argv is not None else sys.argv[1:])
    rows = []
    for _ in range(arguments.repeat):
        for count in arguments.drones:
            command = [sys.executable, __file__, *given, "--one", str(count)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
            if done.returncode != 0:
                print(f"{count} drones: failed", file=sys.stderr)
                continue
            rows.append(json.loads(done.stdout.splitlines()[-1]))
            r = rows[-1]
            more = f", simulator {r['simulator_cores']:.2f} cores, {r['lost']} lost" if "lost" in r else ""
            print(
                f"{count:3d} drones: latency p50 {r['latency_ms']['p50']:.1f} p99 {r['latency_ms']['p99']:.1f} ms, "
                f"cost p99 {r['cost_ms']['p99']:.1f} ms, {r['cores']:.2f} cores, "
                f"{r['updates_per_s_and_drone']:.1f} updates/s, left out {100 * r['skipped_share']:.1f} %{more}",
                file=sys.stderr,
                flush=True,
            )
    print(table(rows))
    if arguments.json:
        document = {"source": arguments.source, "cores": os.cpu_count(), "budget_ms": 1e3 * BUDGET, "rows": rows}
        Path(arguments.json).write_text(json.dumps(document, indent=1) + "\n")
    if arguments.plot and rows:
        loads = [r["load_average_before"] for r in rows]
        title = f"{arguments.source}, {os.cpu_count()} cores, 100 Hz, window {arguments.window}; "
        plot(rows, arguments.plot, f"{title}load by others {min(loads):.1f} to {max(loads):.1f}")
    return 0 if len(rows) == arguments.repeat * len(arguments.drones) else 1


if __name__ == "__main__":
    sys.exit(main())
