"""What `info` and `doctor` say of every shared recording, held against a second look at the raw files without crazyem.

`expectations/<set>.json` holds, for each recording, reviewed facts and findings. A fact is a number that the plain code
in `second_look.py` derives from the file; a finding names the facts that its numbers must agree with, how they were had
(`how`), or why it was not verified. `not_found` are defects that the second look shows and the doctor does not name.
The test fails if either look moves away from what was reviewed.
"""

import json
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from second_look import Facts, second_look

from crazyem.cli import main

HERE = Path(__file__).with_name("expectations")
SETS = {
    name: json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
    for name in ("crazypad", "sysid", "nanobench", "nanodrone", "real_firmware")
}
FILES = sorted(f"{name}/{file}" for name, content in SETS.items() for file in content["recordings"])
QUICK = (
    "crazypad/motor__cut_propeller_M3_1mm_46mm__E8_log01",
    "crazypad/controller__normal_flight__E9_log00",
    "nanobench/B2_circle_fast_rep3.csv.gz",
    "nanodrone/raw/square_run1.csv.gz",
    "nanodrone/processed/random_run1.csv.gz",
    "real_firmware/lee_34g_mass_pushed_midflight.csv.gz",
)


look = lru_cache(maxsize=1)(second_look)


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict:
    """The JSON that a command prints about one recording."""
    assert main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)["files"][0]


def compare(findings: list[dict], expected: list[dict], facts: Facts) -> Iterator[str]:
    """What differs between findings and those expected: none missing, none too many, the numbers as the facts are."""
    left = list(findings)
    for wanted in expected:
        match = [
            one
            for one in left
            if all(one[key] == wanted[key] for key in ("check", "grade", "signal")) and wanted["says"] in one["text"]
        ]
        what = f"{wanted['check']} ({wanted['grade']}) of {wanted['signal'] or 'the recording'}, {wanted['says']!r}"
        if not match:
            yield f"not found: {what}"
            continue
        left.remove(match[0])
        for key, (fact, tolerance) in wanted.get("evidence", {}).items():
            if match[0]["evidence"][key] != pytest.approx(facts[fact], abs=tolerance):
                yield f"{what}: {key} is {match[0]['evidence'][key]:.6g}, {fact} is {facts[fact]:.6g} +- {tolerance:g}"
        if "more_than_one" in wanted and not facts[wanted["more_than_one"]] > 1.0:
            yield f"{what}: {wanted['more_than_one']} is {facts[wanted['more_than_one']]:.6g}"
    for one in left:
        yield f"not expected: {one['check']} ({one['grade']}) of {one['signal'] or 'the recording'}: {one['text']}"


def expected_of(name: str) -> dict:
    folder, file = name.split("/", 1)
    return SETS[folder]["recordings"][file]


def differences(root: Path, name: str, capsys: pytest.CaptureFixture[str]) -> Iterator[str]:
    """All that differs between the file, what was reviewed, and what the commands say."""
    expected, path = expected_of(name), root / name
    facts = look(path)
    for key, value in expected["facts"].items():
        if facts[key] != pytest.approx(value, rel=1e-4, abs=1e-9):
            yield f"second look: {key} is {facts[key]:.6g}, was {value:.6g}"
    told = said(capsys, "info", str(path))
    main_signal = next(one for one in told["signals"] if one["name"] in ("position", "body_rate"))
    told = told | told["envelope"] | main_signal
    for key, (fact, tolerance) in expected["info"].items():
        if told[key] != pytest.approx(facts[fact], abs=tolerance):
            yield f"info: {key} is {told[key]:.6g}, {fact} is {facts[fact]:.6g} +- {tolerance:g}"
    diagnosis = said(capsys, "doctor", str(path))
    if diagnosis["grade"] != expected["grade"]:
        yield f"doctor: {diagnosis['grade']}, not {expected['grade']}"
    yield from compare(diagnosis["findings"], expected["findings"], facts)


@pytest.mark.parametrize("name", QUICK)
def test_reviewed(shared_recordings, capsys, name):
    assert list(differences(shared_recordings, name, capsys)) == []


def test_reviewed_recordings_are_there(shared_recordings):
    """The folder may hold more than was reviewed."""
    assert [name for name in FILES if not (shared_recordings / name).is_file()] == []


# Claims of the nanobench publisher that are wrong in every flight: how a finding of each begins.
CLAIMS = {
    "degrees": ("angles", "euler", "it was in radians"),
    "pitch": ("angles", "euler@onboard", "the sign of pitch is inverted"),
    "world rate": ("rates", "body_rate@vicon", "in the body frame already"),
    "m/s^2": ("forces", "acceleration@onboard", "it is in g, not m/s^2"),
    "27 g": ("weight", "", "27.0 g are claimed"),
    "measured at 100 Hz": ("interpolated", "body_rate", "lie on straight lines"),
}


def untold(root: Path, name: str, capsys: pytest.CaptureFixture[str]) -> Iterator[str]:
    """What the doctor does not say of a nanobench flight with the corrections off, as published."""
    expected = expected_of(name)
    found = said(capsys, "doctor", str(root / name), "--as-published")["findings"]
    for claim, (check, signal, words) in CLAIMS.items():
        seen = [f for f in found if f["check"] == check and f["signal"] == signal and words in f["text"]]
        if len(seen) != 1 and claim not in expected.get("cannot_tell", {}):
            yield f"not found wrong: {claim}"
    if not any(f["check"] == "lag" for f in found) and "lag" not in expected["cannot_tell"]:
        yield "no lag"
    wrong = [
        f for f in found if f["check"] in ("angles", "rates") or (f["check"], f["grade"]) == ("forces", "unusable")
    ]
    yield from compare(wrong, expected["as_published"], look(root / name))


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in FILES if n not in QUICK or n.startswith("nanobench/")])
def test_every_recording_as_reviewed_and_every_wrong_claim_of_its_publisher(shared_recordings, capsys, name):
    """With the corrections off every wrong claim is found; with them on, none of those that they correct."""
    if name not in QUICK:
        assert list(differences(shared_recordings, name, capsys)) == []
    if name.startswith("nanobench/"):
        assert list(untold(shared_recordings, name, capsys)) == []
        corrected = expected_of(name)["findings"]  # all that is found
        assert not [f for f in corrected if f["check"] in ("angles", "rates") or f["grade"] == "unusable"]


@pytest.mark.slow
def test_processed_runs_are_known_as_pieces_of_the_raw_ones(shared_recordings, capsys):
    """All twelve and no other; where each begins is found here as the shift at which the two x agree best."""
    assert main(["doctor", str(shared_recordings / "nanodrone"), "--jobs", "1", "--json"]) == 0
    duplicates = json.loads(capsys.readouterr().out)["duplicates"]
    assert sorted(Path(d["first"]).name for d in duplicates) == sorted({Path(n).name for n in FILES if "/raw/" in n})
    for one in duplicates:
        raw, cut = (pd.read_csv(one[key])["x"].to_numpy() for key in ("first", "second"))
        misses = [np.abs(raw[k : k + cut.size] - cut).mean() for k in range(raw.size - cut.size + 1)]
        assert Path(one["first"]).name == Path(one["second"]).name
        assert -one["offset_s"] == pytest.approx(0.01 * int(np.argmin(misses)), abs=0.05)
