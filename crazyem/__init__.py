"""Firmware-in-the-loop estimation of a Crazyflie's mass and inertia, online, by expectation maximisation.

The package offers the commands as functions. They return results and raise `crazyem.errors.CrazyemError`; they never
print or exit. Every name is imported on first use, so that `import crazyem` is quick.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crazyem.api.diagnosing import Diagnosis, diagnose, predict
    from crazyem.api.flying import fly
    from crazyem.api.planning import plan
    from crazyem.api.replaying import replay
    from crazyem.api.vehicles import VehicleCheck, check_vehicle, convert_vehicle, predict_ensemble, sample_vehicle
    from crazyem.diagnosis.prediction.predict import Prediction
    from crazyem.errors import CrazyemError
    from crazyem.estimation.online import OnlineEstimator
    from crazyem.estimation.result import Estimate
    from crazyem.live.attach import attach
    from crazyem.live.flight_result import FlightResult
    from crazyem.live.guard import Guard
    from crazyem.live.policy import Policy, load_policy
    from crazyem.monitoring.fault import Fault
    from crazyem.planning.plan import Plan
    from crazyem.recordings.contents import ReadOptions
    from crazyem.recordings.recording import Recording
    from crazyem.recordings.registry import open_recording
    from crazyem.signals.sample import Sample
    from crazyem.vehicle import Vehicle, load_vehicle

    __version__: str

_HOME = {
    "VehicleCheck": "api.vehicles",
    "CrazyemError": "errors",
    "Diagnosis": "api.diagnosing",
    "Estimate": "estimation.result",
    "Fault": "monitoring.fault",
    "FlightResult": "live.flight_result",
    "Guard": "live.guard",
    "OnlineEstimator": "estimation.online",
    "Plan": "planning.plan",
    "Policy": "live.policy",
    "Prediction": "diagnosis.prediction.predict",
    "ReadOptions": "recordings.contents",
    "Recording": "recordings.recording",
    "Sample": "signals.sample",
    "Vehicle": "vehicle",
    "attach": "live.attach",
    "check_vehicle": "api.vehicles",
    "convert_vehicle": "api.vehicles",
    "diagnose": "api.diagnosing",
    "fly": "api.flying",
    "load_policy": "live.policy",
    "load_vehicle": "vehicle",
    "open_recording": "recordings.registry",
    "plan": "api.planning",
    "predict": "api.diagnosing",
    "predict_ensemble": "api.vehicles",
    "replay": "api.replaying",
    "sample_vehicle": "api.vehicles",
}

__all__ = [
    "CrazyemError",
    "Diagnosis",
    "Estimate",
    "Fault",
    "FlightResult",
    "Guard",
    "OnlineEstimator",
    "Plan",
    "Policy",
    "Prediction",
    "ReadOptions",
    "Recording",
    "Sample",
    "Vehicle",
    "VehicleCheck",
    "__version__",
    "attach",
    "check_vehicle",
    "convert_vehicle",
    "diagnose",
    "fly",
    "load_policy",
    "load_vehicle",
    "open_recording",
    "plan",
    "predict",
    "predict_ensemble",
    "replay",
    "sample_vehicle",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("crazyem")
    if name not in _HOME:
        raise AttributeError(f"module 'crazyem' has no attribute '{name}'")
    return getattr(importlib.import_module(f"crazyem.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
