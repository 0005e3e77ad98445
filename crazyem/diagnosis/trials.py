"""Effects that were tried, and how two of them are compared: evidence, significance, what cannot be told apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.always import THRUST_SD, jittery, nuisances, solved, usual_wind
from crazyem.diagnosis.candidates import TRIM, Candidate
from crazyem.diagnosis.fit import Data, DivergedError, Fitted, bounds_of, held_near, moved
from crazyem.diagnosis.gram import Gram, bounded
from crazyem.diagnosis.model import Point
from crazyem.diagnosis.sampling import TRIM_SD
from crazyem.physics.effects.catalogue import CATALOGUE

SURE = 1e-3  # p-value of the score test, before counting candidates,
# with a trim in the file, where no test by the scatter of blocks follows (see `select`); some 70 are asked,
SURE_DAILY = 1e-4
LIKELY = 5e-2  # which flights held out may lower where it is below this
CLOSE = 4.0  # nats within which two explanations cannot be told apart,
FAR = 20.0  # nats that one step is believed to bring without looking
EVEN = 0.5  # what a name is worth, at least, beside a rival that is not significant itself
TOLD = 1.64  # or standard deviations of the difference of their likelihoods, over blocks or recordings
BEATEN = 0.1  # probability of being the better explanation below which a simpler one does not give the name
MANY = 5  # recordings, from which on it is seen by how much they differ
# Smaller than this, these are not told from what filters, sampling and the air of a room do: s, s, s, 1, rad, rad/s, 1,
# 1, N m s/m. And no rotor is lighter, kg m^2: a rod of 0.1 g and 46 mm has 1.8e-8, and this is a sixth of it.
LEAST = {"measurement_delay": 3e-3, "input_delay": 4e-3, "motor_lag": 7.5e-3, "velocity_scale": 0.035,
         "attitude_misalignment": 2e-3, "gyro_bias": 3e-3, "torque_scale": 0.08, "thrust_curve": 0.06,
         "velocity_moment": 3e-6, "rotor_inertia": 3e-9}  # fmt: skip
# s: with nothing late rates were 1.1 ms later than usual at most in 28 simulated flights, those of hovers earlier.
GYRO_LEAST = 2e-3
VELOCITY_LEAST = 2.0  # times what the jitter of an onboard estimate looks like
STEEP = 3.0  # vertical over horizontal wind
HIGHEST = 1.0  # m: a floor is felt by some rotor radii, Crazyflies have 23 to 28 mm
LEAST_INERTIA = 0.08  # relative, the same
LEAST_LOAD = 0.005  # of the drone's mass, the same
DRAWN = 2.0  # standard deviations of the day's trim
LEAST_DRAG = {"x": 1e-3, "y": 1e-3, "z": 3e-3}  # N s/m or N s^2/m^2; along z thrust is a little wrong (see SYSTEMATIC)
DRAG_MOST = {"linear_drag": 5.0, "quadratic_drag": 3.0}  # 1/s, 1/m, times the mass: more than air has
LEAST_CENTRE = {"x": 1e-4, "y": 1e-4, "z": 1e-3}  # m; z shows in lateral accelerations of O alone


@dataclass(frozen=True)
class Trial:
    """A candidate, tried beside the effects already found.

    Attributes:
        candidate: which.
        gain: log-likelihood beyond the model before it [nats], on the flights fitted.
        held_out: the same on held-out flights or blocks.
        dispersion: by how much scores scatter more than the model says.
        p_value: of the score test.
        evidence: what counts: gain over dispersion less the number of parameters, and the held-out gain.
        fitted: the model with it; None if only the linear approximation was looked at.
        blocks: (b,) its log-likelihood by blocks of the flights fitted and of those held out.
        value: the gain on all of these blocks [nats] once fitted to all of them, less what the priors of the always
            free parameters cost.
        recording: (b,) int, which recording each block is of.
        tuned: nats that it costs that its parameters might have been anything (`tuning`); None: one for each.
    """

    candidate: Candidate
    gain: float
    held_out: float
    dispersion: float
    p_value: float
    evidence: float
    fitted: Fitted | None = None
    blocks: NDArray = field(default_factory=lambda: np.zeros(0))
    value: float = 0.0
    recording: NDArray = field(default_factory=lambda: np.zeros(0, int))
    tuned: float | None = None

    @property
    def worth(self) -> float:
        """What counts where two are compared: the gain on all blocks less what its parameters cost [nats]."""
        return self.value - (len(self.candidate.free) if self.tuned is None else self.tuned)


@dataclass(frozen=True)
class Step:
    """One turn of the selection: all trials, best first, which was taken (None: the end), what it was not told apart
    from, and the effects that explain something else as well as it."""

    trials: tuple[Trial, ...]
    taken: Trial | None
    alike: tuple[Trial, ...] = ()
    beside: frozenset[str] = frozenset()

    def explanations(self) -> list[Trial]:
        """The trials that explain what this turn is about: significant alone and of some use on all flights together
        (one that ruins those held out scatters so much there that nothing could be told from it) or, as fitted to all
        of them, better than the one that was taken (a quadratic drag fitted to slow flight ruins a quick one, and is
        still what both show); or, however unsure alone, not told apart from it."""
        return [t for t in self.trials if self._explains(t) or any(t is a for a in self.alike)]

    def _explains(self, trial: Trial) -> bool:
        better_on_all = self.taken is not None and trial.value > self.taken.value
        return trial.p_value < SURE and (trial.evidence > 0 or better_on_all)


@dataclass(frozen=True)
class Selection:
    """What was selected: the nominal model, the final one, and how it came about; `doubted` are effects that something
    which shakes explains as well."""

    nominal: Point
    final: Point
    steps: tuple[Step, ...]
    accepted: tuple[Candidate, ...]
    fitted: Fitted
    tried: int
    doubted: frozenset[str] = frozenset()


def margin(best: Trial, other: Trial, *, recordings: bool = True) -> tuple[float, float]:
    """Log-likelihood of one less that of the other, each less what its parameters cost, with its standard deviation.

    What the priors of the always free parameters cost counts too: a factor on all torques that needs three inertias to
    be bent is the worse for it. The scatter of the difference over blocks counts, in which all that both miss cancels
    (Vuong 1989), with half of the covariance of neighbours on each side; and where there are many recordings that over
    `recordings`, since what belongs to one (its clock, its battery) is the same in all of its blocks.
    """
    nats = best.worth - other.worth
    apart = best.blocks - other.blocks
    return nats, max(scatter(apart), between(apart, best.recording) if recordings else 0.0)


def tuning(candidates: Sequence[Candidate], covariance: NDArray) -> float:
    """Nats that it costs effects that their parameters (k, in order) might have been anything.

    What is left of what is usual once they are known, as in Laplace's approximation of the evidence (MacKay 1992): a
    load that explains weak rotors must sit in the middle of the drone, and one that could be anywhere hardly ever does,
    within what a flight tells of it. What no flight tells costs nothing by this, and at least a nat for each parameter,
    as chance brings that much.

    Args:
        covariance: (k, k), with what is usual as prior (`known_of`).
    """
    usual = _usual(candidates)
    left = np.linalg.eigvalsh(covariance / np.outer(usual, usual))
    return max(float(usual.size), -0.5 * float(np.sum(np.log(np.clip(left, 1e-12, 1.0)))))


def known_of(candidates: Sequence[Candidate], curvature: NDArray) -> NDArray:
    """(k, k) covariance of the parameters of the candidates, which come first in a curvature (n, n), all else free,
    with what is usual as prior."""
    own = np.zeros(len(curvature))
    usual = _usual(candidates)
    own[: usual.size] = usual**-2.0
    return _inverse(curvature + np.diag(own))[: usual.size, : usual.size]


def _usual(candidates: Sequence[Candidate]) -> NDArray:
    return np.array([c.parameter(n).width for c in candidates for n in c.free])


def better(one: Trial, other: Trial, *, recordings: bool = True) -> float:
    """Probability that one explains more than the other, by the scatter of the difference."""
    nats, sd = margin(one, other, recordings=recordings)
    return float(stats.norm.cdf(nats / sd))


def not_beaten(near: Sequence[Trial]) -> list[Trial]:
    """Those of which none of the others that is significant is better nine to one."""
    sure = [t for t in near if t.p_value < SURE]
    return [t for t in near if all(t is o or better(t, o, recordings=False) > BEATEN for o in sure)]


def preferred(taken: Trial, rivals: Sequence[Trial]) -> float:
    """Probability that none of the rivals is the better explanation, by the scatter of the likelihoods' differences.

    A rival that is not significant itself is at most as probable: its likelihood may be better because it frees a
    direction that no flight tells (the mass of a load beside a thrust scale) and that differs from flight to flight.
    Against a trim, which every real drone has, no rival is more probable either.
    """
    chance = 1.0
    known = taken.candidate.effect == TRIM
    for rival in rivals:
        if rival.fitted is not None and rival.blocks.size == taken.blocks.size:
            chance *= max(better(taken, rival), EVEN if known or rival.p_value >= SURE else 0.0)
    return chance


def scatter(differences: NDArray) -> float:
    """Standard deviation of the sum of differences of log-likelihoods (b,) by blocks, neighbours alike by half."""
    centred = differences - differences.mean()
    return float(np.sqrt(centred @ centred + max(0.0, float(centred[1:] @ centred[:-1])))) + 1e-9


def between(differences: NDArray, recording: NDArray) -> float:
    """Standard deviation of the sum of differences (b,) by how they differ between recordings (b,); 0 for few."""
    if recording.size != differences.size or len(np.unique(recording)) < MANY:
        return 0.0
    total, length = np.bincount(recording, differences), np.bincount(recording)
    away = total - length * total.sum() / length.sum()
    return float(np.sqrt(away @ away * length.size / (length.size - 1)))


def told_apart(best: Trial, other: Trial, *, recordings: bool = True) -> bool:
    """Whether the flights prefer the one by more than chance."""
    nats, sd = margin(best, other, recordings=recordings)
    return nats > CLOSE and nats > TOLD * sd


def weighed(trials: Sequence[Trial], *, counted: bool) -> list[Trial]:
    """Evidence of each, the same dispersion for all so that likelihoods are compared and not scatters; best first."""
    if not trials:
        return []
    common = float(np.median([t.dispersion for t in trials]))
    judged = [
        replace(t, evidence=(t.gain + (t.held_out if counted else 0.0)) / common - len(t.candidate.free))
        for t in trials
    ]
    return sorted(judged, key=lambda t: (t.p_value >= SURE, -t.evidence))


def both(p_value: float, held: float) -> float:
    """p-value on the flights fitted and on those held out, where the effect as fitted brings `held` nats.

    By chance a likelihood ratio of fixed models exceeds exp(held) with a probability of at most exp(-held).
    """
    return p_value * float(np.exp(-max(held, 0.0))) if p_value < LIKELY else p_value


def gain_of_both(
    fitted: Fitted, held_out: Data, there: Fitted, accepted: Sequence[Candidate]
) -> tuple[float, NDArray, NDArray]:
    """What an effect fitted to the one set of flights would gain on both [nats] if it were fitted to both, the
    log-likelihood of those held out then, by blocks (b,), and the covariance (k, k) of what is accepted by both
    (`known_of`).

    By one step from `there`, the flights held out with the effect as it was fitted. The curvature at `fitted` is the
    prior of its parameters; what is of a kind that is always free may differ from what was fitted by its scatter in
    either set of flights. Of these kinds `there` has moved already, and paid for it as for the scatter of its own
    flights, which is given back. To be admitted an effect must hold as it is; to be compared with another it must not
    suffer from being less well known: a poor flight to fit would always prefer fewer parameters.
    """
    free = nuisances(held_out, there.point, accepted)
    own, parts = sum(len(c.free) for c in accepted), [*accepted, *(c for c, _ in free)]
    score, information = _total(held_out, there.point, parts)
    apart = {(c.effect, n): w for c, p in nuisances(held_out, there.point, ()) for n, w in zip(c.free, p, strict=True)}
    paid = np.array([apart.get((c.effect, n), 0.0) for c in accepted for n in c.free])
    away = np.array([
        *(c.values(there.point)[n] - c.values(fitted.point)[n] for c in accepted for n in c.free),
        *(c.values(there.point)[n] - c.neutral(there.point)[n] for c, _ in free for n in c.free),
    ])  # fmt: skip
    known = np.diag([*np.zeros(own), *(w for _, precision in free for w in precision)])
    differing = np.divide(1.0, paid, out=np.zeros(own), where=paid > 0.0)
    curvature = fitted.gram.total(range(fitted.gram.size))[1] + np.diag(fitted.precision)
    known[:own, :own] = _inverse(_inverse(curvature)[:own, :own] + np.diag(2.0 * differing))
    back = 0.5 * float(paid @ np.square(away[:own]) - away[:own] @ known[:own, :own] @ away[:own])
    rest = score - known @ away
    low, high = held_near(*bounds_of(parts, there.point), away, np.diag(known) * (np.arange(len(away)) >= own))
    step = bounded(information + known, rest, low, high)
    told = float(rest @ step - 0.5 * step @ (information + known) @ step)
    blocks, covariance = held_out.block_loglik(there.point), known_of(accepted, information + known)
    if told < FAR:
        return back + told, blocks, covariance
    # So much is told by slopes where an effect is far from what these flights want; what the step brings is to be seen
    looked = held_out.twin()
    begin, best = looked.loglik(there.point) - 0.5 * float(away @ known @ away), 0.0
    for part in (1.0, 0.5, 0.25):
        moves = part * step
        point = moved(there.point, parts, moves)
        with np.errstate(over="ignore", invalid="ignore"):
            brought = looked.loglik(point, passes=2) - begin
        brought -= 0.5 * float((away + moves) @ known @ (away + moves))
        if np.isfinite(brought) and brought > best:
            # by which explanations scatter: a drag that is right and was fitted to a hover ruins what it was not fitted
            # to, so badly that none could be told from it
            best, blocks = brought, looked.block_loglik(point)
    return back + min(best, told), blocks, covariance


def known_by(fitted: Fitted, accepted: Sequence[Candidate]) -> NDArray:
    """(k, k) covariance of what is accepted at the maximum (`known_of`)."""
    return known_of(accepted, fitted.gram.total(range(fitted.gram.size))[1] + np.diag(fitted.precision))


def _total(data: Data, point: Point, parts: Sequence[Candidate]) -> tuple[NDArray, NDArray]:
    """Score (k,) and information (k, k) of all free parameters."""
    columns = [x for c in parts for x in c.columns(point)]
    return data.gram(point, columns).total(range(len(columns)))


def _inverse(matrix: NDArray) -> NDArray:
    """Of a covariance or a curvature (k, k) whose parameters are of very different sizes; of one that says nothing, 0.

    Raises:
        DivergedError: a number of it is not finite.
    """
    if not np.isfinite(matrix).all():
        raise DivergedError("the curvature of a fit is not finite")
    told = np.diag(matrix) > 0.0
    scale = np.sqrt(np.where(told, np.diag(matrix), 1.0))
    inverse: NDArray = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)
    return inverse


def own_evidence(trial: Trial, *, counted: bool) -> float:
    """Evidence by the candidate's own scatter: what it must bring to be admitted."""
    return (trial.gain + (trial.held_out if counted else 0.0)) / trial.dispersion - len(trial.candidate.free)


