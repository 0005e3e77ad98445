"""Simulator files for scripts and notebooks: convert them, check them with flights, and draw vehicles."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.api.diagnosing import Diagnosis, diagnose
from crazyem.api.inputs import RecordingLike, VehicleLike, recording_of, recordings_of, vehicle_of
from crazyem.diagnosis.prediction.ensemble import Ensemble, ensemble
from crazyem.diagnosis.prediction.predict import recorded
from crazyem.errors import DataError, UsageError
from crazyem.notebook import finite, html_table
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.simulators.constants import NUMBERS
from crazyem.simulators.convert import HORIZON, Conversion, convert, errors_after, load_source, read_text, said
from crazyem.simulators.fields import AGREE, SimulatorFile
from crazyem.simulators.findings import GAUGE, TOLERANCE, FieldFinding, alternatives, field_findings, rescaled
from crazyem.simulators.sampling import MASS_SD, VehicleSample, sample
from crazyem.vehicle import Vehicle


def convert_vehicle(
    source: VehicleLike,
    to: str,
    *,
    template: str | Path | None = None,
    name: str = "",
    suffix: str = "",
    base: VehicleLike | None = None,
    flight: RecordingLike | None = None,
) -> Conversion:
    """Convert a vehicle to a simulator's file, or a simulator's file to a vehicle file.

    Args:
        source: a Vehicle, a preset's name, a vehicle file or a simulator's file.
        to: the format: crazyflow, gym-pybullet-drones, mujoco, gazebo, rotorpy, crazyswarm2, px4-sih, omnidrones, l2f;
            crazyem for a vehicle file.
        template: a file of that format; only the constants in it change.
        name: of the drone, if a file has several.
        suffix: of the output file: ".json" makes rotorpy's dict JSON.
        base: vehicle that gives the values missing in a simulator's file.
        flight: recording on which the costs of omissions are computed; None: a synthetic flight.

    Raises:
        UsageError: no such file, format or drone. FileFormatError: a file cannot be used; names the field.
    """
    lacking = None if base is None else vehicle_of(base)
    vehicle = source if isinstance(source, Vehicle) else load_source(source, base=lacking).vehicle
    text = None if template is None else read_text(str(template))
    recording = None if flight is None else recording_of(flight)
    where = "" if template is None else str(template)
    return convert(vehicle, to, template=text, where=where, name=name, suffix=suffix, flight=recording)


@dataclass(frozen=True, eq=False)
class VehicleCheck:
    """The result of checking a simulator's file with flights.

    Attributes:
        imported: the file. vehicle: its constants; missing values come from `base`.
        diagnosis: of the vehicle on the flights.
        fields: a finding for each field of the file.
        alternatives: corrected constants if the mass, or if the thrust of the file is right; flights give their ratio.
        disagreements: with other files of the same drone.
        corrected: the file with fitted constants.
        errors: after half a second of open-loop flight: "before", "after" (the corrected file), "fitted" (all fitted
            effects) -> quantity -> error.
        judged: names of the flights on which the errors are computed.
    """

    imported: SimulatorFile
    vehicle: Vehicle
    diagnosis: Diagnosis
    fields: tuple[FieldFinding, ...]
    alternatives: tuple[dict[str, Any], ...]
    disagreements: tuple[str, ...]
    corrected: Conversion
    errors: Mapping[str, Mapping[str, float]]
    judged: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether the file agrees with itself, with the other files and with the flights."""
        return not (any(t.off for t in self.fields) or self.imported.contradictions or self.disagreements)

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        document: dict[str, Any] = finite({
            "format": "crazyem-vehicle-check", "version": 1, "file": self.imported.where,
            "simulator": self.imported.format, "name": self.imported.name, "fits": self.fits,
            "fields": [t.to_json() for t in self.fields], "alternatives": list(self.alternatives),
            "contradictions": [c.to_json() for c in self.imported.contradictions],
            "disagreements": list(self.disagreements), "remarks": list(self.imported.remarks),
            "horizon_s": HORIZON, "errors": {k: dict(v) for k, v in self.errors.items()},
            "judged_by": list(self.judged), "omissions": [one.to_json() for one in self.corrected.omissions],
            "diagnosis": self.diagnosis.to_dict(),
        })  # fmt: skip
        return document

    def __str__(self) -> str:
        lines = [
            f"{self.imported.where} ({self.imported.format}): {'fits' if self.fits else 'does not fit'} the flights"
        ]
        lines += [f"  contradiction: {c}" for c in self.imported.contradictions]
        lines += [f"  disagreement: {d}" for d in self.disagreements]
        lines += [f"  {remark}" for remark in self.imported.remarks]
        lines += [f"  {'off' if t.off else '   '} {t}" for t in self.fields if t.known or t.value]
        if self.alternatives:
            lines.append(f"  {GAUGE}")
            for one in self.alternatives:
                numbers = ", ".join(f"{field} {value:.4g}" for field, value in one["fields"].items())
                lines.append(f"    if {one['if']}: {numbers}")
        for words, key in (("before", "before"), ("with the corrected file", "after"), ("with all found", "fitted")):
            lines.append(f"  error after {HORIZON:g} s {words}: {said(self.errors[key])}")
        lines += [f"  not held by this file: {one}" for one in self.corrected.omissions]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [(t.field, t.value, t.fitted, t.sd, t.unit, "off" if t.off else "") for t in self.fields]
        title = f"{self.imported.where}: {'fits' if self.fits else 'does not fit'}"
        return html_table(title, ("field", "in the file", "by flights", "sd", "unit", ""), rows, [])


