"""Reads a study from its files, scores it and writes the published table."""

import textwrap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.vehicle import Vehicle, load_vehicle, parse_vehicle

from .ideal import held_out_error, ideal_nats, ideal_nats_of_each
from .paths import Study, read, write
from .random_world import of_the_day
from .score import Outcome, failures, figures, wilson

DOCS = Path(__file__).resolve().parents[2] / "docs" / "results"
# Place of the table of each world in docs/results/concealed.md, and of the file with its figures.
MARKS = {
    "home": ("<!-- concealed: table -->", "<!-- /concealed -->", "concealed.json"),
    "random": ("<!-- random: table -->", "<!-- /random -->", "concealed_random.json"),
    "foreign": ("<!-- foreign: table -->", "<!-- /foreign -->", "concealed_foreign.json"),
}
Ideal = Literal["all", "failures", "kept"]


def outcomes(study: Study, *, ideal: Ideal = "all") -> list[Outcome]:
    """Every flown case with an answer.

    Figures that need the truth are computed once and kept in OUT/ideal. `ideal`: "all" with held-out predictions;
    "failures" the nats of failures alone (named cases count as detectable); "kept" computes nothing more.
    """
    kept = [_outcome(study, case) for case in study.cases() if study.answer(case).is_file()]
    wanted = {row["case"] for row in failures(kept)} if ideal == "failures" else set()
    for outcome in kept:
        case = outcome.truth["case"]
        if ideal == "all" or case in wanted:
            _know(study, case, outcome.truth, held_out=ideal == "all" and not study.alone)
    return [_outcome(study, outcome.truth["case"]) for outcome in kept]


def _outcome(study: Study, case: str) -> Outcome:
    answer, truth, known = read(study.answer(case)), read(study.truth(case)), read(_known(study, case)) or {}
    held_out = {} if study.alone else known.get("held_out", {})  # of the vehicle that both flights gave
    return Outcome(
        truth, answer["result"], answer["seconds"], known.get("nats"), held_out, known.get("of_each") or {},
        vehicle=_given(study, truth),
    )  # fmt: skip


def _given(study: Study, truth: Mapping[str, Any]) -> Vehicle:
    """The vehicle that the diagnosis was given."""
    if truth.get("world", "home") == "home":
        return load_vehicle(truth["platform"])
    return parse_vehicle(study.vehicle(truth["case"]).read_text())


def unhidden(
    study: Study, truth: Mapping[str, Any], flight: str = "recording"
) -> tuple[Vehicle, dict[str, dict[str, Any]]]:
    """The given vehicle with the true drag, if its file leaves that out, and the changes of the day of a flight; and
    the hidden effects on that day."""
    given = _given(study, truth)
    hidden = {n: _day(truth, flight, truth["effects"]).get(n, t) for n, t in truth["effects"].items()}
    return replace(given, effects={**given.effects, **truth.get("built", {}), **_day(truth, flight, {})}), hidden


def _day(truth: Mapping[str, Any], flight: str, hidden: dict[str, Any]) -> dict[str, Any]:
    """Changes of the day of a flight, added to the hidden effects."""
    return of_the_day(dict(truth), flight, hidden) if "own" in truth else {}


def _known(study: Study, case: str) -> Path:
    return study.folder / "ideal" / f"{case}.json"


def _know(study: Study, case: str, truth: Mapping[str, Any], *, held_out: bool) -> None:
    """Store nats of the truth on the flight and, if asked, held-out errors of nominal, fitted and true model."""
    known: dict[str, Any] = read(_known(study, case)) or {"held_out": {}}
    (vehicle, hidden), mapping = unhidden(study, truth), study.mapping(case)
    if known.get("nats") is None and truth["kind"] in ("single", "pair"):
        known["nats"] = ideal_nats(study.recording(case, "recording"), vehicle, hidden, mapping=mapping)
    if known.get("of_each") is None and truth["kind"] == "pair":
        known["of_each"] = ideal_nats_of_each(study.recording(case, "recording"), vehicle, hidden, mapping=mapping)
    home = truth.get("world", "home") == "home"
    file = study.folder / "vehicles" / f"{truth['platform']}.toml" if home else study.vehicle(case)
    models = {"nominal": file, "fitted": study.fitted(case)} if held_out else {}
    if held_out and truth["effects"] and not truth["hidden"]:
        models["true"] = study.truth(case).with_name(f"{case}_vehicle.toml")
        own = {n: t for n, t in truth["effects"].items() if CATALOGUE[n].belongs_to == "vehicle"}
        any_day = {**_given(study, truth).effects, **truth.get("built", {}), **own}
        models["true"].write_text(replace(vehicle, effects=any_day).to_toml())
    for name, model in models.items():
        if known["held_out"].get(name) is None and model.is_file():
            known["held_out"][name] = held_out_error(study.recording(case, "held_out"), str(model), mapping=mapping)
    write(_known(study, case), known)


def percent(share: dict[str, Any]) -> str:
    """A share with its number of cases."""
    if share["share"] is None:
        return "not measured"
    low, high = wilson(share["share"], share["n"])
    return f"{100 * share['share']:.1f} % of {share['n']} ({100 * low:.0f} to {100 * high:.0f})"


def _number(value: float | None, text: str) -> str:
    return "not measured" if value is None else text.format(value)