def significance(fitted: Fitted, count: int, *, offset: int) -> float:
    """p-value that `count` free parameters from `offset` on are neutral, by their covariance at the maximum (Wald).

    Of an effect with an amplitude that alone is asked: a load of no mass has no length, so none is neutral.
    """
    solution, taken = solved(fitted)
    free = [(c, n) for c in fitted.candidates for n in c.free]
    own = [offset + i for i, (c, n) in enumerate(free[offset : offset + count]) if n == CATALOGUE[c.effect].amplitude]
    at = slice(own[0], own[0] + 1) if own else slice(offset, offset + count)
    away = np.array([c.values(fitted.point)[n] - c.neutral(fitted.point)[n] for c, n in free])
    return wald(away[at], solution.covariance[at, at], fitted.gram, taken)


def wald(away: NDArray, covariance: NDArray, gram: Gram, columns: float) -> float:
    """p-value that parameters (k,) `away` from neutral with a covariance (k, k) are neutral, of so many columns."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    z = away / scale
    distance = float(z @ np.linalg.lstsq(covariance / np.outer(scale, scale), z, rcond=1e-9)[0])
    return float(stats.f.sf(distance / len(z), len(z), max(len(gram.score) - columns, 3)))


def at_the_end(point: Point, candidate: Candidate) -> bool:
    """Whether an effect of one number is where nothing more of it is admitted, or a drag is none that air has."""
    here = candidate.values(point)
    if candidate.effect in DRAG_MOST:
        most = DRAG_MOST[candidate.effect] * point.vehicle.mass
        return any(here[n] > most for n in candidate.free)
    if len(candidate.free) != 1:
        return False
    name = candidate.free[0]
    return here[name] in candidate.range_of(name) and here[name] != candidate.neutral(point)[name]


def sure_enough(point: Point, p_value: float) -> bool:
    """Whether an effect may be taken by its p-value."""
    return p_value < (SURE_DAILY if TRIM in point.vehicle.effects else SURE)


def _other_load(point: Point, here: Mapping[str, float], filed: Mapping[str, float]) -> bool:
    """Whether a load is another than the file's by more than is told: in weight, or in where it draws the centre.

    With a trim in the file by more than differs from day to day; that of no load is told by its weight alone.
    """
    daily = TRIM in point.vehicle.effects
    heavier = abs(here["mass"] - filed["mass"])
    if heavier > (THRUST_SD if daily else LEAST_LOAD) * point.vehicle.mass:
        return True
    if "x" not in here or not (daily or filed["mass"] > 0.0):
        return False
    along_x, along_y = (here["mass"] * here[n] - filed["mass"] * filed[n] for n in "xy")
    drawn = float(np.hypot(along_x, along_y)) / point.vehicle.mass
    return drawn > (DRAWN * TRIM_SD[0] if daily else LEAST_CENTRE["x"])


def matters(point: Point, candidate: Candidate, data: Data | None = None) -> bool:
    """Whether the effect is larger than what onboard filters or the sampling of a log look like, and within its range.

    One number that ends where nothing more is admitted would be more: it stands for something else. With the flights it
    was fitted to, a scale of velocities must be more than the jitter of the estimate in them, too.
    """
    least = GYRO_LEAST if dict(candidate.fixed).get("streams") == ("gyro",) else LEAST.get(candidate.effect)
    here, neutral = candidate.values(point), candidate.neutral(point)
    if at_the_end(point, candidate):
        return False
    by_axis = {"center_of_mass": LEAST_CENTRE, "linear_drag": LEAST_DRAG, "quadratic_drag": LEAST_DRAG}
    if candidate.effect in by_axis:
        return any(abs(here[n] - neutral[n]) > by_axis[candidate.effect][n] for n in candidate.free)
    if (
        candidate.effect == "wind"
    ):  # what rises or sinks is thrust that is a little wrong: no air blows through the floor
        along = float(np.hypot(here["x"], here["y"]))
        return along > usual_wind(point.vehicle) and abs(here["z"]) < STEEP * along
    if candidate.effect == "ground_effect":  # what does not fade with height is thrust that is a little wrong
        return here["height"] < HIGHEST
    if candidate.effect in ("payload", "suspended_load"):
        return _other_load(point, here, neutral)
    if candidate.effect == "inertia":
        return any(abs(here[n] / neutral[n] - 1.0) > LEAST_INERTIA for n in candidate.free)
    if candidate.effect == "velocity_scale" and data is not None:
        jitter = np.maximum(VELOCITY_LEAST * jittery(data), least or 0.0)
        return any(abs(here[n] - neutral[n]) > j for n, j in zip("xyz", jitter, strict=True) if n in candidate.free)
    if least is None:
        return True
    return any(abs(here[n] - neutral[n]) > least for n in candidate.free)
