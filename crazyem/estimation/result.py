"""Results of the estimator: values, standard deviations, intervals, whether the data support them; steps of mass."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazyem.notebook import finite, html_table, new_figure, saved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETER_UNITS = {
    "mass": "kg",
    "Ixx": "kg m^2",
    "Iyy": "kg m^2",
    "Izz": "kg m^2",
    "motor_time_constant": "s",
    "input_delay": "s",
    "torque_offset_x": "N m",
    "torque_offset_y": "N m",
    "torque_offset_z": "N m",
}


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter: value, standard deviation, 95 % interval, and `identifiable` with the reason if it is not."""

    value: float
    sd: float
    ci95: tuple[float, float]
    unit: str
    identifiable: bool
    reason: str = ""

    @property
    def relative_sd(self) -> float:
        """sd / value, or infinity where the value is zero."""
        return abs(self.sd / self.value) if self.value else float("inf")

    def to_json(self) -> dict[str, Any]:
        """The form in the summary JSON (an interface: names are fixed)."""
        return {
            "value": self.value,
            "sd": self.sd,
            "ci95": list(self.ci95),
            "unit": self.unit,
            "identifiable": self.identifiable,
            "reason": self.reason,
        }


@dataclass(frozen=True)
class Estimate:
    """All parameters at one time.

    Attributes:
        time: s on the drone's clock of the newest sample used.
        parameters: mass, Ixx, Iyy, Izz, motor_time_constant -> ParameterEstimate.
        noise: name -> scale; continuous intensities of thrust [N sqrt(s)] and torque [N m sqrt(s)], and the
            standard deviations of the measurements (SI).
        samples: samples in the window now.
        updates: number of updates so far, this one included.
        converged: whether the score test was passed.
    """

    time: float
    parameters: Mapping[str, ParameterEstimate]
    noise: Mapping[str, float] = field(default_factory=dict)
    samples: int = 0
    updates: int = 0
    converged: bool = False

    def __getitem__(self, name: str) -> ParameterEstimate:
        return self.parameters[name]

    def to_json(self) -> dict[str, Any]:
        """The `estimates` object of the summary JSON."""
        return {name: p.to_json() for name, p in self.parameters.items()}

    def to_dict(self) -> dict[str, Any]:
        """The whole estimate, ready for JSON: `estimates` as in the summary, noise, samples, updates."""
        about = {"time": self.time, "samples": self.samples, "updates": self.updates, "converged": self.converged}
        whole: dict[str, Any] = finite({**about, "estimates": self.to_json(), "noise": dict(self.noise)})
        return whole

    def _repr_html_(self) -> str:
        header = ("parameter", "value", "sd", "95 % from", "to", "unit", "not identifiable")
        rows = [(n, p.value, p.sd, *p.ci95, p.unit, p.reason) for n, p in self.parameters.items()]
        return html_table(f"Estimate at {self.time:.2f} s from {self.samples} samples", header, rows)

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Plot the 95 % intervals of mass and inertia, relative to their values; saved to `path`.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no matplotlib.
        """
        figure = new_figure(6.0, 2.5)
        axes = figure.subplots()
        names = [n for n in ("Izz", "Iyy", "Ixx", "mass") if n in self.parameters]
        for row, name in enumerate(names):
            p = self.parameters[name]
            low, high = (100.0 * (bound / p.value - 1.0) for bound in p.ci95)
            axes.plot([low, high], [row, row], "C0" if p.identifiable else "0.6", linewidth=3)
            axes.plot([0.0], [row], "k|")
        axes.set_yticks(
            range(len(names)), [f"{n} {self.parameters[n].value:.4g} {self.parameters[n].unit}" for n in names]
        )
        axes.set_xlabel("95 % interval, % of the value (grey: not identifiable)")
        axes.grid(alpha=0.3)
        return saved(figure, path)

    def __str__(self) -> str:
        lines = [f"{'parameter':<20} {'value':>12} {'sd':>10}  {'95 % interval':<27} unit"]
        for name, p in self.parameters.items():
            note = "" if p.identifiable else f"   not identifiable: {p.reason}"
            lines.append(
                f"{name:<20} {p.value:>12.5g} {p.sd:>10.2g}  [{p.ci95[0]:.5g}, {p.ci95[1]:.5g}]".ljust(74)
                + f"{p.unit}{note}"
            )
        return "\n".join(lines)


@dataclass(frozen=True)
class Step:
    """A change of mass.

    Attributes:
        time: s, onset. found: s, time of detection.
        before: kg. after: kg, None until decided. real: whether it was a change of mass, None until decided.
        jumped: no change of mass, but a jump of the logged thrust: commands or voltage in the log are wrong.
    """

    time: float
    found: float
    before: float
    after: float | None = None
    real: bool | None = None
    jumped: bool = False

    def __str__(self) -> str:
        if self.jumped:
            return f"the logged thrust jumped at {self.time:.2f} s, and the drone did not: commands or voltage lie"
        if self.real and self.after is not None:
            return f"mass changed at {self.time:.2f} s: {self.before:.4g} -> {self.after:.4g} kg"
        what = "a gust" if self.real is False else "perhaps a change of mass"
        return f"{what} at {self.time:.2f} s, noticed at {self.found:.2f} s"

    def to_json(self) -> dict[str, float | bool | None]:
        """The form in the summary; times on the drone's clock."""
        return {
            "time": self.time,
            "found": self.found,
            "before_kg": self.before,
            "after_kg": self.after,
            "real": self.real,
            "jumped": self.jumped,
        }
