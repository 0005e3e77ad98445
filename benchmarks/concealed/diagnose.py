"""Runs the diagnosis on every flown case, as a process that gets two recordings and the name of the nominal vehicle.

If the study says so, it gets one recording, without a held-out one. The process works in an empty folder with links to
the recordings, and none of its inputs leads to the truth.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .paths import Study, read, write

DIAGNOSE = (sys.executable, "-m", "crazyem", "diagnose")
TIME_LIMIT = 900.0  # s; a later answer counts as none; needs to be larger on a busy machine


def diagnose_one(
    study: Study, case: str, truth: Mapping[str, Any], command: Sequence[str], limit: float = TIME_LIMIT
) -> dict[str, Any]:
    """The answer file of a case: case, seconds, code, said (last line on standard error), result (the JSON or None)."""
    with tempfile.TemporaryDirectory() as folder:
        link = os.link if _same_disk(study, folder) else os.symlink
        names = []
        for flight in study.given:
            file = study.recording(case, flight)
            names.append(f"{flight}{file.suffix}")
            link(file, Path(folder) / names[-1])
        vehicle, more = truth["platform"], []
        if truth.get("world", "home") != "home":
            vehicle = "drone.toml"
            link(study.vehicle(case), Path(folder) / vehicle)
        mapping = study.mapping(case)
        if mapping is not None:
            link(mapping, Path(folder) / mapping.name)
            more = ["--map", mapping.name]
        apart = [] if study.alone else ["--held-out", names[1]]
        words = [
            *command, names[0], "--vehicle", vehicle, *apart, *more, "--json", "answer.json", "--write-vehicle",
            "fitted.toml",
        ]  # fmt: skip
        begun = time.monotonic()
        try:
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=limit, check=False)
            code, said = done.returncode, done.stderr.strip().splitlines()[-1:]
        except subprocess.TimeoutExpired:
            code, said = -1, [f"no answer after {limit:g} s"]
        seconds = time.monotonic() - begun
        fitted = Path(folder) / "fitted.toml"
        if fitted.is_file():
            study.fitted(case).parent.mkdir(parents=True, exist_ok=True)
            study.fitted(case).write_bytes(fitted.read_bytes())
        try:
            result = json.loads((Path(folder) / "answer.json").read_text())
        except (OSError, ValueError):
            result = None
    return {"case": case, "seconds": round(seconds, 2), "code": code, "said": "".join(said), "result": result}


def _same_disk(study: Study, folder: str) -> bool:
    """Whether hard links to the recordings are possible, which do not show their folder."""
    return os.stat(study.folder).st_dev == os.stat(folder).st_dev


def flown(study: Study) -> list[str]:
    """Cases of which both recordings exist."""
    return [c for c in study.cases() if all(study.recording(c, f).is_file() for f in ("recording", "held_out"))]


def diagnose_all(
    study: Study,
    *,
    command: Sequence[str] | None = None,
    minutes: float = math.inf,
    part: tuple[int, int] = (0, 1),
    limit: float = TIME_LIMIT,
) -> int:
    """Diagnose the cases without an answer; returns their number. Delete an answer to diagnose the case again."""
    begun, asked = time.monotonic(), 0
    for case in flown(study):
        if int(case) % part[1] != part[0] or study.answer(case).is_file():
            continue
        if time.monotonic() - begun > 60.0 * minutes:
            break
        answer = diagnose_one(study, case, read(study.truth(case)), command or DIAGNOSE, limit)
        write(study.answer(case), answer)
        asked += 1
        named = [e["name"] for e in (answer["result"] or {}).get("effects", [])]
        print(f"{case}: {', '.join(named) or 'nothing'} ({answer['seconds']:.1f} s) {answer['said']}", flush=True)
    return asked
