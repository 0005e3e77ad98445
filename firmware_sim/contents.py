"""The tables of contents of the firmware of August 2026, in its order: names, types, flags, defaults of parameters.

Source: cflib read them over the link from crazyflie-firmware 2a18fc29 (protocol 12, 354 log variables, 245 parameters),
built for a PC; flags from its source (PARAM_ADD of each module). A build for a drone has more: rotor speeds of a
brushless drone, decks, groups of an application. tables.py adds these.
"""

from dataclasses import dataclass
from importlib import resources

# Defaults that differ on a brushless drone.
CF21BL = {
    "pid_rate.roll_kp": 200.0,
    "pid_rate.roll_ki": 400.0,
    "pid_rate.pitch_kp": 200.0,
    "pid_rate.pitch_ki": 400.0,
    "posCtlPid.thrustBase": 30000.0,
    "ctrlMel.mass": 0.0393,
    "ctrlLee.mass": 0.0393,
    "powerDist.idleThrust": 7000.0,
}


@dataclass(frozen=True)
class Parameter:
    """Type, flags ("p" persistent, "r" read only, "c" core) and the value at boot of a cf2, in the firmware's unit."""

    kind: str
    flags: str
    default: float


def _lines(name: str) -> list[list[str]]:
    """The words of each line of a file in tables_of_contents/, without remarks."""
    text = (resources.files("firmware_sim") / "tables_of_contents" / name).read_text(encoding="utf-8")
    return [line.split() for line in text.splitlines() if not line.startswith("#")]


def _log() -> dict[str, str]:
    return {f"{group}.{name}": kind for group, kind, *names in _lines("log.txt") for name in names}


def _parameters() -> dict[str, Parameter]:
    table = {}
    for group, type_and_flags, *entries in _lines("parameters.txt"):
        kind, _, flags = type_and_flags.partition("/")
        for entry in entries:
            name, _, default = entry.partition("=")
            table[f"{group}.{name}"] = Parameter(kind, flags, float(default))
    return table


LOG = _log()  # name -> type
PARAMETERS = _parameters()


def defaults(names: tuple[str, ...] | list[str], platform: str = "cf2") -> dict[str, float]:
    """Boot values of those parameters on a platform ("cf2", "cf21bl"). Raises KeyError for a name not in the table."""
    special = CF21BL if platform == "cf21bl" else {}
    return {name: special.get(name, PARAMETERS[name].default) for name in names}
