"""Whether the drone flies: samples in contact with the ground say a = 0 whatever the thrust, and must never be used."""

import math

CLEARANCE_HEIGHT = 0.08  # m above the last resting height before a sample counts as flying
CONTACT_HEIGHT = 0.05  # m above it below which a sample counts as contact again
CONFIRMING_HEIGHTS = 3  # heights in a row above the clearance: one alone may be noise of the sensor
OFF_FRACTION = 0.1  # of the largest thrust: below it the rotors are off or idling


class ContactGate:
    """Remembers the height at which the drone last rested with its rotors off.

    A drone that was on the ground flies when it is seen well above it (twice the clearance), or above the clearance
    `CONFIRMING_HEIGHTS` times in a row. With 14 mm of noise in the position and one reading of the resting height, some
    sample on the floor is above the clearance in 1 of 400 take-offs on a slow ramp of thrust, and three in a row in
    none of 100 000.
    """

    def __init__(self, thrust_max: float) -> None:
        """thrust_max: of the whole drone [N]; inf if unknown."""
        self._off_below = OFF_FRACTION * thrust_max if math.isfinite(thrust_max) else 1e-9
        self._rest_height = math.nan
        self._above = 0  # heights in a row above the clearance
        self.airborne = False
        self.reason = "no samples yet"

    @property
    def rest_height(self) -> float:
        """m in the world, NaN where the drone was not seen at rest."""
        return self._rest_height

    def update(self, *, height: float, thrust: float, flying: bool | None) -> bool:
        """Decide for one sample.

        Args:
            height: z in the world [m], NaN if not measured now.
            thrust: commanded at this time [N].
            flying: what the firmware says, None if it says nothing.
        """
        if thrust <= self._off_below or flying is False:
            if not math.isnan(height):
                self._rest_height = height
            self._above = 0
            off = ", rotors off" if thrust <= self._off_below else ""
            self.airborne, self.reason = False, "on the ground" + off
        elif math.isnan(self._rest_height):
            # Recording begins in the air, or height is not measured: rotors that turn are all there is to go by.
            self.airborne, self.reason = True, ""
        elif not math.isnan(height):
            self._judge(height - self._rest_height)
        return self.airborne

    def _judge(self, above: float) -> None:
        """By the height above the resting height, rotors turning."""
        if self.airborne:
            self._above, flies = 0, above >= CONTACT_HEIGHT
        else:
            self._above = self._above + 1 if above >= CLEARANCE_HEIGHT else 0
            flies = self._above >= CONFIRMING_HEIGHTS or above >= 2 * CLEARANCE_HEIGHT
        self.airborne, self.reason = flies, "" if flies else "on the ground"
