"""Readable numbers of a document, with unit, prefix and the digits that errors justify; access to optional parts."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
LEAST = 0.1  # least number that is shown in a unit with its prefix
NONE = "–"


def number(value: Any) -> float | None:
    """A finite number, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def items(value: Any) -> list[Any]:
    """The list, or an empty one."""
    return list(value) if isinstance(value, list | tuple) else []


def table(value: Any) -> Mapping[str, Any]:
    """The mapping, or an empty one."""
    return value if isinstance(value, Mapping) else {}


def tables(value: Any) -> list[Mapping[str, Any]]:
    """The mappings of a list."""
    return [v for v in items(value) if isinstance(v, Mapping)]


def short(value: Any, how: str = ".3g") -> str:
    """A number in three digits, or in the format `how`; a dash if there is no number."""
    known = number(value)
    return NONE if known is None else format(known, how)


def per_cent(share: float) -> str:
    """A share in per cent, with its sign."""
    return "±0 %" if abs(share) < 0.005 else f"{100 * share:+.0f} %"


def prefixed(size: float, unit: str) -> tuple[float, str]:
    """Factor, and unit with the prefix that suits numbers of this size; "m^2" becomes "m²"."""
    shown = unit.replace("^2", "²")
    if not unit or unit.startswith("1/"):
        return 1.0, shown
    weight = 1e3 if unit.startswith("kg") else 1.0
    for scale, prefix in PREFIXES if size > 0.0 else PREFIXES[:1]:
        if weight * size >= LEAST * scale:
            return weight / scale, prefix + (shown[1:] if weight > 1.0 else shown)
    return 1.0, shown


def quantity(value: Any, unit: Any = "", sd: Any = None, *, how: str = ".3g") -> str:
    """A value with its unit, and with its standard deviation if known: "61.8 ± 2.2 ms"."""
    known, spread = number(value), number(sd)
    if known is None:
        return NONE
    factor, shown = prefixed(max(abs(known), spread or 0.0), str(unit))
    if not spread or spread < 0.0:
        return f"{factor * known:{how}} {shown}".rstrip()
    kept = decimals(factor * spread)
    return f"{factor * known:.{kept}f} ± {factor * spread:.{kept}f} {shown}".rstrip()


def span(ends: Any, value: Any, unit: Any, sd: Any) -> str:
    """An interval in the unit and with the digits of its value: "56.5 to 67.1 ms"."""
    both = [number(e) for e in items(ends)]
    if len(both) != 2 or all(e is None for e in both):
        return ""
    known, spread = number(value) or 0.0, number(sd) or 0.0
    factor, shown = prefixed(max(abs(known), spread) or max(abs(e or 0.0) for e in both), str(unit))
    kept = decimals(factor * spread) if spread > 0.0 else None
    low, high = (
        NONE if e is None else f"{factor * e:.3g}" if kept is None else f"{factor * e:.{kept}f}" for e in both
    )  # fmt: skip
    return f"{low} to {high} {shown}".rstrip()


def decimals(spread: float) -> int:
    """Decimal places for two digits of a standard deviation."""
    return min(9, max(0, 1 - math.floor(math.log10(spread)))) if spread > 0.0 else 3


def joined(words: Sequence[str], last: str = "and") -> str:
    """A list in a sentence."""
    return "".join(words) if len(words) < 2 else f"{', '.join(words[:-1])} {last} {words[-1]}"
