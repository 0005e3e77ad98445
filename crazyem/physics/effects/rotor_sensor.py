"""rotor_sensor: the speed sensor of one rotor counts wrong."""

from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Parameter
from crazyem.physics.effects.prior import Prior


def recounted(thrust: NDArray, *, rotor: int, scale: float) -> NDArray:
    """The reported speed is scale times the true one, so the true thrust is what it reads as over scale squared."""
    true = thrust.copy()
    true[:, int(rotor) - 1] /= scale**2
    return true


ROTOR_SENSOR = Effect(
    "rotor_sensor",
    (
        Parameter("rotor", "", 1, 1, 4, 1, chosen=(1, 2, 3, 4), phrase="of rotor {}"),
        Parameter("scale", "", 1.0, 0.1, 3.0, 0.01),
    ),
    order=24,
    speed=recounted,
    prior=Prior(own={"scale": 0.05}),
    needs=("rotor_speed",),
    words="wrong speed sensor",
    separates="log the motor commands beside the speeds, or point an optical tachometer at each rotor in hover",
    spared={"motor_command": "log the motor commands beside the speeds, or "},
)
