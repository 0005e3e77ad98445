"""Flies the drawn cases over the link and records them, as `crazyem fly --no-push` does; an interrupted run continues.

Link, session, setpoints, flight and recorder are those of the command. Its estimator, summary and plot are left out,
which halves the time of a flight. A flight with a gap (late setpoints or lost packets on a busy machine) is repeated
at a lower speed.
"""

import contextlib
import csv
import itertools
import math
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.control.named_trajectories import DEFAULT_HEIGHT, trajectory_maker
from crazyem.errors import CrazyemError
from crazyem.estimation.result import Estimate
from crazyem.links import open_link
from crazyem.live.clock import FirmwareClock
from crazyem.live.controllers import controller_named
from crazyem.live.flight import Flight, FlightPlan
from crazyem.live.history import open_recorder
from crazyem.live.session import Session
from crazyem.recordings.registry import open_recording
from crazyem.signals.sample import Packet, Sample
from crazyem.vehicle import load_vehicle

from .draw import DURATION
from .foreign import fly as fly_abroad
from .hangar import Drone, Hangar
from .paths import FLIGHTS, Study, read, write
from .simulate import fly as simulate

SPEED = 10.0  # firmware seconds per second, at most: the simulator waits for a host that is slower
SLOWER = 0.6  # factor of the speed from try to try
TRIES = 4
LONGEST_SILENCE = 0.15  # s between setpoints; the firmware holds the last one, at 0.5 s it levels out
MOST_LOST = 0.002  # share of packets
AHEAD = 0.02  # s beyond the newest packet
LOWEST, STEEPEST = 0.06, math.radians(70)  # m above the start, tilt; beyond these the drone has crashed


class NotAskedEstimator:
    """Replaces the estimator of `crazyem fly` and gives no estimates.

    A session needs no final estimate; only the summary of the command does, which is left out here.
    """

    airborne = False
    update_seconds: Sequence[float] = ()

    def feed(self, sample: Sample) -> Estimate | None:
        return None

    def finish(self) -> Estimate:
        raise RuntimeError("flights of this harness have no estimator, so there is no final estimate to ask for")


class WaitingClock(FirmwareClock):
    """The clock of a simulator that waits, so its speed varies: time of the newest packet plus a small advance."""

    _newest_at = math.nan  # s of host time
    _shown_last = -math.inf

    def observe(self, firmware_time: float, host: float | None = None) -> None:
        host = time.monotonic() if host is None else host
        if not firmware_time <= self.newest:
            self._newest_at = host
        super().observe(firmware_time, host)

    def now(self, host: float | None = None) -> float:
        host = time.monotonic() if host is None else host
        value = self.newest + min(self.rate * max(host - self._newest_at, 0.0), AHEAD)
        self._shown_last = max(self._shown_last, value)
        return self._shown_last


class WatchedRecorder:
    """A recorder that keeps the times of setpoints (firmware time, s) and reports the newest stamp of the log (ms)."""

    def __init__(self, recorder: Any, seen: Any) -> None:
        self._recorder = recorder
        self._seen = seen
        self.sent: list[float] = []

    def packet(self, packet: Packet) -> None:
        self._seen.value = max(self._seen.value, int(packet.firmware_time_ms))
        self._recorder.packet(packet)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recorder, name)

    def setpoint(self, firmware_time: float, reference: Any) -> None:
        self.sent.append(firmware_time)
        self._recorder.setpoint(firmware_time, reference)


def record(uri: str, *, vehicle_name: str, trajectory: list[str], file: Path, seen: Any) -> dict[str, Any]:
    """Record one flight into `file`; returns its quality. Raises CrazyemError when it ended early."""
    vehicle = load_vehicle(vehicle_name)
    plan = FlightPlan(
        trajectory=trajectory_maker(trajectory, DURATION),
        controller=controller_named("lee"),
        height=DEFAULT_HEIGHT,
        push=False,
    )
    with contextlib.ExitStack() as stack:
        link = open_link(uri)
        stack.callback(link.close)
        link.connect()
        configuration = {"command": "fly", "controller": "lee", "trajectory": trajectory[0], "push": False}
        recorder = WatchedRecorder(
            open_recorder(str(file), configuration=configuration, vehicle=vehicle, link=link),  # nothing of the truth
            seen,
        )
        stack.callback(recorder.close)
        session = Session(link, vehicle=vehicle, estimator=NotAskedEstimator(), recorder=recorder, wrench="ctrlLee")
        stack.callback(session.close)
        session.clock = WaitingClock()
        session.start()
        Flight(session, plan).fly()
        session.close()
        statistics = link.statistics()
        return {
            "received": statistics.received,
            "lost": statistics.lost,
            "longest_silence_s": float(np.diff(recorder.sent).max()),
            "setpoint_spacing_ms": [float(1e3 * q) for q in np.quantile(np.diff(recorder.sent), (0.5, 0.99))],
            "marks": dict(session.history.marks),
        }


