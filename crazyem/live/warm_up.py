"""Compilation before a flight: a compilation in flight would stop all Python threads, also setpoints, for seconds."""

import math
import time

from crazyem.compiled import compilations
from crazyem.errors import CrazyemError
from crazyem.estimation.in_step import PERIOD
from crazyem.estimation.online import OnlineEstimator
from crazyem.live.flight_monitor import FlightMonitor
from crazyem.live.policy import FaultRules
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle


def warm_up(vehicle: Vehicle) -> float:
    """Run every kernel once; returns the seconds if any kernel was compiled, 0.0 if all came from the disk."""
    begun, before = time.monotonic(), compilations()
    estimator = OnlineEstimator(vehicle, window=100, every=4, prediction_period=PERIOD)
    FlightMonitor(vehicle, FaultRules()).watch(estimator)
    hover = 0.5
    try:
        for i in range(160):
            t = PERIOD * i
            s = 0.01 * math.sin(7 * t)
            for name, value in (
                ("flying", (1.0,)),
                ("voltage", (3.9,)),
                ("motor_command", (hover + s, hover - s, hover + 2 * s, hover - 2 * s)),
                ("position", (s, -s, 1.0 + s)),
                ("velocity", (7 * s, 7 * s, s)),
                ("attitude", (s, s, s, math.sqrt(1 - 3 * s * s))),
                ("body_rate", (s, s, s)),
                ("specific_force", (s, s, 9.81)),
            ):
                estimator.feed(Sample(name, t, value))
        estimator.finish()
    except CrazyemError:
        pass  # these artificial data may be refused; only the compilation matters
    return time.monotonic() - begun if compilations() > before else 0.0
