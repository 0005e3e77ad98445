"""Time of a diagnosis against the length of the flight, and against one plain numpy filter pass in the same run.

    python benchmarks/diagnosis_speed.py [--seconds 30,60,120,300,1800] [--recording FILE] [--jobs N] [--json OUT]

The flight is the shipped one, its airborne part repeated with a pause of 0.2 s until it is long enough; so the physics
to be found is the same at every length. Printed: seconds of each diagnosis with all candidates, by the clock and of the
processor (others may share it), the latter per second of flight, the slope of its logarithm over that of the length
(1: linear), and the ratio to the peer, an extended Kalman filter with smoother in
plain numpy (peer_numpy.py) over as many samples.
"""

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: more threads make the peer slower

import numpy as np
import peer_numpy
from speed import settled, window_of

from crazyem.diagnosis.diagnose import diagnose
from crazyem.recordings import open_recording
from crazyem.recordings.airborne import airtime
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.vehicle import load_vehicle

PAUSE = 0.2  # s between repetitions, so that the filter starts a new stretch
PEER_SAMPLES = 800


def repeated(recording: Recording, seconds: float) -> Recording:
    """The flight repeated, with `seconds` in the air."""
    air = airtime(recording)
    assert air is not None
    begin, end = air.flown[0]
    times = max(1, int(np.ceil(seconds / (end - begin))))
    last = begin + seconds - (times - 1) * (end - begin)

    def many(array: SignalArray) -> SignalArray:
        inside = (array.time >= begin) & (array.time <= end)
        parts = [inside & (array.time <= (last if k == times - 1 else end)) for k in range(times)]
        shift = [k * (end - begin + PAUSE) for k in range(times)]
        value = np.concatenate([array.value[p] for p in parts])
        stamps = np.concatenate([array.time[p] + s for p, s in zip(parts, shift, strict=True)])
        marked, host = (np.concatenate([a[p] for p in parts]) for a in (array.marked, array.host_time))
        return replace(array, time=stamps, value=value, marked=marked, host_time=host, order=np.arange(stamps.size))

    return replace(recording, signals={n: many(a) for n, a in recording.signals.items()})


def peer_seconds(samples: int) -> float:
    """Seconds of one pass of filter and smoother in plain numpy, scaled from the best of three over a window."""
    em = settled(seed=1, window=PEER_SAMPLES, seconds=12.0)
    last = em.tape.size
    window = window_of(em, last - PEER_SAMPLES, last)
    run = peer_numpy.make(window)
    run()
    best = min(_timed(run) for _ in range(3))
    return best * samples / PEER_SAMPLES


def _timed(run: Any) -> float:
    begin = time.process_time()
    run()
    return time.process_time() - begin


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", default="30,60,120,300,1800")
    parser.add_argument("--recording", default="logs/payload_excite.mcap")
    parser.add_argument("--vehicle", default="cf2")
    parser.add_argument("--jobs", type=int, help="threads (default: one a core)")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    recording, vehicle = open_recording(arguments.recording), load_vehicle(arguments.vehicle)
    diagnose([repeated(recording, 10.0)], vehicle, jobs=arguments.jobs)  # compiles
    rows = []
    for seconds in map(float, arguments.seconds.split(",")):
        long = repeated(recording, seconds)
        begin, since = time.perf_counter(), time.process_time()
        found = diagnose([long], vehicle, jobs=arguments.jobs)
        taken, busy = time.perf_counter() - begin, time.process_time() - since
        peer = peer_seconds(round(seconds * 100))
        rows.append({"flight_s": seconds, "diagnosis_s": round(taken, 2), "processor_s": round(busy, 2),
                     "per_second": round(busy / seconds, 3), "peer_pass_s": round(peer, 3),
                     "ratio": round(busy / peer, 1),
                     "effects": [e.label for e in found.effects]})  # fmt: skip
        print(rows[-1], flush=True)
    result: dict[str, Any] = {"rows": rows}
    if len(rows) > 1:
        x, y = (np.log([r[k] for r in rows]) for k in ("flight_s", "processor_s"))
        result["exponent"] = round(float(np.polyfit(x, y, 1)[0]), 2)
        print(f"time goes with length to the power of {result['exponent']}")
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
