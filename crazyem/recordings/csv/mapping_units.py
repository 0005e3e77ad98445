"""Units in recordings: the kind of quantity and the factor to SI of each."""

import math

from crazyem.errors import FileFormatError
from crazyem.signals.sample import SIGNALS
from crazyem.signals.vocabulary import STANDARD_GRAVITY

_TURN = 2.0 * math.pi
_DEGREE = math.pi / 180.0
_FOOT = 0.3048
_FORCE_OF_GRAM = 9.80665e-3  # N, the standard definition; g as an acceleration is the firmware's 9.81

# kind of quantity -> unit -> factor to SI
_UNIT_KINDS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "km": 1e3, "ft": _FOOT, "in": 0.0254},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1.0 / 3.6, "ft/s": _FOOT},
    "acceleration": {
        "m/s^2": 1.0,
        "mm/s^2": 1e-3,
        "cm/s^2": 1e-2,
        "g": STANDARD_GRAVITY,
        "mg": 1e-3 * STANDARD_GRAVITY,
    },
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "cdeg": 1e-2 * _DEGREE, "rev": _TURN},
    "angular rate": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": _DEGREE,
        "mdeg/s": 1e-3 * _DEGREE,
        "rpm": _TURN / 60.0,
        "erpm": _TURN / 60.0,  # of the electrical field: needs the number of pole pairs
        "krpm": _TURN / 60e-3,
        "Hz": _TURN,
    },
    "voltage": {"V": 1.0, "mV": 1e-3, "cV": 1e-2},
    "force": {"N": 1.0, "mN": 1e-3, "gf": _FORCE_OF_GRAM, "kgf": 1e3 * _FORCE_OF_GRAM},
    "torque": {"N m": 1.0, "mN m": 1e-3, "uN m": 1e-6, "gf cm": 1e-2 * _FORCE_OF_GRAM},
    "ratio": {"1": 1.0, "%": 1e-2, "pwm": 1.0 / 65535.0, "pwm8": 1.0 / 255.0, "us": 1e-3},
    "count": {"1": 1.0, "pwm": 1.0},
    "number": {"1": 1.0},
}

# SI value at 0 of a unit, if not 0: servo pulses have 1000 us at no thrust and 2000 us at full thrust
_UNIT_OFFSETS: dict[tuple[str, str], float] = {("ratio", "us"): -1.0}

_TIME_UNITS: dict[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1.0 / 60.0, "h": 1.0 / 3600.0}

_KIND_OF_QUANTITY = {"voltage": "voltage", "mixer_command": "count", "motor_command": "ratio", "motor_request": "ratio"}
_KIND_OF_UNIT = {"m": "length", "m/s": "speed", "m/s^2": "acceleration", "rad": "angle", "rad/s": "angular rate"}

# other spellings of units
_SPELLINGS: dict[str, str] = {
    spelling: unit
    for unit, spellings in {
        "1": ("", "-", "duty", "ratio"),
        "%": ("percent",),
        "m": ("meter", "meters", "metre", "metres"),
        "um": ("µm",),
        "km/h": ("kph",),
        "m/s": ("m s^-1", "mps"),
        "m/s^2": ("m/s2", "m/s/s", "m/s**2", "m/s²", "m s^-2"),
        "mm/s^2": ("mm/s2", "mm/s²"),
        "g": ("G", "gee"),
        "rad": ("radian", "radians"),
        "deg": ("degree", "degrees", "°"),
        "rad/s": ("rad s^-1",),
        "deg/s": ("degrees/s", "°/s", "dps"),
        "rpm": ("RPM", "rev/min"),
        "erpm": ("eRPM", "ERPM"),
        "Hz": ("rev/s", "rps", "hz"),
        "V": ("volt", "volts", "v"),
        "N m": ("Nm", "N*m"),
        "mN m": ("mNm",),
        "uN m": ("uNm", "µN m"),
        "us": ("µs",),
        "s": ("sec", "seconds"),
        "pwm": ("PWM",),
    }.items()
    for spelling in spellings
}


def kind_of(quantity: str, component: int) -> str:
    """The kind of quantity of a component of a vocabulary signal: "length", "speed", "ratio", ..."""
    if quantity == "wrench_command":
        return "force" if component == 0 else "torque"
    return _KIND_OF_QUANTITY.get(quantity) or _KIND_OF_UNIT.get(SIGNALS[quantity][1], "number")


def unit_factor(unit: str, quantity: str, component: int, where: str) -> float:
    """Factor from `unit` to the SI unit of a component of a signal.

    Raises: FileFormatError, one sentence that begins with `where`, if the unit is unknown or measures something else.
    """
    kind = kind_of(quantity, component)
    known = _UNIT_KINDS[kind]
    name = _spelled(unit)
    if name in known:
        return known[name]
    others = [k for k, units in _UNIT_KINDS.items() if name in units]
    if others:
        raise FileFormatError(
            f'{where}: "{unit}" is a unit of {others[0]}, but {quantity} is {_article(kind)} '
            f"(units: {', '.join(known)})."
        )
    raise FileFormatError(f'{where}: unknown unit "{unit}"; known for {quantity} are {", ".join(known)}.')


def unit_offset(unit: str, quantity: str, component: int) -> float:
    """The value of 0 `unit` in the SI unit of a component of a signal."""
    return _UNIT_OFFSETS.get((kind_of(quantity, component), _spelled(unit)), 0.0)


def time_divisor(unit: str, where: str) -> float:
    """The divisor from stamps in `unit` to seconds. Raises FileFormatError for an unknown unit of time."""
    name = _spelled(unit)
    if name not in _TIME_UNITS:
        raise FileFormatError(f'{where}: unknown unit "{unit}" of time; known are {", ".join(_TIME_UNITS)}.')
    return _TIME_UNITS[name]


def is_electrical(unit: str) -> bool:
    """Whether a unit counts turns of the electrical field, so that the number of pole pairs is needed."""
    return _spelled(unit) == "erpm"


def counts_turns(unit: str) -> bool:
    """Whether a unit is from speed controllers: turns per minute of the rotor or of the electrical field."""
    return _spelled(unit) in ("rpm", "erpm")


def _spelled(unit: str) -> str:
    text = unit.strip()
    return _SPELLINGS.get(text, text)


def _article(kind: str) -> str:
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"
