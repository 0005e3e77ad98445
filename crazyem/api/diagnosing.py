"""Diagnosis of the differences between a model and recordings, and open-loop prediction with a model."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazyem.api.inputs import RecordingLike, VehicleLike, recording_of, recordings_of, vehicle_of
from crazyem.api.planning import plan_commands
from crazyem.deprecated import warn
from crazyem.diagnosis import diagnose as by_recordings
from crazyem.diagnosis.document import compare, document_of, saved_vehicle, text_of
from crazyem.diagnosis.naming.steady import with_baseline
from crazyem.diagnosis.prediction import predict as prediction
from crazyem.diagnosis.prediction.predict import Prediction, recorded
from crazyem.diagnosis.report.pictures import Series, draw
from crazyem.errors import UsageError
from crazyem.notebook import finite, html_table, new_figure, saved
from crazyem.recordings.contents import ReadOptions
from crazyem.vehicle import Vehicle

LARGEST_PREDICTION = 4e9  # bytes of the arrays


def predict(
    recording: RecordingLike,
    vehicle: VehicleLike | None = None,
    *,
    horizon: int,
    step: float | None = None,
    every: int = 1,
    plain: bool = False,
    options: ReadOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Prediction:
    """Predict `horizon` steps from every `every`-th recorded state, open loop: no measurement after the start is used.

    Args:
        recording: a recording, or the path of one of any known format.
        vehicle: the model with its effects: a Vehicle, a preset's name or a file; None: the one that was flown.
        horizon: N, steps from each start.
        step: s between predicted states; None: the recorded samples.
        every: samples from one start to the next.
        plain: use the model alone, without correction by its errors of rotation before each start.
        options: how a path is read.
        progress: called with the number of finished starts and the number of all starts.

    Raises:
        UsageError: no such file or vehicle, or more predictions than fit into memory. FileFormatError: no recording.
        DataError: a part of the state is missing, or no start has its whole horizon in the recording.
    """
    if horizon < 1 or every < 1:
        raise UsageError(f"horizon ({horizon}) and every ({every}) must be 1 or more.")
    recording = recording_of(recording, options)
    shown = recorded(recording, vehicle_of(vehicle, recording))
    size = 14 * 8 * horizon * (shown.time.size / every)
    if size > LARGEST_PREDICTION:
        raise UsageError(
            f"{shown.time.size} samples with {horizon} steps each are {size / 1e9:.0f} GB of predictions; "
            f"use --every {math.ceil(every * size / LARGEST_PREDICTION)} or more."
        )
    return prediction.predict(shown, horizon=horizon, step=step, every=every, plain=plain, progress=progress)


if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Diagnosis(by_recordings.Diagnosis):
    """A diagnosis and its document: effects, the fitted vehicle, and prediction errors before and after the fit.

    Attributes:
        document: for programs; keys as in docs/reference/json.md.
        pictures: time series for the plots, by name.
    """

    document: Mapping[str, Any] = field(default_factory=dict, repr=False)
    pictures: Mapping[str, Series] = field(default_factory=dict, repr=False)

    def to_dict(self) -> dict[str, Any]:
        """The document, ready for JSON."""
        document: dict[str, Any] = finite(self.document)
        return document

    def __str__(self) -> str:
        return text_of(self.document)

    def _repr_html_(self) -> str:
        rows = [
            (effect.words, name, value.value, value.sd, value.unit, effect.confidence)
            for effect in self.effects
            for name, value in effect.parameters.items()
        ]
        title = f"{self.vehicle.name}: {'mismatch' if self.mismatch else 'no mismatch'}"
        header = ("effect", "parameter", "value", "sd", "unit", "confidence")
        return html_table(title, header, rows, self.document["notices"])

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Plot the errors of the model over time, before and after the fit; saved to `path` if given.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no matplotlib.
        """
        figure = new_figure(8.0, 2.3 * max(1, len(self.pictures)))
        for axes, series in zip(
            figure.subplots(max(1, len(self.pictures)), squeeze=False)[:, 0], self.pictures.values(), strict=False
        ):
            draw(axes, series)
            axes.set_title(series.title, fontsize=9)
        return saved(figure, path)

    def report(self, path: str | Path) -> None:
        """Write the diagnosis as one self-contained HTML page.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no Jinja2, or no matplotlib.
        """
        from crazyem.diagnosis.report import write_report

        write_report(path, self.document, self.pictures)

    def named_vehicle(self, name: str) -> Vehicle:
        """The fitted vehicle with a new name; `Vehicle.to_toml` gives the text of its file."""
        return saved_vehicle(self, name)