def looked_at(file: Path, marks: dict[str, float]) -> str:
    """The reason why the flight is invalid, by its recorded path; empty for a valid flight."""
    recording = open_recording(str(file))
    position, attitude = recording.signals["position"], recording.signals["attitude"]
    start, end = marks["trajectory_start"], marks["trajectory_end"]
    inside = (position.time >= start) & (position.time <= end)
    height = np.asarray(position.value)[inside, 2]
    x, y = np.asarray(attitude.value)[:, :2][(attitude.time >= start) & (attitude.time <= end)].T
    tilt = np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))
    if height.min() < LOWEST:
        return f"came down to {height.min():.2f} m"
    if tilt.max() > STEEPEST:
        return f"tilted by {math.degrees(tilt.max()):.0f} degrees"
    return ""


def _words(flight: dict[str, Any], folder: str) -> list[str]:
    """The words after --trajectory."""
    if not flight["waypoints"]:
        return [flight["style"]]
    file = Path(folder) / "waypoints.csv"
    with file.open("w", newline="") as text:
        table = csv.DictWriter(text, list(flight["waypoints"][0]))
        table.writeheader()
        table.writerows(flight["waypoints"])
    return ["waypoints", str(file)]


def fly_one(study: Study, case: dict[str, Any], flight: str, hangar: Hangar, *, speed: float) -> dict[str, Any]:
    """Make one recording of a case, in several tries if needed; returns its entry of the truth file."""
    wanted, target = case["flights"][flight], study.recording(case["case"], flight)
    target.parent.mkdir(parents=True, exist_ok=True)
    reason, reasons = "", []
    for attempt in range(TRIES):
        pace = speed * SLOWER**attempt
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "flight.mcap"
            uri = hangar.start(Drone(study.scenario(case["case"]), wanted["seed"], pace))
            try:
                words = _words(wanted, folder)
                quality = record(uri, vehicle_name=case["platform"], trajectory=words, file=file, seen=hangar.seen)
                reason = looked_at(file, quality["marks"])
            except CrazyemError as error:
                reason, quality = str(error), {}
            finally:
                hangar.stop()
            if reason:
                reasons.append(reason)
                continue
            lost = quality["lost"] / max(quality["received"], 1)
            if quality["longest_silence_s"] > LONGEST_SILENCE or lost > MOST_LOST:
                reason = f"setpoints {quality['longest_silence_s']:.2f} s apart, {100 * lost:.1f} % of packets lost"
                reasons.append(reason)
                continue
            moved = target.with_suffix(".part")
            moved.write_bytes(file.read_bytes())
            os.replace(moved, target)
        return {"flown": True, "speed": round(pace, 2), "tries": attempt + 1, "before": reasons, **quality}
    return {"flown": False, "reason": reason, "tries": TRIES, "before": reasons}


def missing(study: Study) -> list[tuple[str, str]]:
    """Cases and flights still to be flown, in order."""
    found = []
    for name in study.cases():
        done = (read(study.truth(name)) or {}).get("quality", {})
        found += [(name, flight) for flight in FLIGHTS if flight not in done]
    return found


def fly_all(study: Study, *, speed: float = SPEED, minutes: float = math.inf, part: tuple[int, int] = (0, 1)) -> int:
    """Fly what is missing; `part` (k, n) takes every n-th case from the k-th, so that n processes can share a study.

    Returns the number of flights flown. Stops after `minutes`, between flights.
    """
    begun, flown = time.monotonic(), 0
    todo = [m for m in missing(study) if int(m[0]) % part[1] == part[0]]
    with contextlib.ExitStack() as stack:
        hangar: Hangar | None = None
        for (name, flight), left in zip(todo, itertools.count(len(todo) - 1, -1)):
            if time.monotonic() - begun > 60.0 * minutes:
                break
            case, since = read(study.truth(name)), time.monotonic()
            if case.get("world", "home") == "home":
                hangar = hangar or stack.enter_context(Hangar())
                done = fly_one(study, case, flight, hangar, speed=speed)
            else:
                fly_here = simulate if case["world"] == "random" else fly_abroad
                done = {"tries": 1, **fly_here(case, flight, study.folder / "cases" / name, duration=DURATION)}
            write(study.truth(name), {**case, "quality": {**case.get("quality", {}), flight: done}})
            flown += 1
            told = f"speed {done.get('speed', 0):g}" if done["flown"] else f"not flown: {done['reason']}"
            print(
                f"{name} {flight}: {told}, try {done['tries']}, {time.monotonic() - since:.1f} s; {left} left",
                flush=True,
            )
    return flown
