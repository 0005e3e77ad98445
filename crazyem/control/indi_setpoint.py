"""Places that make the firmware's INDI follow a reference: of a setpoint with a place it takes place and heading only.

Its outer loop (position_controller_indi.c) wants the acceleration K_dxi (K_xi (place - p) - v), and its inner one the
yaw rate ref_err_r (heading - yaw). A place ahead of the reference by (v + a/K_dxi)/K_xi asks for the reference's
acceleration where the drone is on it; a heading ahead by its rate over ref_err_r does the same for yaw.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from crazyem.control.trajectories import Reference

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class IndiGains:
    """The firmware's gains, 1/s: of places, of velocities, of the heading. Defaults: those at boot."""

    place: tuple[float, float, float] = (1.0, 1.0, 1.0)
    velocity: tuple[float, float, float] = (5.0, 5.0, 5.0)
    heading: float = 5.0

    @classmethod
    def of(cls, values: Mapping[str, float]) -> "IndiGains":
        """From parameter values; see `PARAMETERS`. A gain that is not positive counts as the one at boot."""
        plain = cls()

        def positive(name: str, otherwise: float) -> float:
            return values[name] if values.get(name, 0.0) > 0.0 else otherwise

        place = [positive(f"posCtrlIndi.K_xi_{a}", g) for a, g in zip(_AXES, plain.place)]
        velocity = [positive(f"posCtrlIndi.K_dxi_{a}", g) for a, g in zip(_AXES, plain.velocity)]
        return cls(
            (place[0], place[1], place[2]),
            (velocity[0], velocity[1], velocity[2]),
            positive("ctrlINDI.ref_err_r", plain.heading),
        )


PARAMETERS = (
    *(f"posCtrlIndi.{gain}_{a}" for gain in ("K_xi", "K_dxi") for a in _AXES),
    "ctrlINDI.ref_err_r",
)


def place_ahead(r: Reference, gains: IndiGains) -> tuple[float, float, float, float]:
    """x, y, z [m, world] and heading [rad] to send for a reference."""
    x, y, z = (
        p + (v + a / k_v) / k_p
        for p, v, a, k_p, k_v in zip(r.position, r.velocity, r.acceleration, gains.place, gains.velocity)
    )
    return x, y, z, r.yaw + r.yaw_rate / gains.heading
