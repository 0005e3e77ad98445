"""The result of a flight, a watch or a replay: the estimate, the summary, and their history."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazyem.estimation.result import Estimate
from crazyem.live.history import History
from crazyem.live.summary import build_summary, text_summary
from crazyem.notebook import finite, html_table, saved
from crazyem.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from crazyem.live.pipeline import Pipeline


@dataclass(frozen=True, eq=False)
class FlightResult:
    """The result of `crazyem.fly` and `crazyem.replay`.

    Attributes:
        estimate: the final one, of the newest window.
        summary: for programs, with the keys of the command's JSON (docs/reference/json.md).
        history: track, estimates, writes and steps of mass over time.
        vehicle: the nominal one.
        title: of the flight, one line.
    """

    estimate: Estimate
    summary: Mapping[str, Any]
    history: History
    vehicle: Vehicle
    title: str

    def to_dict(self) -> dict[str, Any]:
        """The summary, ready for JSON: numbers that are not finite are None."""
        summary: dict[str, Any] = finite(self.summary)
        return summary

    def __str__(self) -> str:
        return text_summary(self.summary, self.estimate)

    def _repr_html_(self) -> str:
        rows = [(n, p.value, p.sd, *p.ci95, p.unit, p.reason) for n, p in self.estimate.parameters.items()]
        header = ("parameter", "value", "sd", "95 % from", "to", "unit", "not identifiable")
        return html_table(self.title, header, rows, self.summary["notices"])

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Plot of estimates with intervals over time, writes and height; saved to `path` if given.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no matplotlib.
        """
        from crazyem.live.plot import figure_of

        return saved(figure_of(self.history, self.vehicle, title=self.title), path)


def result_of(
    pipeline: "Pipeline",
    vehicle: Vehicle,
    *,
    title: str,
    log: str | None,
    received: int,
    lost: int,
    extra: Mapping[str, Any],
    notices: Iterable[str] = (),
) -> FlightResult:
    """The result of a session that has ended; for the arguments see `build_summary`.

    notices: further sentences for the user. Raises DataError: there is no flight to estimate from.
    """
    history = pipeline.history
    for sentence in notices:
        history.notice(sentence)
    estimate = pipeline.finish()
    summary = build_summary(
        log=log, vehicle=vehicle.name, estimate=estimate, history=history,
        update_seconds=pipeline.estimator.update_seconds, received=received, lost=lost, extra=extra,
    )  # fmt: skip
    return FlightResult(estimate, summary, history, vehicle, title)