def diagnose(
    recordings: RecordingLike | Sequence[RecordingLike],
    vehicle: VehicleLike | None = None,
    *,
    held_out: RecordingLike | Sequence[RecordingLike] = (),
    baseline: RecordingLike | Sequence[RecordingLike] = (),
    against: RecordingLike | None = None,
    candidates: Sequence[str] = (),
    withhold: Sequence[str] = (),
    strict_held_out: bool = False,
    method: str = "",
    jobs: int | None = None,
    options: ReadOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find where a vehicle's model and its flights differ, which physics the model lacks, and fit these effects.

    Args:
        recordings: flights of one drone: recordings or paths.
        vehicle: the nominal model: a Vehicle, a preset's name or a file; None: the one that was flown.
        held_out: flights for evaluation only. If all `recordings` hover and these do not, the roles are exchanged.
        baseline: two or more flights of the healthy drone, for its trim and thrust and their day-to-day variation.
        against: a simulated recording of the same mission, to compare the first recording with.
        candidates: effects to look for; none: the whole catalogue.
        withhold: signals to leave unused, such as "pm.vbat".
        strict_held_out: never exchange the roles of `recordings` and `held_out`.
        method: deprecated, changes nothing.
        jobs: threads; None: one per core. The result is the same for any number.
        options: how paths are read.
        progress: called with a short description of the current step, by several threads.

    Raises:
        UsageError: no such file, vehicle or effect. FileFormatError: no recording, or no vehicle.
        DataError: a recording cannot be used (no flight, no inputs, too short).
    """
    say = progress or (lambda text: None)
    flown, kept = recordings_of(recordings, options), recordings_of(held_out, options)
    if not flown:
        raise UsageError("a diagnosis needs at least one recording.")
    nominal = vehicle_of(vehicle, flown[0])
    if healthy := recordings_of(baseline, options):
        nominal = with_baseline(nominal, healthy, say)
    if method:
        warn("diagnose(method=...)", "diagnose, which has one method")
    found = by_recordings.diagnose(
        flown, nominal, held_out=kept, wanted=candidates, withhold=withhold, strict=strict_held_out, jobs=jobs, say=say
    )
    say("open-loop errors before and after")
    document, pictures = document_of(found, flown, kept, withhold=withhold)
    document["notices"] = [*(n for r in flown for n in r.notices), *document["notices"]]
    if against is not None:
        document["against"] = compare(flown[0], recording_of(against, options))
    name = nominal.name if vehicle is None or isinstance(vehicle, Vehicle) else str(vehicle)
    plans = plan_commands(found.indistinguishable, nominal, name)
    return _with_plans(found, plans, document, pictures)


def _with_plans(
    found: by_recordings.Diagnosis, plans: list[str], document: dict[str, Any], pictures: dict[str, Series]
) -> Diagnosis:
    """A diagnosis with its document; both get the commands that plan a flight to tell look-alikes apart."""
    document["would_separate"] = [*document["would_separate"], *plans]
    values = {f.name: getattr(found, f.name) for f in fields(found)}
    values["would_separate"] = (*found.would_separate, *plans)
    return Diagnosis(**values, document=document, pictures=pictures)
