"""Whether the drone flies: on the ground the acceleration is 0 at any thrust, so these samples must not be used."""

import math

CLEARANCE_HEIGHT = 0.08  # m above the last resting height, from which a sample counts as flying
CONTACT_HEIGHT = 0.05  # m above the resting height, below which a sample counts as contact again
CONFIRMING_HEIGHTS = 3  # heights in a row above the clearance; a single one may be sensor noise
OFF_FRACTION = 0.1  # share of the largest thrust, below which the rotors are off or idle


class ContactGate:
    """Decides whether the drone flies, by its height above the last resting height with rotors off.

    A drone on the ground counts as flying once its height is above twice the clearance, or above the clearance
    `CONFIRMING_HEIGHTS` times in a row. With 14 mm of position noise, one reading of the resting height and a slow ramp
    of thrust, a sample on the floor is above the clearance in 1 of 400 take-offs; three in a row in none of 100 000.
    """

    def __init__(self, thrust_max: float) -> None:
        """thrust_max: largest thrust of the whole drone [N]; inf if unknown."""
        self._off_below = OFF_FRACTION * thrust_max if math.isfinite(thrust_max) else 1e-9
        self._rest_height = math.nan
        self._above = 0  # heights in a row above the clearance
        self.airborne = False
        self.reason = "no samples yet"

    @property
    def rest_height(self) -> float:
        """Resting height [m, world]; NaN if the drone was not seen at rest."""
        return self._rest_height

    def update(self, *, height: float, thrust: float, flying: bool | None) -> bool:
        """Decide for one sample.

        Args:
            height: z in the world [m], NaN if not measured now.
            thrust: commanded at this time [N].
            flying: the firmware's own verdict, None if it gives none.
        """
        if thrust <= self._off_below or flying is False:
            if not math.isnan(height):
                self._rest_height = height
            self._above = 0
            off = ", rotors off" if thrust <= self._off_below else ""
            self.airborne, self.reason = False, "on the ground" + off
        elif math.isnan(self._rest_height):
            # The recording begins in the air, or height is not measured: the thrust alone decides.
            self.airborne, self.reason = True, ""
        elif not math.isnan(height):
            self._judge(height - self._rest_height)
        return self.airborne

    def _judge(self, above: float) -> None:
        """Decide by the height above the resting height [m], with rotors on."""
        if self.airborne:
            self._above, flies = 0, above >= CONTACT_HEIGHT
        else:
            self._above = self._above + 1 if above >= CLEARANCE_HEIGHT else 0
            flies = self._above >= CONFIRMING_HEIGHTS or above >= 2 * CLEARANCE_HEIGHT
        self.airborne, self.reason = flies, "" if flies else "on the ground"