def table(f: dict[str, Any], *, brief: bool = False) -> str:
    """The figures as Markdown; brief: figures with an aim, without the other tables."""
    cases, p, s, o = f["cases"], f["parameters"], f["single"], f["outside"]
    calibration = f["confidence"]["expected_calibration_error"]
    rows = [
        ("nothing hidden: false alarms", percent(f["nothing"]["false_alarms"]), "at most 3 %"),
        ("single, strong: named first (a declared group counts half)", percent(s["named_first_strong"]), "95 %"),
        ("single, all detectable: named first (a declared group counts half)", percent(s["named_first_all"]), "85 %"),
        ("the same, groups not looked at", percent(s["first_whatever_groups"]), ""),
        ("right rotor, where one was named", percent(s["right_rotor"]), ""),
        ("95 % intervals that hold the truth", percent(p["interval_coverage"]), "90 to 98 %"),
        ("median error of a parameter, of the effect's size", _number(p["error"]["median"], "{:.1%}"), "under 10 %"),
        ("pairs: both and only both", percent(f["pairs"]["both_and_only_both"]), "75 %"),
        (f"the same, without those of which the ideal observer (asked in {f['pairs']['each_known']}) sees one only",
         percent(f["pairs"]["each_detectable"]), ""),
        ("pairs, up to declared groups", percent(f["pairs"]["up_to_declared_groups"]), ""),
        ("outside: unexplained, right axis and regime", percent(o["unexplained_right_axis_and_regime"]), "80 %"),
        ("outside: wrong confident name", percent(o["wrong_confident_name"]), "under 5 %"),
        ("held-out 0.5 s error over the true model's, mean", _number(f["held_out"].get("mean_ratio"), "{:.3f}"),
         "at most 1.1"),
        ("the same, median", _number(f["held_out"]["median_ratio"], "{:.3f}"), "at most 1.1"),
        ("cases with at most 1.1", percent(f["held_out"]["within_10_percent_of_true_model"]), "all, read strictly"),
        ("confidence: expected calibration error", _number(calibration, "{:.3f}"), ""),
        ("seconds for a case: median", _number(f["seconds"]["median"], "{:.1f}"), "under 60"),
    ]  # fmt: skip
    if brief:
        rows = [row for row in rows if row[2] and not row[0].startswith(("the same", "cases with"))]
    lines = [
        f"{sum(cases.values())} cases: {cases['nothing']} with nothing hidden, {cases['single']} single effects "
        f"({s['detectable']['n']} detectable), {cases['pair']} pairs, {cases['outside']} outside the catalogue; "
        f"{f['no_answer']} without an answer; {f.get('not_flown', 0)} more could not be flown. The ideal observer is "
        f"known in {f['ideal_observer_known']}.",
        "",
        "| figure | measured | aim |",
        "|---|---|---|",
        *(f"| {name} | {value} | {aim} |" for name, value, aim in rows),
    ]
    if brief:
        return "\n".join(lines)
    lines += ["", "| effect | named first | median error |", "|---|---|---|"]
    for name, share in f["by_effect"].items():
        error = p["error_by_effect"].get(name, {}).get("median")
        lines.append(f"| {name} | {percent(share)} | {_number(error, '{:.1%}')} |")
    lines += ["", "| confidence said | names | right |", "|---|---|---|"]
    lines += [f"| {b['said']:.2f} | {b['n']} | {b['right']:.2f} |" for b in f["confidence"]["bins"]]
    lines += [
        "",
        "| case | what went wrong | true (strength) | said (confidence) | groups | nats |",
        "|---|---|---|---|---|---|",
    ]
    for row in f["failures"]:
        true = ", ".join(f"{n} ({u:.2f})" for n, u in row["strength"].items()) or "nothing"
        said = ", ".join(_said(e) for e in row["said"]) or "nothing"
        groups = "; ".join(" = ".join(g) for g in row["indistinguishable"])
        each = [n for n in row["nats_of_each"].values() if n is not None]
        nats = ", ".join(f"{n:.0f}" for n in each) if each else "" if row["nats"] is None else f"{row['nats']:.0f}"
        lines.append(f"| {row['case']} | {row['why']} | {true} | {said} | {groups} | {nats} |")
    return "\n".join(lines)


def _said(effect: dict[str, Any]) -> str:
    confidence = effect["confidence"]
    return f"{effect['name']} ({confidence:.2f})" if isinstance(confidence, float) else str(effect["name"])


def report(study: Study, *, write_docs: bool = False, ideal: Ideal = "all") -> str:
    """Score a study: figures into OUT/score.json, and the table; `write_docs` publishes both."""
    found = figures(outcomes(study, ideal=ideal))
    truths = [read(study.truth(c)) for c in study.cases()]
    found["not_flown"] = sum(any(not q["flown"] for q in t.get("quality", {}).values()) for t in truths)
    found["study_seed"] = truths[0].get("study_seed") if truths else None
    world = truths[0].get("world", "home") if truths else "home"
    write(study.folder / "score.json", found)
    text = table(found)
    if write_docs:
        begin, end, file = MARKS[world]
        write(DOCS / file, found)
        first, _, rest = f"Seed {found['study_seed']}. {table(found, brief=True)}".partition("\n")
        shown = f"{textwrap.fill(first, 118)}\n{rest}"
        page = (DOCS / "concealed.md").read_text()
        before, _, rest = page.partition(begin)
        _, _, after = rest.partition(end)
        (DOCS / "concealed.md").write_text(f"{before}{begin}\n\n{shown}\n\n{end}{after}")
    return text
