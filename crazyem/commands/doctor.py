"""`crazyem doctor FILE...`: find faults in recordings; --fix writes new files with lossless repairs."""

import argparse
import math
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

from crazyem.commands.batch import counted, on_files, processes
from crazyem.commands.files import find, read_options, targets
from crazyem.commands.merge import merge_findings
from crazyem.commands.output import Report, Result
from crazyem.errors import DataError, UsageError
from crazyem.recordings import Finding, Grade, ReadOptions, Recording, open_recording
from crazyem.recordings.registry import open_parts, to_be_parted

_TEXT_WIDTH = 110
_SHOWN_INTERVALS = 4  # most intervals shown per finding
_WORST_FIRST = sorted(Grade, key=lambda grade: grade.rank)


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    from crazyem.doctor.duplicates import find_duplicates

    report = Report(arguments)
    if arguments.output is not None and not arguments.fix:
        raise UsageError("-o is where --fix writes; without --fix nothing is written.")
    files = find(arguments.files, mapping=arguments.map)
    options = read_options(arguments)
    outputs: list[Path | None] = [None] * len(files.found)
    if arguments.fix:
        outputs = [*targets(files.found, arguments.output, ".fixed.mcap", force=arguments.force)]
    several = len(files.found) > 1
    jobs = processes(arguments.jobs, len(files.found))
    rests = ((options, None if o is None else str(o), arguments.force, arguments.parts, jobs, several) for o in outputs)
    on_files(arguments, report, files, diagnose, rests, apart=True)
    duplicates = find_duplicates([r.detail for r in report.results if r.detail is not None])
    for duplicate in duplicates:
        report.say("\n" + text_of(duplicate.finding()))
    if several or files.skipped:
        grades = [r.data.get("grade") for r in report.results if not r.error]
        names = [*(str(g) for g in _WORST_FIRST), "sound"]
        graded = ", ".join(f"{n} {g}" for g in names if (n := grades.count(g)))
        counts = counted(report.results, files.skipped)
        report.say(f"\nrecordings by their worst finding: {graded}; {counts}")
    code = report.close(duplicates=[d.to_dict() for d in duplicates], skipped_files=files.skipped)
    if code == 0 and arguments.strict and any(r.data.get("grade") == str(Grade.UNUSABLE) for r in report.results):
        return DataError.exit_code
    return code


def diagnose(
    path: str, options: ReadOptions, output: str | None, force: bool, parts: bool, jobs: int, several: bool
) -> Result:
    """Examine one file. Raises as `open_recording`, and UsageError if the repaired file cannot be written."""
    from crazyem.doctor import examine
    from crazyem.doctor.duplicates import fingerprint

    if output is None and to_be_parted(path, asked=parts, jobs=jobs):
        source, start, end, found = "", math.inf, -math.inf, []
        for part in open_parts(path, options):
            source = part.source
            # a slow signal may have no sample in a part; this is no finding
            signals = {name: array for name, array in part.signals.items() if array.time.size}
            start = min([start, *(float(array.time.min()) for array in signals.values())])
            end = max([end, *(float(array.time.max()) for array in signals.values())])
            found.append(examine(replace(part, signals=signals)))
        findings = merge_findings(found)
        return _result(path, source, max(end - start, 0.0), findings, {}, [], None)
    recording = open_recording(path, options)
    findings = examine(recording)
    detail = fingerprint(recording) if several else None
    fixed: dict[str, Any] = {}
    lines: list[str] = []
    if output is not None:
        fixed, lines = _repair(recording, findings, output, force)
    return _result(path, recording.source, recording.duration, findings, fixed, lines, detail)


def _repair(
    recording: Recording, findings: tuple[Finding, ...], output: str, force: bool
) -> tuple[dict[str, Any], list[str]]:
    """Apply the lossless repairs and write the file; without such repairs no file is written."""
    from crazyem.doctor.fix import apply_fixes
    from crazyem.recordings.mcap.signals import write_recording

    wanted = [f for f in findings if f.fix is not None]
    repaired, applied = apply_fixes(recording, findings)
    # compare by value: a finding may come back as an equal, but different object
    done = [_key(f) for f in applied]
    left = [f for f in wanted if _key(f) not in done]
    result: dict[str, Any] = {
        "output": None,
        "applied": [f.to_dict() for f in applied],
        "not_applied": [f.to_dict() for f in left],
    }
    lines = [f"applied: {_what(f)}" for f in applied]
    lines += [f"not applied (settled by another repair, or no cure): {_what(f)}" for f in left]
    if applied:
        write_recording(repaired, output, replace=force)
        result["output"] = output
        lines.append(f"written: {output}")
    else:
        lines.append("nothing to repair without loss; no file was written")
    return result, lines


def _key(finding: Finding) -> tuple[Any, ...]:
    fix = finding.fix
    return (finding.check, finding.signal, finding.text, None if fix is None else (fix.kind, fix.signals, fix.factor))


def _what(finding: Finding) -> str:
    fix = finding.fix
    how = "" if fix is None else f" ({fix.kind} of {', '.join(fix.signals)})"
    return f"{finding.check}{how}: {finding.text}"


def _result(
    path: str, source: str, duration: float, findings: tuple[Finding, ...], fixed: dict[str, Any], lines: list[str],
    detail: Any,
) -> Result:  # fmt: skip
    grade = next((g for g in _WORST_FIRST if any(f.grade is g for f in findings)), None)
    data: dict[str, Any] = {
        "source": source,
        "duration_s": duration,
        "grade": "sound" if grade is None else str(grade),
        "findings": [f.to_dict() for f in findings],
    }
    if fixed:
        data["fixed"] = fixed
    counts = ", ".join(f"{n} {g}" for g in _WORST_FIRST if (n := sum(f.grade is g for f in findings)))
    head = f"{path}: {source}, {duration:.2f} s: {counts or 'nothing found'}"
    blocks = [head, *(text_of(f) for g in _WORST_FIRST for f in findings if f.grade is g)]
    blocks += [_wrapped(line, "  ") for line in lines]
    return Result(path, data, "\n".join(blocks), detail=detail)


def text_of(finding: Finding) -> str:
    """A finding for people: grade, check, signal and time; then text, evidence and advice."""
    where = f" {finding.signal}" if finding.signal else ""
    lines = [f"  {str(finding.grade).upper():<9} {finding.check}{where}{_when(finding)}", _wrapped(finding.text)]
    if finding.evidence:
        lines.append(_wrapped("evidence: " + ", ".join(f"{k} {v:.6g}" for k, v in finding.evidence.items())))
    if finding.advice:
        lines.append(_wrapped("advice: " + finding.advice))
    if finding.fix is not None:
        lines.append(_wrapped(f"--fix can repair it: {finding.fix.kind} of {', '.join(finding.fix.signals)}"))
    return "\n".join(lines)


def _when(finding: Finding) -> str:
    intervals = finding.intervals
    if not intervals:
        return ""
    shown = ", ".join(f"{a:.3f}" if a == b else f"{a:.3f} to {b:.3f}" for a, b in intervals[:_SHOWN_INTERVALS])
    more = f" and {len(intervals) - _SHOWN_INTERVALS} more" if len(intervals) > _SHOWN_INTERVALS else ""
    return f", at {shown} s{more}"


def _wrapped(text: str, indent: str = " " * 12) -> str:
    return textwrap.fill(
        text, _TEXT_WIDTH, initial_indent=indent, subsequent_indent=indent + "  ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
