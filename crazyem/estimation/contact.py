"""Whether the drone flies: samples in contact with the ground say a = 0 whatever the thrust, and must never be used."""

import math

CLEARANCE = 0.08  # m above the last resting height before a sample counts as flying
CONTACT = 0.05  # m above it below which a sample counts as contact again
OFF_FRACTION = 0.1  # of the largest thrust: below it the rotors are off or idling


class ContactGate:
    """Remembers the height at which the drone last rested with its rotors off."""

    def __init__(self, thrust_max: float) -> None:
        """thrust_max: of the whole drone [N]; inf if unknown."""
        self._off_below = OFF_FRACTION * thrust_max if math.isfinite(thrust_max) else 1e-9
        self._rest_height = math.nan
        self._seen_off = False
        self.airborne = False
        self.reason = "no samples yet"

    def update(self, *, height: float, thrust: float, flying: bool | None) -> bool:
        """Decide for one sample.

        Args:
            height: z in the world [m], NaN if not measured now.
            thrust: commanded at this time [N].
            flying: what the firmware says, None if it says nothing.
        """
        if thrust <= self._off_below or flying is False:
            self._seen_off = True
            if not math.isnan(height):
                self._rest_height = height
            off = ", rotors off" if thrust <= self._off_below else ""
            self.airborne, self.reason = False, "on the ground" + off
        elif math.isnan(self._rest_height):
            # Recording begins in the air, or height is not measured: rotors that turn are all there is to go by.
            self.airborne, self.reason = True, ""
        elif not math.isnan(height):
            above = height - self._rest_height
            if (self.airborne and above < CONTACT) or (not self.airborne and above < CLEARANCE):
                self.airborne, self.reason = False, "on the ground"
            else:
                self.airborne, self.reason = True, ""
        return self.airborne
