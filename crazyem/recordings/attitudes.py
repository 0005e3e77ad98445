"""Who made the attitudes of a recording: a filter on board, from the same gyro that is logged, or motion capture."""

from crazyem.recordings.recording import Recording
from crazyem.signals.mavlink import carries_attitude

# What names of attitudes that a filter on board made begin with, beside those of MAVLink: the Crazyflie's, ULog's.
ONBOARD_PREFIXES = ("stateEstimate", "kalman.", "vehicle_attitude.")


def onboard_attitude(recording: Recording) -> bool:
    """Whether the attitude is that of a filter on board, and not of motion capture: by its name, or by a CSV mapping
    that claims it (`attitude = "onboard"`)."""
    attitude = recording.signals.get("attitude")
    if attitude is None:
        return False
    claimed = recording.metadata.get("claims", {}).get("attitude") == "onboard" or "mavlink" in recording.metadata
    return claimed or any(
        s.rsplit("/", 1)[-1].startswith(ONBOARD_PREFIXES) or carries_attitude(s) for s in attitude.source
    )
