"""The report as HTML: verdict, where, what, how sure, before and after, and what remains unknown.

Made from the diagnosis' JSON document alone (docs of `crazyem diagnose`), so that anyone can write it again. Nothing
in it is fetched from elsewhere, nothing in it runs, and every text of a recording or a file is escaped.
"""

import html
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from crazyem.diagnosis.report.pictures import Series, data_uri
from crazyem.diagnosis.report.style import CSS
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE

QUANTITIES = ("position", "velocity", "attitude", "body_rate")
# Confidence below which a name that stands for no group is said to be the nearest, not what is lacking. Of 18 such
# names in 1899 simulated drones (seeds 2038 to 2043) two were right.
IMPROBABLE = 0.1
Document = Mapping[str, Any]


def write_report(path: str | Path, document: Document, pictures: Mapping[str, Series] | None = None) -> None:
    """Write the report of a diagnosis.

    Args:
        path: of the HTML file; replaced as a whole, or not at all.
        document: the result of a diagnosis, as its JSON has it. Keys that are missing leave out their part. Besides
            those of the interface: `verdict`, `recordings`, `vehicle`, `ranking` (name, held_out_nats, ...), `notices`.
        pictures: by name, in order; see `Series.section`.

    Raises: UsageError if the file cannot be written.
    """
    text = report(document, pictures or {})
    target = Path(path)
    beside = target.with_name(target.name + ".part")
    try:
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, target)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise UsageError(f"cannot write {target}: {error.strerror or error}.") from None


def report(document: Document, pictures: Mapping[str, Series]) -> str:
    """The report as text."""
    where = [s for s in pictures.values() if s.section != "fit"]
    fit = [s for s in pictures.values() if s.section == "fit"]
    sentence = str(document.get("verdict") or verdict(document))
    tone = "differs" if document.get("mismatch") else "agrees"
    body = [
        f'<header class="{tone}"><p class="kicker">crazyem diagnosis</p>'
        f"<h1>{_e(sentence)}</h1>{_about(document)}</header>",
        _section("Where simulation and flight part", _where(document), _figures(where)),
        _section("What is missing from the model", _effects(document), _groups(document)),
        _section("How the candidates compare", _ranking(document)),
        _section("Before and after, open loop", _fit(document), _figures(fit)),
        _section("What remains unknown", _unknown(document)),
        _section("Remarks", _list(document.get("notices"))),
    ]
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">"
        f"<title>crazyem: {_e(sentence)}</title><style>{CSS}</style>"
    )
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head><body><main>\n'
        + "\n".join(body)
        + "\n</main></body></html>\n"
    )


def verdict(document: Document) -> str:
    """The result in one sentence."""
    if not document.get("mismatch"):
        return "Simulation and flight agree as far as this flight can show: nothing is missing that it could reveal."
    effects = _dicts(document.get("effects"))
    groups = _alike(document)
    if not effects:
        return "Simulation and flight differ, and none of the known effects explains it."
    hardly = [e for e in effects if _hardly(e, groups)]
    lacks = _joined([_named(e, groups) for e in effects if e not in hardly])
    nearest, gain = _joined([_named(e, groups) for e in hardly]), _gain(document)
    if not lacks:
        return f"Simulation and flight differ, and none of the known effects explains it; nearest: {nearest}{gain}."
    more = f", and something else, of which the nearest is {nearest}" if nearest else ""
    return f"The model lacks {lacks}{more}{gain}."


def _hardly(effect: Mapping[str, Any], groups: Iterable[Sequence[Any]]) -> bool:
    """Whether an effect that stands for no group is improbable, so that a sentence must not say it is lacking."""
    sure = _number(effect.get("confidence"))
    return sure is not None and sure < IMPROBABLE and not any(effect.get("name") in g for g in groups)


def _named(effect: Mapping[str, Any], groups: Iterable[Sequence[Any]]) -> str:
    name = str(effect.get("name", ""))
    group = next((g for g in groups if name in g and set(g) != {name}), None)
    sure = _number(effect.get("confidence"))
    how = "" if sure is None else f" ({100 * sure:.0f} % sure)"
    if group:
        others = _joined([_words(str(g)) for g in group if g != name], "or")
        return f"{_words(name)}{_which(effect)} (or {others}, which this flight cannot tell from it){how}"
    return _words(name) + _which(effect) + how


def _which(effect: Mapping[str, Any]) -> str:
    """Of which rotor, and since when, where that belongs to the effect."""
    found = _dict(effect.get("parameters"))
    rotor, onset = (_number(_dict(found.get(n)).get("value")) for n in ("rotor", "onset_time"))
    of = "" if rotor is None else f" of rotor {rotor:.0f}"
    return of if onset is None else f"{of} since {onset:.2f} s"


