"""The result of a diagnosis in a sentence or two, and readable numbers with unit, prefix and justified digits."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Parameter

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


QUANTITIES = ("position", "velocity", "attitude", "body_rate")
JUDGES = (("held_out", "on flight it has not seen"), ("train", "on the flight it was fitted to"))
Document = Mapping[str, Any]


def verdict(document: Document) -> str:
    """The missing effects, and the change of each of the four errors."""
    return " ".join(filter(None, (claim(document), changes(document))))


def claim(document: Document) -> str:
    """The missing effects, with size and probability.

    If the fitted model predicts a quantity worse than the file, by more than chance, no effect is called missing.
    """
    if document.get("verdict"):
        return str(document["verdict"])
    if not document.get("mismatch"):
        return "Simulation and flight agree as far as this flight can show: nothing is missing that it could reveal."
    effects, groups = tables(document.get("effects")), alike(document)
    if not effects:
        return f"Simulation and flight differ, and none of the known effects explains it{_strongest(document)}."
    hardly = [e for e in effects if _is_improbable(e, groups)]
    lacks = joined([_named(e, groups) for e in effects if e not in hardly])
    nearest, spoilt = joined([_named(e, groups) for e in hardly]), worse(document)
    if spoilt:
        explanation = joined([_named(e, groups) for e in effects])
        return (
            f"Simulation and flight differ; the nearest explanation is {explanation}, but that predicts {spoilt} worse "
            f"than before {_judge(document)[1]}."
        )
    if not lacks:
        return f"Simulation and flight differ, and none of the known effects explains it; nearest: {nearest}."
    more = f", and something else, of which the nearest is {nearest}" if nearest else ""
    return f"The model lacks {lacks}{more}{_remark(effects)}."


def changes(document: Document) -> str:
    """Change of the four errors at the longest horizon, as a sentence; "" without effects or predictions."""
    if document.get("verdict") or not document.get("mismatch") or not tables(document.get("effects")):
        return ""
    part, words = _judge(document)
    before, after = table(part.get("before")), table(part.get("after"))
    said: list[str] = []
    for name in QUANTITIES:
        one, two = (_last(table(errors.get(name)).get("rms")) for errors in (before, after))
        if not one or two is None:
            continue
        unit = table(before.get(name)).get("unit", "")
        sizes = f" {quantity(one, unit)} to {quantity(two, unit)}," if not said else ""
        said.append(f"{spaced(name)}{sizes} {per_cent(two / one - 1.0)}")
    horizon = _last(before.get("horizon_s"))
    return f"Errors {short(horizon)} s ahead {words}: {'; '.join(said)}." if said else ""


def worse(document: Document) -> str:
    """Quantities and horizons that are predicted worse than before, in words; "" if there are none."""
    part, _ = _judge(document)
    horizons: dict[str, list[str]] = {}
    for entry in tables(part.get("worse")):
        horizons.setdefault(spaced(entry.get("quantity", "")), []).append(short(entry.get("horizon_s")))
    return joined([f"{name} {joined(ahead)} s ahead" for name, ahead in horizons.items()])


def alike(document: Document) -> list[list[str]]:
    """Groups of effects that cannot be told apart."""
    groups = [[str(name) for name in items(group)] for group in items(document.get("indistinguishable"))]
    return [group for group in groups if len(group) > 1]


def spaced(name: Any) -> str:
    """A name as words."""
    return str(name).replace("_", " ")


def effect_words(name: Any) -> str:
    """An effect in words, by its name."""
    return CATALOGUE[str(name)].description({}) if str(name) in CATALOGUE else spaced(name)


def words_of(effect: Mapping[str, Any]) -> str:
    """An effect in words, with its choices (rotor, onset)."""
    if str(effect.get("name")) not in CATALOGUE:
        return spaced(effect.get("words") or effect.get("name", ""))
    found = table(effect.get("parameters"))
    values = {str(n): table(v).get("value") if isinstance(v, Mapping) else v for n, v in found.items()}
    return CATALOGUE[str(effect["name"])].description(values)


def sizes_of(effect: Mapping[str, Any]) -> str:
    """The fitted parameters with their units, in short form."""
    found = {str(n): v for n, v in table(effect.get("parameters")).items() if isinstance(v, Mapping)}
    fitted = {n: v for n, v in found.items() if not v.get("chosen") and number(v.get("value")) is not None}
    if len(fitted) == 1:
        ((name, only),) = fitted.items()
        words = next((p.words for p in _parameters(effect) if p.name == name), "")
        return f"{words} {quantity(only['value'], only.get('unit', ''), only.get('sd'))}".lstrip()
    parts = []
    for unit in dict.fromkeys(str(v.get("unit", "")) for v in fitted.values()):
        mine = {n: number(v["value"]) or 0.0 for n, v in fitted.items() if str(v.get("unit", "")) == unit}
        factor, shown = prefixed(max(map(abs, mine.values())), unit)
        parts.append(f"{', '.join(f'{spaced(n)} {factor * v:.3g}' for n, v in mine.items())} {shown}".rstrip())
    return ", ".join(parts)


def _judge(document: Document) -> tuple[Mapping[str, Any], str]:
    """The errors that judge a model, on held-out flights or else on fitted ones; and the name of these flights."""
    fit = table(document.get("fit"))
    found = ((table(fit.get(part)), words) for part, words in JUDGES)
    return next(((part, words) for part, words in found if part.get("before") and part.get("after")), ({}, ""))


def _is_improbable(effect: Mapping[str, Any], groups: Iterable[Sequence[str]]) -> bool:
    """Whether an effect outside all groups is improbable, so that it must not be called missing."""
    sure = number(effect.get("confidence"))
    return sure is not None and sure < CONFIDENCE.improbable and not any(effect.get("name") in g for g in groups)


def _named(effect: Mapping[str, Any], groups: Iterable[Sequence[str]]) -> str:
    name = str(effect.get("name", ""))
    sure = number(effect.get("confidence"))
    about = [sizes_of(effect), "" if sure is None else f"{100 * sure:.0f} % sure"]
    how = f" ({'; '.join(filter(None, about))})" if any(about) else ""
    group = next((g for g in groups if name in g and set(g) != {name}), None)
    if group:
        others = joined([effect_words(g) for g in group if g != name], "or")
        return f"{words_of(effect)} (or {others}, which this flight cannot tell from it){how}"
    return words_of(effect) + how


def _remark(effects: Sequence[Mapping[str, Any]]) -> str:
    """The remarks of the fitted parameters, if all of them have one; else ""."""
    remarks = []
    for effect in effects:
        fitted = [p for p in _parameters(effect) if p.name in table(effect.get("parameters"))]
        if not fitted or not all(p.remark for p in fitted):
            return ""
        remarks += [p.remark for p in fitted]
    return "; " + joined(list(dict.fromkeys(remarks)))


def _parameters(effect: Mapping[str, Any]) -> tuple[Parameter, ...]:
    """Parameters of an effect by the catalogue; none if the catalogue does not know the effect."""
    known = CATALOGUE.get(str(effect.get("name")))
    return known.parameters if known else ()


def _strongest(document: Document) -> str:
    """The strongest unexplained structure, as a clause; "" if there is none."""
    left = tables(table(document.get("unexplained")).get("where"))
    if not left:
        return ""
    size = quantity(left[0].get("effect_size"), left[0].get("unit", ""))
    where = " ".join(spaced(left[0].get(k, "")) for k in ("signal", "axis"))
    return f"; the strongest of what is left is {where}, {left[0].get('regime', '')}: {size}"


def _last(values: Any) -> float | None:
    return number(items(values)[-1]) if items(values) else None
