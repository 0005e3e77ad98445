"""What kind of vehicle an autopilot says that it is."""

from pymavlink.dialects.v20.ardupilotmega import enums


def vehicle_of(kind: int) -> dict[str, str]:
    """The section "vehicle" of the metadata: "mav_type" (a number of MAV_TYPE) and "kind" (its words, "quadrotor").

    Args:
        kind: MAV_TYPE; below 1 ("generic") nothing is known.

    Source: mavlink.io/en/messages/common.html, as pymavlink has it.
    """
    known = enums["MAV_TYPE"].get(kind) if kind > 0 else None
    if known is None:
        return {}
    words = str(known.description).split(". ")[0].rstrip(".")
    return {"kind": words[:1].lower() + words[1:], "mav_type": str(kind)}
