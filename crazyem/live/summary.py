"""The summary of a flight, a replay or a watch: JSON for programs (names are an interface), text for people."""

import errno
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.errors import UsageError
from crazyem.estimation.result import Estimate
from crazyem.live.history import History
from crazyem.notebook import finite


def build_summary(
    *,
    log: str | None,
    vehicle: str,
    estimate: Estimate,
    history: History,
    update_seconds: Sequence[float],
    received: int,
    lost: int,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The summary object.

    Args:
        log: path of the recording.
        update_seconds: cost of each update, s.
        received, lost: log packets (live) or samples (foreign recordings).
        extra: further keys, such as the controller, the seed or the URI.
    """
    ms = 1e3 * np.asarray(update_seconds, dtype=float)
    rms, height = history.before_and_after()
    return {
        "log": log,
        "vehicle": vehicle,
        "estimates": estimate.to_json(),
        "pushes": [p.to_json() for p in history.pushes],
        "guard": history.guard or None,
        "steps": [step.to_json() for step in history.steps],
        "faults": [fault.to_json() for fault in history.faults],
        "monitored_s": history.monitored,
        "updates": estimate.updates,
        "update_ms": {
            "median": float(np.median(ms)) if ms.size else None,
            "p99": float(np.percentile(ms, 99)) if ms.size else None,
        },
        "samples": {"received": received, "lost": lost},
        "tracking_rms_m": rms,
        "height_error_m": height,
        "noise": dict(estimate.noise),
        "converged": estimate.converged,
        **(extra or {}),
        "notices": list(history.notices),
    }


def write_json(summary: Mapping[str, Any], path: str) -> None:
    """Write the summary to a file, or to standard output for '-'. Raises UsageError: the file cannot be written."""
    text = json.dumps(finite(summary), indent=2, allow_nan=False) + "\n"
    if path == "-":
        sys.stdout.write(text)
        return
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as e:
        raise UsageError(f"cannot write {path}: {e.strerror}.") from None


def check_writable(path: str | None) -> None:
    """Check before the flight that a result can be written after it.

    Raises: UsageError: the file cannot be opened for writing.
    """
    if path is None or path == "-":
        return
    target = Path(path)
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if target.exists() and not target.is_file():
            return  # a device or a pipe: opening it may block
        existed = target.exists()
        with target.open("ab"):  # only opening tests permissions and the file system reliably
            pass
        if not existed:
            target.unlink()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise UsageError(f"cannot write {path}: {why}.") from None


def text_summary(summary: Mapping[str, Any], estimate: Estimate) -> str:
    """A few lines for the terminal."""
    lines = [str(estimate)]
    lines += [
        f"mass changed at {s['time']:.2f} s: {s['before_kg']:.4g} -> {s['after_kg']:.4g} kg"
        for s in summary.get("steps", ())
        if s["real"]
    ]
    pushes = summary["pushes"]
    if pushes:
        unverified = sum(not p["verified"] for p in pushes)
        lines.append(f"pushes: {len(pushes)} parameter writes, {unverified} not confirmed")
    lines += guard_lines(summary.get("guard"))
    received, lost = summary["samples"]["received"], summary["samples"]["lost"]
    ms = summary["update_ms"]
    cost = f", {ms['median']:.2f} ms each (99 %: {ms['p99']:.2f} ms)" if ms["median"] is not None else ""
    lines.append(f"updates: {summary['updates']}{cost}; packets: {received} received, {lost} lost")
    for key, label, sign in (
        ("height_error_m", "mean height error", "+"),
        ("tracking_rms_m", "tracking error, rms", ""),
    ):
        before, after = summary[key]["before_push"], summary[key]["after_push"]
        if before is not None:
            then = f", {after:{sign}.3f} m after pushing" if after is not None else ""
            lines.append(f"{label}: {before:{sign}.3f} m{then}")
    lines += [f"note: {n}" for n in summary["notices"]]
    return "\n".join(lines)


def guard_lines(guard: Mapping[str, Any] | None) -> list[str]:
    """Lines about the guard: writes of a dry run, reverts, and the reason if nothing was pushed."""
    if not guard:
        return []
    decisions = guard["decisions"]
    lines = []
    if guard["mode"] == "dry run":
        values = {name: value for d in decisions if d["action"] == "would write" for name, value in d["writes"]}
        would = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
        lines.append(f"dry run: nothing was written{'; would have ended with ' + would if would else ''}")
    reverts = [d for d in decisions if d["action"] == "revert"]
    lines += [f"taken back at {d['time']:.1f} s: {d['reason']}" for d in reverts]
    held = [d for d in decisions if d["action"] == "hold"]
    if held and not any(d["action"] in ("write", "would write") for d in decisions):
        lines.append(f"nothing was pushed: {held[-1]['reason']}")
    return lines


def live_line(phase: str, seconds: float, estimate: Estimate | None, *, lost: int, pushes: int) -> str:
    """One line per second: phase, mass and inertia with 95 % half widths, losses, pushes."""
    head = f"{phase:<13.13} {seconds:6.1f} s"
    if estimate is None:
        return f"{head}  no estimate yet"
    parts = []
    for name, unit, scale in (("mass", " g", 1e3), ("Ixx", "", 1e6), ("Iyy", "", 1e6), ("Izz", " e-6 kg m2", 1e6)):
        p = estimate[name]
        parts.append(f"{name} {interval_text(p.value, p.ci95, p.identifiable, scale=scale)}{unit}")
    return f"{head}  {'  '.join(parts)}  lost {lost}  pushes {pushes}"


def interval_text(value: float, ci95: Sequence[float], identifiable: bool, *, scale: float) -> str:
    """A value with the half width of its interval, both times `scale`; with a question mark if not identifiable."""
    half = (ci95[1] - ci95[0]) / 2 * scale
    width = f"{half:.2f}" if half < 99 else ">99"  # keeps the line within a terminal
    return f"{value * scale:.2f}+-{width}{'' if identifiable else '?'}"
