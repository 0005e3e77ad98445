"""Unexplained structure: structure in the innovations of the final model that no effect explains."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import TRIM
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point, Swept
from crazyem.diagnosis.locating.locate import AXES, Finding, Located, strongest
from crazyem.diagnosis.locating.random_torques import AT_RANDOM, erratic_rotor, humps, memoryless
from crazyem.diagnosis.naming.trials import Selection, tempered_evidence
from crazyem.diagnosis.settings import LOCATION, SPECTRUM
from crazyem.vehicle import GRAVITY

# Sizes that count, of each signal: share of the weight, share of the weight times the arm, rad, m/s.
TOLERANCE = {name: float(getattr(LOCATION, name)) for name in ("force", "torque", "attitude", "velocity")}
TURNING = ("torque", "body_rate")


@dataclass(frozen=True)
class Unexplained:
    """Structure that remains.

    Attributes:
        findings: structure that no effect explains, strongest first.
        gained: nats that the effects explain.
    """

    findings: tuple[Finding, ...]
    gained: float

    @property
    def found(self) -> bool:
        """Whether there is structure that no effect explains."""
        return bool(self.findings)

    @property
    def nats(self) -> float:
        """Nats of the strongest finding."""
        return self.findings[0].nats if self.findings else 0.0

    @property
    def explained(self) -> float:
        """Share of the structure that the effects explain, 0 to 1."""
        return self.gained / (self.gained + self.nats) if self.gained + self.nats > 0 else 1.0

    @property
    def force_nats(self) -> float:
        """Nats of the strongest force that depends on place or motion."""
        return max(
            (f.nats for f in self.findings if f.signal == "force" and f.variable not in ("", "time")), default=0.0
        )

    def with_finding(self, finding: Finding) -> "Unexplained":
        """The same with one more finding."""
        return Unexplained(tuple(sorted((*self.findings, finding), key=lambda f: -f.nats)), self.gained)

    def of_forces(self) -> "Unexplained":
        """The findings in forces, attitudes and velocities. Only these count against effects on forces, if the recorded
        commands lack the torques."""
        return Unexplained(tuple(f for f in self.findings if f.signal not in TURNING), self.gained)

    def without_random_rotor(self, rotor: int | None = None) -> "Unexplained":
        """Without the finding of a rotor (1 to 4; None: any) that pushes at random, which is no lasting force."""
        which = "" if rotor is None else f"rotor {rotor} "
        left = (f for f in self.findings if f.variable != AT_RANDOM or not f.regime.startswith(which))
        return Unexplained(tuple(left), self.gained)

    def without_force(self) -> "Unexplained":
        """Without findings in forces, which a random force explains."""
        return Unexplained(tuple(f for f in self.findings if f.signal != "force"), self.gained)


def unexplained(data: Data, selection: Selection, after: Located, apart: Data | None = None) -> Unexplained:
    """Unexplained structure of the final model, and the gain of the effects; random torques by held-out flights too."""
    point = selection.final
    # nuisances adapt to a vibration, so the search for vibrations has them at their values in the vehicle file
    named = {c.effect: point.effects[c.effect] for c in selection.accepted}
    filed = replace(point, effects={**point.vehicle.effects, **named})
    # body axes only: `place.py` tests forces along axes of the room, and `wind` is an effect of the catalogue
    of_the_body = [f for f in after.findings if f.axis in AXES]
    left = [
        f
        for f in strongest(of_the_body, most=40)
        if f.nats > LOCATION.min_structure and notable(f, point, differ=data.differ)
    ]
    for model in data.models:
        left += lines(model.sweep(point), model.flight.time) + humps(model, filed)
        model.settle(point)
    everything, quiet = data.together_with(apart), memoryless(data.twin(), point)
    everything.settle(quiet)
    erratic = erratic_rotor(everything.models, quiet)
    left += [erratic] if erratic and notable(erratic, point, differ=data.differ) else []
    left.sort(key=lambda f: -f.nats)
    # of the final model: beside all the others, an effect may gain more than when it was found
    gained = sum(max(tempered_evidence(t, counted=apart is not None), 0.0) for t in selection.taken.values())
    return Unexplained(tuple(left[:12]), gained)


def notable(finding: Finding, point: Point, *, differ: bool = False) -> bool:
    """Whether a finding is larger than onboard filters make it; flights that `differ` in thrust or trim make more."""
    weight = point.vehicle.mass * GRAVITY
    arm = max(point.vehicle.arm) or 0.03
    size = {"force": weight, "torque": weight * arm}.get(finding.signal, 1.0)
    daily = LOCATION.daily if differ or TRIM in point.vehicle.effects else 1.0
    return abs(finding.effect_size) > TOLERANCE.get(finding.signal, 0.0) * daily * size


def rate_change(rate: NDArray, window: NDArray, k: int) -> float:
    """rad/s: change of a rate's part at one frequency within a step; an unknown torque would leave all of it."""
    amplitude = 2 * np.abs(np.fft.rfft((rate - rate.mean()) * window))[max(k - 2, 0) : k + 3].max() / window.sum()
    return float(amplitude * min(1.0, 2 * np.pi * k / rate.size))


def lines(swept: Swept, time: NDArray) -> list[Finding]:
    """Lines in the spectrum of the body rates' innovations: vibrations at one frequency."""
    found = []
    period = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], period)
    for i in range(3):
        seen = swept.variance[:, 9 + i] > 0
        if seen.sum() < 256:
            continue
        z = np.interp(grid, time[seen], swept.innovation[seen, 9 + i] / np.sqrt(swept.variance[seen, 9 + i]))
        window = np.hanning(z.size)
        power = np.abs(np.fft.rfft((z - z.mean()) * window)) ** 2
        frequency = np.fft.rfftfreq(z.size, period)
        width = max(8, int(SPECTRUM.line_surroundings * power.size))
        first = max(4, int(np.searchsorted(frequency, SPECTRUM.min_frequency)))
        k = int(np.argmax(power[first:-1])) + first
        around = np.r_[power[max(2, k - width) : max(2, k - 3)], power[k + 4 : k + width]]
        if around.size < 16:
            continue
        ratio = float(power[k] / np.median(around) * np.log(2.0))  # over the mean of exponential powers
        if ratio > LOCATION.min_structure + np.log(power.size):
            nats = float(ratio - np.log(power.size))
            where = f"frequency {frequency[k]:.2f} Hz"
            size = float(2 * np.sqrt(power[k]) / window.sum() * np.sqrt(np.median(swept.variance[seen, 9 + i])))
            if size < SPECTRUM.min_line_torque * rate_change(
                np.interp(grid, time, swept.filtered[:, 10 + i]), window, k
            ):
                continue  # the loop swings at that frequency, and the model misses a small part of the swing
            span = (float(time[0]), float(time[-1]))
            sd = size / float(np.sqrt(max(ratio, 1.0)))
            chance = float(np.exp(-nats))
            found.append(Finding("body_rate", AXES[i], where, "frequency", span, size, sd, "rad/s", nats, chance))
    return found