def _gain(document: Document) -> str:
    fit = _dict(document.get("fit"))
    for part, words in (("held_out", "on flight it has not seen"), ("train", "on the flight it was fitted to")):
        both = _dict(fit.get(part))
        before, after = (_last(_dict(both.get(k)), "position") for k in ("before", "after"))
        if before is not None and after is not None:
            horizon = (_items(_dict(both["before"]).get("horizon_s")) or [0.5])[-1]
            change = f"falls from {_m(before)} to {_m(after)}" if after < before else "does not fall"
            return f"; with it the position error after {_short(horizon)} s {change} {words}"
    return ""


def _last(errors: Mapping[str, Any], quantity: str) -> float | None:
    values = _dict(errors.get(quantity)).get("rms")
    return _number(values[-1]) if isinstance(values, list) and values else None


def _m(value: float) -> str:
    return f"{value:.2g} m" if value >= 1 else f"{1e3 * value:.3g} mm" if value < 0.1 else f"{value:.2f} m"


# -- parts -------------------------------------------------------------------------------------------------------------


def _about(document: Document) -> str:
    facts = []
    for key, words in (
        ("recordings", "recordings"),
        ("held_out_recordings", "kept apart"),
        ("vehicle", "vehicle"),
        ("against", "against"),
    ):
        if document.get(key):
            value = document[key]
            value = value.get("simulated", "") if isinstance(value, Mapping) else value
            facts.append((words, ", ".join(map(str, value)) if isinstance(value, list) else str(value)))
    return f'<dl class="about">{"".join(f"<dt>{_e(k)}</dt><dd>{_e(v)}</dd>" for k, v in facts)}</dl>' if facts else ""


def _where(document: Document) -> str:
    out = _findings(_dicts(document.get("where")))
    return out + _against(_dict(document.get("against")))


def _findings(entries: Iterable[Mapping[str, Any]]) -> str:
    rows = []
    for entry in entries:
        span = entry.get("interval")
        times = " to ".join(_short(t) for t in span) + " s" if isinstance(span, list) and len(span) == 2 else ""
        size = f"{_short(entry.get('effect_size'))} {entry.get('unit', '')}"
        rows.append([_words(entry.get("signal", "")), entry.get("axis", ""), entry.get("regime", ""), times, size])
    return _table(["signal", "axis", "regime", "when", "size"], rows, right=(4,)) if rows else ""


def _against(compared: Mapping[str, Any]) -> str:
    """A simulated flight of the same mission, signal by signal."""
    rows = [
        [_words(name), f"{_short(entry.get('rms'))} {entry.get('unit', '')}", _short(entry.get("largest"))]
        for name, entry in _dict(compared.get("signals")).items()
        if isinstance(entry, Mapping)
    ]
    if not rows:
        return ""
    return "<h3>Against the simulated flight</h3>" + _table(["signal", "rms difference", "largest"], rows, right=(1, 2))


def _effects(document: Document) -> str:
    cards = []
    for effect in _dicts(document.get("effects")):
        name = _words(effect.get("label") or effect.get("name", ""))
        sure = _number(effect.get("confidence"))
        badge = "" if sure is None else f'<span class="badge">{100 * sure:.0f} % sure</span>'
        evidence = _dict(effect.get("evidence"))
        words = []
        if _number(evidence.get("held_out_nats")) is not None:
            words.append(f"{_short(evidence['held_out_nats'])} nats on data it was not fitted to")
        if _number(evidence.get("p_value")) is not None:
            words.append(f"p = {_short(evidence['p_value'])}")
        cards.append(
            f'<article class="card"><h3>{_e(name)} {badge}</h3><p class="evidence">{_e("; ".join(words))}</p>'
            f"{_parameters(str(effect.get('name')), _dict(effect.get('parameters')))}</article>"
        )
    if not cards:
        return "<p>None of the effects of the catalogue is claimed.</p>"
    return f'<div class="cards">{"".join(cards)}</div>'


def _parameters(effect: str, parameters: Mapping[str, Any]) -> str:
    neutral = {p.name: _number(p.neutral) for p in CATALOGUE[effect].parameters} if effect in CATALOGUE else {}
    rows = []
    for name, entry in parameters.items():
        found = entry if isinstance(entry, Mapping) else {"value": entry}
        bounds = found.get("ci95")
        interval, bar = "", ""
        if isinstance(bounds, list) and len(bounds) == 2:
            interval = f"{_short(bounds[0])} to {_short(bounds[1])}"
            bar = _interval_bar(
                _number(found.get("value")), _number(bounds[0]), _number(bounds[1]), neutral.get(str(name))
            )
        value = f"{_rounded(found.get('value'), found.get('sd'))} {found.get('unit', '')}"
        rows.append([_e(_words(name)), f"<b>{_e(value)}</b>", _e(interval), bar])
    return _table(["parameter", "value", "95 % interval", "against none"], rows, right=(1, 2), raw=True) if rows else ""


