"""The HTML report: whole, self-contained, escaped, and made from any document of that shape."""

import base64
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from html_pages import Page
from hypothesis import given
from hypothesis import strategies as st
from made_diagnosis import document, pictures

from crazyem.diagnosis.document import Compared, accused_pictures
from crazyem.diagnosis.locating.locate import Disturbance, Finding, Located
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.prediction.horizon import HORIZONS, Windows
from crazyem.diagnosis.report import Series, write_report
from crazyem.diagnosis.report.content import text_of
from crazyem.diagnosis.report.html import report
from crazyem.diagnosis.report.pictures import data_uri, thinned
from crazyem.diagnosis.report.verdict import claim, quantity, span, verdict
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE

HOSTILE = "<script>alert('x')</script>\x1b[31m & \"quoted\" $\\frac{1}"


def checked(text):
    """The words of a page and its pictures, which are part of it."""
    page = Page(text)
    assert all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    return " ".join(page.words), page.links


def test_a_report_says_everything_that_the_document_has(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(path, document(), pictures())
    text, images = checked(path.read_text(encoding="utf-8"))
    assert len(images) == 3
    for wanted in (
        "The model lacks thrust scale (or payload, which this flight cannot tell from it) (0.6123 ± 0.0041; 99 % sure) "
        "and linear drag (x 11.2, y 10.8, z 2.1 mN s/m; 93 % sure).",
        "Errors 0.5 s ahead on flight it has not seen: position 0.77 m to 34 mm, -96 %; velocity -96 %; "
        "attitude ±0 %; body rate ±0 %.",
        "0.6123 ± 0.0041", "0.6040 to 0.6205", "11.20 ± 0.90 mN s/m", "9.40 to 13.00 mN s/m", "body z", "3.2 to 41 s",
        "-82 mN", "812", "ground effect", "battery sag with time", "cannot be told apart", "weigh the drone",
        "mass against thrust", "voltage was withheld", "500 ms", "What was left free",
        "input delay delay -2.60 ± 0.60 ms", "rotor clock delay, circle_fast_1.csv 12.3 ± 1.1 ms",
    ):  # fmt: skip
        assert wanted in text, wanted
    assert list(tmp_path.iterdir()) == [path]
    for unwanted in ("nats", "p =", "_", "["):  # words, and numbers that people use
        assert unwanted not in text.replace("circle_fast_1", "").replace("figure8_2", "").replace(" [", " "), unwanted


def test_the_terminal_says_what_the_page_says() -> None:
    page, _ = checked(report(document(), {}))
    shown = text_of(document())
    for line in shown.splitlines():
        for part in re.split(r"  +|- ", line.strip()):
            assert part.rstrip(":") in page, part
    assert "What was left free" not in shown  # of the page alone, as the candidates are


def test_every_picture_is_a_picture_with_its_data() -> None:
    for series in pictures().values():
        image = base64.b64decode(data_uri(series).split(",")[1])
        root = ElementTree.fromstring(image)
        assert root.tag.endswith("svg")
        assert image.count(b"<path") > 10
    assert data_uri(pictures()["force"]) == data_uri(pictures()["force"])  # a replay writes the same file


def test_a_document_without_a_mismatch_says_so() -> None:
    text, _ = checked(report({**document(), "mismatch": False, "effects": []}, {}))
    assert "Errors 0.5 s ahead" not in text
    assert "agree as far as this flight can show" in text
    assert "None of the effects of the catalogue is claimed" in text


def test_what_none_explains_is_said() -> None:
    assert "none of the known effects explains it" in verdict({"mismatch": True, "effects": []})


@pytest.mark.parametrize(
    ("confidences", "groups", "sentence"),
    [
        ((0.01,), [], "differ, and none of the known effects explains it; nearest: linear drag (1 % sure)."),
        ((0.95, 0.01), [], "The model lacks linear drag (95 % sure), and something else, of which the nearest is wind"),
        ((0.01,), [["linear_drag", "wind"]], "The model lacks linear drag (or wind, which this flight cannot tell"),
        ((0.1,), [], "The model lacks linear drag (10 % sure)."),
    ],
)
def test_what_is_improbable_is_not_said_to_be_lacking(
    confidences: tuple[float, ...], groups: list[list[str]], sentence: str
) -> None:
    """A name that hardly explains anything is the nearest, not the answer; one of a group may be any of it."""
    names = ("linear_drag", "wind")
    effects = [{"name": n, "confidence": c} for n, c in zip(names, confidences, strict=False)]
    assert sentence in verdict({"mismatch": True, "effects": effects, "indistinguishable": groups})


def test_a_model_that_predicts_something_worse_is_never_said_to_be_lacking() -> None:
    found = document()
    found["fit"]["held_out"]["worse"] = [
        {"quantity": "attitude", "horizon_s": h, "standard_errors": 3.0} for h in (0.1, 0.5)
    ]
    said = claim(found)
    assert said.startswith("Simulation and flight differ; the nearest explanation is thrust scale (or payload,")
    assert said.endswith("that predicts attitude 0.1 and 0.5 s ahead worse than before on flight it has not seen.")
    assert "lacks" not in said
    assert "0.01 → 0.01 (±0 %) worse" in checked(report(found, {}))[0]
    found["fit"]["held_out"], found["fit"]["train"]["worse"] = {}, [{"quantity": "velocity", "horizon_s": 0.1}]
    assert "velocity 0.1 s ahead worse than before on the flight it was fitted to." in claim(found)
    found["fit"]["held_out"] = {**document()["fit"]["held_out"], "worse": []}  # flight held out is what judges
    assert claim(found).startswith("The model lacks")


def test_a_voltage_that_was_not_recorded_is_in_the_sentence_where_that_is_all() -> None:
    def sag(name: str) -> dict[str, Any]:
        return {"name": "battery_sag", "confidence": 0.9, "parameters": {name: {"value": -0.004, "unit": "1/s"}}}

    drag = {"name": "linear_drag", "confidence": 0.9, "parameters": {"x": {"value": 0.02, "unit": "N s/m"}}}
    alone, measured, both = (
        claim({"mismatch": True, "effects": e})
        for e in ([sag("gain_per_second")], [sag("gain_per_volt")], [sag("gain_per_second"), drag])
    )
    assert alone.startswith(
        "The model lacks battery sag with time (-0.004 1/s; 90 % sure); no battery voltage was recorded"
    )
    assert "no battery voltage" not in measured + both


@pytest.mark.parametrize(
    ("value", "unit", "sd", "said", "ends"),
    [
        (0.061772, "s", 0.002244, "61.8 ± 2.2 ms", "56.5 to 67.1 ms"),
        (1.6161e-5, "kg m^2", 1.3e-7, "16.16 ± 0.13 mg m²", "15.90 to 16.40 mg m²"),
        (0.0051, "kg", None, "5.1 g", "5 to 5.2 g"),
        (-0.3, "1/V", 0.01, "-0.300 ± 0.010 1/V", "-0.320 to -0.280 1/V"),
        (0.0, "m", 2e-5, "0 ± 20 µm", "-40 to 40 µm"),
        (None, "m", None, "–", "– to 0.01 m"),
        (12.0, "", 0.0, "12", "11 to 13"),
    ],
)
def test_numbers_have_the_prefix_and_the_figures_that_suit_them(
    value: float | None, unit: str, sd: float | None, said: str, ends: str
) -> None:
    both = {
        "s": (0.056466, 0.067078), "kg m^2": (1.59e-5, 1.64e-5), "kg": (0.005, 0.0052), "1/V": (-0.32, -0.28),
        "m": (None, 0.01) if value is None else (-4e-5, 4e-5), "": (11.0, 13.0),
    }[unit]  # fmt: skip
    assert quantity(value, unit, sd) == said
    assert span(list(both), value, unit, sd).replace("10 mm", "0.01 m") == ends.replace("10 mm", "0.01 m")


def test_a_simulated_flight_is_compared_signal_by_signal() -> None:
    signals = {"body_rate": {"rms": 0.1234, "unit": "rad/s", "largest": 1.5}}
    against = {"simulated": "sim.mcap", "seconds": 12.0, "signals": signals}
    text, _ = checked(report({**document(), "against": against}, {}))
    assert "sim.mcap: 12 s of the same mission" in text
    assert "body rate 0.123 rad/s 1.5 rad/s" in text


def test_what_is_left_over_is_told_by_place_or_as_nothing() -> None:
    nothing = report({**document(), "unexplained": {"found": False, "nats": 1.0, "where": []}}, {})
    assert "Nothing is left over after the fit beyond the noise." in checked(nothing)[0]
    place = {"signal": "torque", "axis": "x", "regime": "fast", "interval": [1.0, 2.0], "effect_size": 9e-5, "sd": 2e-5,
             "unit": "N m"}  # fmt: skip
    left = {"found": True, "nats": 80.0, "explained_share": 0.5, "where": [place]}
    text, _ = checked(report({**document(), "unexplained": left}, {}))
    assert "signal axis regime when size torque x fast 1 to 2 s 90 ± 20 µN m" in text
    assert "explain 50 % of the structure" in text
    nobody = claim({**document(), "unexplained": left, "effects": []})
    assert nobody.endswith("; the strongest of what is left is torque x, fast: 90 µN m.")
    closed = {**document()["fit"], "gap_closed": {"position": 0.987, "attitude": None}}
    assert "took away: position 99 %." in checked(report({**document(), "fit": closed}, {}))[0]


def test_text_of_recordings_is_escaped() -> None:
    """In every place where a text can stand, and in pictures, where $ would begin a formula."""

    def poisoned(value: Any) -> Any:
        if isinstance(value, dict):
            return {(HOSTILE if k in ("x", "scale") else k): poisoned(v) for k, v in value.items()}
        if isinstance(value, list):
            return [poisoned(v) for v in value]
        return HOSTILE if isinstance(value, str) else value

    series = Series(HOSTILE, np.arange(5.0), {HOSTILE: np.arange(5.0), "b": np.ones(5)}, HOSTILE, HOSTILE)
    text = report(poisoned(document()), {HOSTILE: series, "again": series})
    assert "<script" not in text
    assert "\x1b" not in text
    shown, images = checked(text)
    assert "<script>alert('x')</script>" in shown
    assert len(images) == 2


def test_a_picture_of_unequal_lengths_is_refused() -> None:
    with pytest.raises(ValueError, match="line 'a' has 3 values for 5 x"):
        data_uri(Series("t", np.arange(5.0), {"a": np.ones(3)}))


def test_long_lines_are_thinned_and_keep_their_peaks() -> None:
    x = np.linspace(0, 100, 100_000)
    y = np.sin(x)
    y[54_321] = 7.0
    y[1000:3000] = np.nan
    some, kept = thinned(x, y)
    assert some.size <= 2000
    assert np.nanmax(kept) == 7.0
    assert (np.diff(some) > 0).all()


def test_a_folder_that_is_not_there_is_an_error_of_the_user(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot write"):
        write_report(tmp_path / "none" / "r.html", document())


anything = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
KEYS = (
    "left_free", "mismatch", "where", "effects", "indistinguishable", "would_separate", "unexplained", "fit",
    "not_identifiable",
)  # fmt: skip


@given(st.dictionaries(st.sampled_from((*KEYS, "ranking", "notices", "recordings", "vehicle", "against")), anything))
def test_no_document_breaks_it(found: dict[str, Any]) -> None:
    text = report(found, {})
    checked(text)
    text_of(found)
    assert re.search(r"<h1>.+</h1>", text)


@pytest.mark.parametrize(
    ("onset", "said"),
    [
        (None, "lacks rotor fault of rotor 3 (thrust 0.9; 48 % sure)."),
        (7.5, "lacks rotor fault of rotor 3 since 7.50 s (thrust 0.9; 48 % sure)."),
    ],
)
def test_which_rotor_and_since_when_is_in_the_sentence(onset: float | None, said: str) -> None:
    chosen = {"rotor": {"value": 3, "chosen": True}, "onset_time": {"value": onset, "chosen": True}}
    fault = {"name": "rotor_fault", "confidence": 0.48, "parameters": {"scale": {"value": 0.9}, **chosen}}
    assert said in verdict({"mismatch": True, "effects": [fault]})
    grouped = verdict({"mismatch": True, "effects": [fault], "indistinguishable": [["rotor_fault", "payload"]]})
    assert "of rotor 3" in grouped
    assert "(or payload, which this flight cannot tell from it)" in grouped


def finding(signal: str, axis: str, unit: str, variable: str = "") -> Finding:
    return Finding(signal, axis, "somewhere", variable, (3.0, 5.0), 1e-3, 1e-4, unit, 40.0, 1e-9)


def test_whatever_is_accused_is_pictured_the_strongest_first() -> None:
    """Attitude z was accused once, and six plots showed forces and torques."""
    names = (*(f"{s} {a}" for s in ("force", "torque", "velocity", "attitude") for a in "xyz"), "force world x")
    time = np.linspace(0.0, 10.0, 11)
    series = np.outer(np.sin(time), np.ones(len(names)))
    missing = Disturbance(time, names, ("rad",) * len(names), series, np.full_like(series, 0.01))
    accused = [
        finding("attitude", "z", "rad", "time"), finding("attitude", "z", "rad"), finding("force", "world x", "N"),
        finding("body_rate", "y", "rad/s", "frequency"), finding("velocity", "x", "m/s"), finding("torque", "x", "N m"),
    ]  # fmt: skip
    before = Located((accused[0], accused[2]), (missing,), {})
    found: Any = SimpleNamespace(
        before=before, after=before, effects=(), mismatch=True, unexplained=Unexplained(tuple(accused), 0.0)
    )
    drawn = accused_pictures(found, None)
    assert list(drawn) == ["attitude z", "force world x", "body_rate y", "velocity x"]
    assert drawn["attitude z"].shaded == ((3.0, 5.0),)
    assert drawn["attitude z"].title == "Missing from the model: attitude z (band: two standard deviations)"
    assert drawn["body_rate y"].title.startswith(
        "Missing from the model: torque y"
    )  # no states, so what turns it is shown
    assert set(drawn["force world x"].lines) == {"before"}
    run = np.zeros((4, 3, 13))
    run[:, 0, 11] = 0.5
    at = Windows(np.arange(4), np.arange(16.0).reshape(4, 4), np.zeros((4, 3, 13)), HORIZONS)
    shown = accused_pictures(found, Compared(at, (run, 0.1 * run)))["body_rate y"]
    assert shown.title == "Error of the body rate y, 10 ms ahead"
    assert list(shown.lines["before"]) == [0.5] * 4
    agreeing: Any = SimpleNamespace(**{**vars(found), "mismatch": False, "unexplained": Unexplained((), 0.0)})
    assert accused_pictures(agreeing, None) == {}


def test_effects_and_parameters_have_words_without_program_text() -> None:
    for effect in CATALOGUE.values():
        values = {p.name: (p.chosen or (1.0,))[0] for p in effect.parameters}
        for text in (effect.description({}), effect.description(values), *(p.description for p in effect.parameters)):
            assert re.fullmatch(r"[a-zA-Z0-9. ]+", text), text
    assert CATALOGUE["measurement_delay"].description({"delay": 0.01, "streams": ("state", "gyro")}) == (
        "measurement delay of the state estimate and gyro"
    )


def test_the_report_names_no_effect() -> None:
    for path in (Path(__file__).parents[2] / "crazyem" / "diagnosis" / "report").iterdir():
        if path.suffix in (".py", ".html"):
            text = path.read_text(encoding="utf-8")
            assert not [n for n in CATALOGUE if "_" in n and re.search(rf"\b({n}|{n.replace('_', ' ')})\b", text)]