def check_vehicle(
    file: str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    held_out: RecordingLike | Sequence[RecordingLike] = (),
    name: str | None = None,
    beside: Sequence[str | Path] = (),
    base: VehicleLike | None = None,
    mass: float | None = None,
    candidates: Sequence[str] = (),
    tolerance: float = TOLERANCE,
    jobs: int | None = None,
    options: ReadOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> VehicleCheck:
    """Find wrong constants in a simulator's file, using flights of the drone.

    Args:
        file: simulator's file of any known format.
        recordings, held_out: as for `diagnose`.
        name: of the drone, if the file has several.
        beside: other files of the same drone, to compare with.
        base: vehicle that gives the values missing in the file (default: the vehicle that was flown).
        mass: weighed mass of the whole drone [kg]; None: not weighed.
        candidates: effects to look for; none: the whole catalogue.
        tolerance: relative difference up to which a number may stay.

    Raises:
        UsageError: no such file, or `file` is a vehicle file. FileFormatError: a file cannot be used.
        DataError: a recording cannot be used.
    """
    flown, kept = recordings_of(recordings, options), recordings_of(held_out, options)
    if not flown:
        raise UsageError("a check needs at least one recording.")
    lacking = vehicle_of(base, flown[0])
    source = load_source(file, name=name, base=lacking, strict=False)
    if source.imported is None:
        raise UsageError(f"{file}: this is no simulator's file; diagnose judges vehicle files.")
    others = [load_source(other, name=name, base=lacking, strict=False) for other in beside]
    found = diagnose(flown, source.vehicle, held_out=kept, candidates=candidates, jobs=jobs, progress=progress)
    fitted = found.fitted_vehicle if mass is None else rescaled(found.fitted_vehicle, mass)
    findings = _field_findings(source.imported, source.vehicle, fitted, found.document, tolerance)
    judges = kept or flown
    where, drone = str(file), source.imported.name
    corrected = convert(fitted, source.format, template=source.text, where=where, name=drone, flight=judges[0])
    vehicles = {"before": source.vehicle, "after": corrected.held, "fitted": fitted}
    choices = alternatives(source.imported, fitted, source.vehicle.mass) if mass is None else []
    return VehicleCheck(
        source.imported, source.vehicle, found, tuple(findings), tuple(choices),
        tuple(d for other in others if other.imported for d in disagreements(source.imported, other.imported)),
        corrected, _pooled(judges, vehicles), tuple(r.path for r in judges),
    )  # fmt: skip


def _field_findings(
    imported: SimulatorFile, vehicle: Vehicle, fitted: Vehicle, document: Mapping[str, Any], tolerance: float
) -> list[FieldFinding]:
    return field_findings(
        imported, vehicle, fitted, document["effects"],
        {n["name"]: n["reason"] for n in document["not_identifiable"]},
        looked_for={*(r["name"] for r in document["ranking"]), *(e["name"] for e in document["effects"])},
        tolerance=tolerance,
    )  # fmt: skip


def sample_vehicle(
    vehicle: VehicleLike, count: int = 256, *, seed: int = 0, days: bool = True, mass_sd: float = MASS_SD
) -> VehicleSample:
    """Draw vehicles from the joint posterior in the file of a fitted vehicle.

    Args:
        vehicle: fitted by `diagnose`.
        count: number of vehicles.
        seed: the same seed gives the same vehicles.
        days: whether to add the day-to-day variation of thrust, trim and lag.
        mass_sd: relative standard deviation of the mass, which flights do not identify; 0 for a weighed drone.

    Raises:
        UsageError: no such vehicle, or it has no posterior. DataError: hardly any draw is physically possible.
    """
    return sample(vehicle_of(vehicle), count, seed=seed, days=days, mass_sd=mass_sd)


def predict_ensemble(
    recording: RecordingLike,
    vehicle: VehicleLike,
    *,
    count: int = 256,
    horizon: int = 50,
    step: float | None = None,
    seed: int = 0,
    days: bool = False,
    calibrate: RecordingLike | Sequence[RecordingLike] = (),
    plain: bool = False,
    options: ReadOptions | None = None,
) -> Ensemble:
    """Predict a band from many draws of a fitted vehicle's posterior, from starts all along a flight.

    Args:
        recording: the flight.
        vehicle: with a posterior. count: number of draws.
        horizon: steps ahead. step: s each; None: the recorded samples.
        seed: of the draws.
        days: add day-to-day variation of trim, thrust and lag: far wider, as recorded commands fit their day's trim.
        calibrate: other flights from which disturbances are learned; without them, the band covers constants only.
        plain: use the model alone, without correction by the flight before each start.

    Raises:
        UsageError: no such file, or no posterior. DataError: no complete states, or no flight that is long enough.
    """
    flight = recording_of(recording, options)
    fitted = vehicle_of(vehicle, flight)
    members = sample(fitted, count, seed=seed, days=days, mass_sd=0.0).vehicles
    period = recorded(flight, fitted).period if step is None else step
    others = recordings_of(calibrate, options)
    return ensemble(flight, fitted, members, horizon=horizon * period, calibrate=others, seed=seed, plain=plain)


def disagreements(first: SimulatorFile, second: SimulatorFile) -> list[str]:
    """Sentences on the quantities in which two files of one drone differ by more than 1 %."""
    found = []
    for quantity in NUMBERS:
        a, b = getattr(first.constants, quantity), getattr(second.constants, quantity)
        if a is None or b is None or abs(a - b) <= AGREE * max(abs(a), abs(b), 1e-12):
            continue
        mine, theirs = (f"{i.label(quantity)} of {i.where} is {v:.4g}" for i, v in ((first, a), (second, b)))
        found.append(f"{mine}, but {theirs} (both in SI)")
    return found


def _pooled(recordings: Sequence[Recording], vehicles: Mapping[str, Vehicle]) -> dict[str, dict[str, float]]:
    """Root mean square of the errors over flights. Raises DataError if no flight has errors."""
    errors = []
    for recording in recordings:
        with contextlib.suppress(DataError):
            errors.append(errors_after(recording, vehicles))
    if not errors:
        raise DataError("no flight is long enough and has whole states, so open-loop errors cannot be told")
    return {
        which: {q: float(np.sqrt(np.mean([e[which][q] ** 2 for e in errors]))) for q in errors[0][which]}
        for which in errors[0]
    }