def _interval_bar(value: float | None, low: float | None, high: float | None, neutral: float | None) -> str:
    """The interval against the value at which the effect is absent: whether it excludes it is seen at once."""
    if value is None or low is None or high is None or neutral is None or not low <= high:
        return ""
    left, right = min(neutral, low), max(neutral, high)
    span = (right - left) or 1.0
    left, span = left - 0.06 * span, 1.12 * span

    def at(x: float) -> float:
        return round(100 * (x - left) / span, 2)

    return (
        f'<svg class="bar" viewBox="0 0 100 12" preserveAspectRatio="none" role="img" aria-label="interval">'
        f'<line x1="{at(neutral)}" x2="{at(neutral)}" y1="0" y2="12" class="zero"/>'
        f'<line x1="{at(low)}" x2="{at(high)}" y1="6" y2="6" class="span"/>'
        f'<line x1="{at(value)}" x2="{at(value)}" y1="1.5" y2="10.5" class="value"/></svg>'
    )


def _groups(document: Document) -> str:
    items = [
        _joined([_words(str(name)) for name in group], "and") + " cannot be told apart in this flight"
        for group in _alike(document)
    ]
    separate = document.get("would_separate")
    out = _list(items, kind="warn")
    if separate:
        out += f"<h3>What would tell {'them apart' if items else 'more'}</h3>" + _list(separate)
    return out


def _ranking(document: Document) -> str:
    entries = _dicts(document.get("ranking"))
    if not entries:
        entries = [{"name": e.get("name"), **_dict(e.get("evidence"))} for e in _dicts(document.get("effects"))]
    best = max((_number(e.get("held_out_nats")) or 0.0 for e in entries), default=0.0)
    claimed = {str(e.get("name")) for e in _dicts(document.get("effects"))}
    rows = []
    for entry in entries:
        nats = _number(entry.get("held_out_nats"))
        share = 100 * max(nats or 0.0, 0.0) / best if best > 0 else 0.0
        bar = f'<span class="meter"><i style="width:{share:.1f}%"></i></span>'
        name = str(entry.get("name", ""))
        label = str(entry.get("label") or name)
        note = str(entry.get("note", "")) or ("claimed" if name in claimed else "")
        rows.append([_e(_words(label)), _e(_short(nats)), bar, _e(_short(entry.get("p_value"))), _e(note)])
    return _table(["candidate", "held-out nats", "", "p", ""], rows, right=(1, 3), raw=True) if rows else ""


def _fit(document: Document) -> str:
    out = []
    for part, words in (("held_out", "Flight kept apart"), ("train", "Flight it was fitted to")):
        both = _dict(_dict(document.get("fit")).get(part))
        before, after = _dict(both.get("before")), _dict(both.get("after"))
        table = _horizons(before, after) or _plain_pairs(before, after)
        if table:
            starts = before.get("starts")
            out.append(f"<h3>{words}{f', {_e(_short(starts))} starts' if starts else ''}</h3>{table}")
    closed = _dict(_dict(document.get("fit")).get("gap_closed"))
    shares = [f"{_words(k)} {100 * v:.0f} %" for k in closed if (v := _number(closed[k])) is not None]
    if shares:
        out.append(
            f"<p>Of the mean square error at the longest horizon the fit took away: {_e(', '.join(shares))}.</p>"
        )
    return "".join(out)


