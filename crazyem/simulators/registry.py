"""All formats by name, and which of them a text is."""

from crazyem.errors import FileFormatError, UsageError
from crazyem.simulators.fields import Format
from crazyem.simulators.formats.crazyflow import CRAZYFLOW
from crazyem.simulators.formats.crazyswarm2 import CRAZYSWARM2
from crazyem.simulators.formats.gazebo import GAZEBO
from crazyem.simulators.formats.gym_pybullet_drones import GYM_PYBULLET_DRONES
from crazyem.simulators.formats.l2f import L2F
from crazyem.simulators.formats.mujoco import MUJOCO
from crazyem.simulators.formats.omnidrones import OMNIDRONES
from crazyem.simulators.formats.px4_sih import PX4_SIH
from crazyem.simulators.formats.rotorpy import ROTORPY, ROTORPY_JSON

OWN = "crazyem"  # a vehicle file
FORMATS = {
    f.name: f
    for f in (
        CRAZYFLOW, GYM_PYBULLET_DRONES, MUJOCO, GAZEBO, ROTORPY, CRAZYSWARM2, PX4_SIH, OMNIDRONES, L2F, ROTORPY_JSON,
    )
}  # fmt: skip
NAMES = (*(n for n in FORMATS if n != ROTORPY_JSON.name), OWN)


def format_named(name: str) -> Format:
    """A format by its name. Raises UsageError for an unknown one."""
    if name not in FORMATS:
        raise UsageError(f"unknown format '{name}' (known: {', '.join(NAMES)}).")
    return FORMATS[name]


def format_of(text: str, *, where: str) -> str:
    """The name of the format that a text is of, `OWN` for a vehicle file.

    Raises: FileFormatError where it is of none.
    """
    for form in FORMATS.values():
        if form.recognises(text):
            return form.name
    if "cmd_f_coef" in text or "rpy_coef" in text:
        raise FileFormatError(
            f"{where}: a fitted closed-loop model of crazyflow holds no physical constants; fit it to flights instead"
        )
    if "thrust2torque" in text and "mass_thrust" in text:
        raise FileFormatError(f"{where}: gains of crazyflow's controller, not constants of a drone")
    if any(line.split("=")[0].strip() == "mass" for line in text.splitlines()) and "inertia" in text:
        return OWN
    raise FileFormatError(f"{where}: no file of a known simulator ({', '.join(NAMES)})")