def _horizons(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Errors (rms) at each horizon, of what was measured: before, after, and the share that is left."""
    horizons = before.get("horizon_s")
    if not isinstance(horizons, list) or not horizons:
        return ""
    rows = []
    for name in QUANTITIES:
        one, two = _dict(before.get(name)), _dict(after.get(name))
        first, second = _items(one.get("rms")), _items(two.get("rms"))
        cells = [_e(f"{_words(name)} [{one.get('unit', '')}]")]
        for k in range(len(horizons)):
            a = _number(first[k]) if k < len(first) else None
            b = _number(second[k]) if k < len(second) else None
            better = a is not None and b is not None and b < a
            left = f" <small>{100 * b / a:.0f} %</small>" if a and b is not None else ""
            cells.append(f'{_e(_short(a))} → <b class="{"better" if better else ""}">{_e(_short(b))}</b>{left}')
        if first or second:
            rows.append(cells)
    heads = ["rms error after", *(f"{1e3 * _float(h):g} ms" for h in horizons)]
    return _table(heads, rows, right=tuple(range(1, len(heads))), raw=True) if rows else ""


def _plain_pairs(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    rows = [
        [_words(k), _short(before.get(k)), _short(after.get(k))] for k in before if not isinstance(before[k], Mapping)
    ]
    return _table(["", "before", "after"], rows, right=(1, 2)) if rows else ""


def _unknown(document: Document) -> str:
    out = ""
    unexplained = document.get("unexplained")
    if isinstance(unexplained, Mapping) and unexplained:
        places = _dicts(unexplained.get("where"))
        rows = [[_words(k), _flat(v)] for k, v in unexplained.items() if k not in ("found", "where")]
        if unexplained.get("found") is False:
            out += "<h3>Left over after the fit</h3><p>Nothing beyond the noise.</p>"
        else:
            out += "<h3>Left over after the fit</h3>" + (_table(["", ""], rows) if rows else "") + _findings(places)
    missing = document.get("not_identifiable")
    if missing:
        out += "<h3>Not identifiable from this flight</h3>" + _list(
            [_flat(m) if isinstance(m, Mapping) else _words(m) for m in _items(missing) or [missing]]
        )
    if not document.get("indistinguishable") and not document.get("would_separate") and not out:
        return "<p>Nothing beyond the noise, as far as this flight can show.</p>"
    return out


# -- pieces ------------------------------------------------------------------------------------------------------------


def _figures(series: Iterable[Series]) -> str:
    return "".join(
        f'<figure><figcaption>{_e(s.title)}</figcaption><img alt="{_e(s.title)}" src="{data_uri(s)}"></figure>'
        for s in series
    )


def _section(title: str, *parts: str) -> str:
    content = "".join(parts)
    return f"<section><h2>{_e(title)}</h2>{content}</section>" if content else ""


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]], *, right: Sequence[int] = (), raw: bool = False) -> str:
    """A table; cells are escaped unless `raw` says that they are already."""

    def cell(tag: str, k: int, text: Any) -> str:
        shown = str(text) if raw and tag == "td" else _e(str(text))
        return f"<{tag}{' class=r' if k in right else ''}>{shown}</{tag}>"

    top = "".join(cell("th", k, h) for k, h in enumerate(heads)) if any(heads) else ""
    body = "".join("<tr>" + "".join(cell("td", k, c) for k, c in enumerate(row)) + "</tr>" for row in rows)
    headed = f"<thead><tr>{top}</tr></thead>" if top else ""
    return f'<div class="scroll"><table>{headed}<tbody>{body}</tbody></table></div>'


def _list(items: Any, *, kind: str = "") -> str:
    if not items:
        return ""
    texts = [_flat(i) for i in (items if isinstance(items, list | tuple) else [items])]
    return f"<ul{f' class={kind}' if kind else ''}>{''.join(f'<li>{_e(t)}</li>' for t in texts)}</ul>"


def _flat(value: Any) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{_words(str(k))} {_flat(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_flat(v) for v in value)
    return _short(value) if isinstance(value, float) else str(value)


def _e(text: Any) -> str:
    plain = "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in str(text))
    return html.escape(plain)


def _words(name: Any) -> str:
    return str(name).replace("_", " ")


def _joined(words: Sequence[str], last: str = "and") -> str:
    return "".join(words) if len(words) < 2 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _float(value: Any) -> float:
    number = _number(value)
    return math.nan if number is None else number


def _short(value: Any) -> str:
    number = _number(value)
    return ("–" if value is None or isinstance(value, float) else str(value)) if number is None else f"{number:.3g}"


def _rounded(value: Any, sd: Any) -> str:
    """A value to two figures of its standard deviation."""
    number, spread = _number(value), _number(sd)
    if number is None or not spread or spread <= 0:
        return _short(value)
    digits = 1 - math.floor(math.log10(spread))
    if abs(number) < 1e-3 or digits > 6:
        power = math.floor(math.log10(max(abs(number), spread)))
        scaled, kept = number / 10.0**power, max(0, min(6, digits + power))
        return f"({scaled:.{kept}f} ± {spread / 10.0**power:.{kept}f})e{power}"
    return f"{number:.{max(0, digits)}f} ± {spread:.{max(0, digits)}f}"


def _alike(document: Document) -> list[list[str]]:
    """Groups of effects that cannot be told apart."""
    groups = [g for g in _items(document.get("indistinguishable")) if isinstance(g, list | tuple)]
    return [[str(name) for name in group] for group in groups if len(group) > 1]


def _items(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else []


def _dict(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _dicts(value: Any) -> list[Mapping[str, Any]]:
    return [v for v in value if isinstance(v, Mapping)] if isinstance(value, list | tuple) else []
