"""The running tests: every hypothesis in windows of several lengths; the posterior names a change.

A window opens every `SPACING` s, and before a row that is far from its prediction. It is kept while it is one of the
newest few or its number is divisible by a power of two, so the lengths grow geometrically up to `LONGEST`. The
statistic of each hypothesis and length is divided by its own scale without a change, because model errors make it
larger than the theory of white innovations predicts. The scale comes from a finite number of windows, so the statistic
has a Student's distribution, not a normal one. A window uses scales from before it opened, and parameters of slow
errors from before the longest window opened.
"""

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.em import WindowEM
from crazyem.estimation.model import Parameters
from crazyem.estimation.tape import Tape
from crazyem.monitoring import kernels
from crazyem.monitoring.columns import NUISANCES, Columns, RowMaker, lateness
from crazyem.monitoring.fault import Fault, Size
from crazyem.monitoring.hypotheses import NORMAL_SHARE, hypotheses_for
from crazyem.monitoring.nuisance_memory import NuisanceMemory
from crazyem.monitoring.slow_error import LAGS, slow_error
from crazyem.monitoring.threshold import threshold_for
from crazyem.physics.effects.onboard_estimate import CORRECTION_SECONDS
from crazyem.vehicle import Vehicle

SPACING = 0.04  # s between openings of windows
LEVELS = 5  # windows are up to 4 * 2^4 openings long
LONGEST = 4 * 2 ** (LEVELS - 1)
WINDOWS = 32  # capacity for windows
ROWS_A_SECOND = 100.0  # rate of a log, for the threshold
COVARIANCE_MEMORY = 20.0  # s, time constant of the covariances of innovations
SCALE_MEMORY = 60.0  # s, time constant of the running means of the statistics
CLIPPED = 4.0  # standard deviations; limit of innovations and of the root of a statistic in these means
LEARNING, REFERENCE = 8.0, 2.0  # s of flight without tests, for estimator and scales; s between reference parameters
# Prior of the scale: its value, its weight in s of flight, its degrees of freedom. Undisturbed flights have a geometric
# mean of 1.1 (the prior is above), and a standard deviation of the logarithm of 0.3, so 2 / 0.3^2 degrees of freedom.
SCALE_BEFORE, SCALE_WEIGHT, SCALE_FREEDOM = 1.5, 30.0, 30.0
REGIME = 0.25  # s, least time of flight for one more degree of freedom
SETTLED = 1.0  # s after the onset, time of the second report
LEAST_SETTLING = 0.3  # s after the detection, earliest time of the second report
NEAR_ONSET = 0.2  # s, largest change of the onset after the detection
SIGNATURE_ERROR = 0.1  # relative error of signatures, as parameters are known within some per cent
CLEAR, UNCLEAR = 0.95, 0.2  # probability from which a change is reported; s after which it is reported anyway
RULED_OUT = 0.05  # probability below which a hypothesis is no look-alike


def weakened(
    statistic: NDArray[np.float64], unusual: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The statistic of data whose noise is larger by a factor `noise` in variance, while the prior is what it is.

    Twice the logarithm of the likelihood ratio at sizes x is (2 S'x - x'Jx) / noise - x' prior x. With the likeliest
    sizes, S = (J + prior) x, the best multiple of x gives this.

    Args:
        statistic: S' (J + prior)^-1 S. unusual: x' prior x.
    """
    return np.asarray(statistic**2 / noise / np.maximum(statistic + (noise - 1.0) * unusual, 1e-300))


class Detector:
    """Takes filtered rows of the tape and reports changes; the same rows give the same reports.

    Args:
        vehicle: its geometry. false_alarms_per_hour: of all hypotheses together.

    Attributes:
        holds: whether the model holds; False from a detection until the restarted tests are below their thresholds.
        tested: s of flight with tests.
    """

    def __init__(self, vehicle: Vehicle, *, false_alarms_per_hour: float = 0.1) -> None:
        self.hypotheses = hypotheses_for(vehicle)
        self.columns = Columns.of(self.hypotheses)
        self._maker = RowMaker(self.columns, vehicle)
        size, count = len(self.columns.columns), len(self.hypotheses)
        changes = np.array([c.changes for c in self.columns.columns])
        self.freedom = np.add.reduceat(changes.astype(np.int64), self.columns.first[:-1])
        self._prior = self.columns.sd**-2.0
        self._usual = np.array([c.usual or NORMAL_SHARE * c.sd for c in self.columns.columns]) ** -2.0
        self._followed = np.array([h.followed for h in self.hypotheses])
        names = [h.name for h in self.hypotheses]
        self._normal = np.array([h.normal for h in self.hypotheses])
        self._log_prior = -np.log([names.count(n) for n in names])  # every name is equally probable
        each = false_alarms_per_hour / count
        longest = SPACING * LONGEST * ROWS_A_SECOND
        self.threshold = np.array([
            threshold_for(each, int(d), shortest=1.0, longest=longest, rate=ROWS_A_SECOND) for d in self.freedom
        ])  # fmt: skip
        self.rows = np.zeros(WINDOWS, np.int64)
        self.opened = np.zeros(WINDOWS)  # s, when each opened
        self.number = np.full(WINDOWS, -1)
        self.d, self.d_slow = np.zeros((WINDOWS, 12, size)), np.zeros((WINDOWS, 12, size))
        self.path, self.turned = np.zeros((WINDOWS, 6, len(self.columns.onboard))), np.zeros((WINDOWS, 3))
        self.score = np.zeros((WINDOWS, size))
        self.among, self.cross = np.zeros((WINDOWS, size, size)), np.zeros((WINDOWS, size, NUISANCES))
        self.score_n, self.among_n = np.zeros(NUISANCES), np.zeros((NUISANCES, NUISANCES))
        # score_n and among_n when a window opened, less what was known of the nuisances then
        self.score_n_of = np.zeros((WINDOWS, NUISANCES))
        self.among_n_of = np.zeros((WINDOWS, NUISANCES, NUISANCES))
        self._memory = NuisanceMemory(COVARIANCE_MEMORY)
        self.drift = np.zeros((12, 1))
        self.n, self.n_slow, self.n_now = (np.zeros((12, NUISANCES)) for _ in range(3))
        self.e_slow, self.e_now = np.zeros(12), np.zeros(12)
        self.past, self.seen = np.zeros((LAGS[-1] + 1, 12)), np.zeros(12, np.int64)
        self.covariances = np.concatenate([np.ones((1, 12)), np.zeros((len(LAGS), 12))])
        self._slow = deque([slow_error(self.covariances)], maxlen=LONGEST + 1)  # oldest first
        self.excess, self.statistic, self.determinant = np.zeros((3, WINDOWS, count))
        self.size, self.variance = np.zeros((WINDOWS, size)), np.ones((WINDOWS, size))
        d = self.freedom.astype(float)
        before = SCALE_BEFORE * np.ones((LEVELS, 1))
        # running means of the first three powers of the statistics
        self.moments = np.stack([d * before, d * (d + 2) * before**2, d * (d + 2) * (d + 4) * before**3])
        self.scale = np.full((LEVELS, count), SCALE_BEFORE)
        self.known = np.zeros(LEVELS)  # s of flight in the scale
        self.scale_of = np.full((WINDOWS, LEVELS, count), SCALE_BEFORE)  # scale when a window opened
        self.known_of = np.zeros((WINDOWS, LEVELS))
        self.holds = True
        self.tested = 0.0
        self._reference: Any = (-math.inf, None, None)  # start time, parameters, their standard deviations
        self._restart(-math.inf)

    def _restart(self, time: float) -> None:
        self._maker.restart()
        self._memory.restart()
        self._open: list[int] = []
        self._count = 0
        self._since = time
        self._newest = -math.inf
        self._found: tuple[float, float] | None = None  # s, detection and onset of a change
        self._reported = self._sound = False  # whether a change was reported; whether it is a normal one
        self.drift[:], self.n[:], self.n_slow[:], self.e_slow[:] = 0.0, 0.0, 0.0, 0.0

    def pause(self, time: float, *, found: bool = False) -> None:
        """Drop all windows and learn from `time` [s] on, as the model of the estimator does not describe the drone.

        A change that was found keeps its windows until its second report, unless `found` drops it, too.
        """
        if found or self._found is None:
            self._restart(time)

    # rows -------------------------------------------------------------------------------------------------------

    def take(
        self, em: WindowEM, p: Parameters, first: int, last: int, sd: NDArray[np.float64], ages: NDArray[np.float64]
    ) -> Fault | None:
        """Take rows first..last-1 of the tape, just filtered for the first time; returns a report if there is one.

        Args:
            em: its tape and setup. p: the parameters that the rows were filtered with.
            sd: (9,) standard deviations of theta, in its coordinates. ages: (last - first,) s, ages of the measured
                states less the usual age.
        """
        tape = em.tape
        begin = first
        for k in range(first, last):
            if tape.kind[k] == 1:
                self._restart(float(tape.time[k]))
                begin = k + 1
        if begin >= last:
            return None
        now = float(tape.time[last - 1])
        self._keep_reference(now, p, sd)
        _, reference, sd = self._reference
        self._precision = self._maker.precision(sd)
        acting, sensed = self._maker.rows(tape, reference, begin, last)
        acting_n, sensed_n = self._maker.nuisances(tape, reference, em.setup.unit, begin, last)
        drifting = self._maker.drifting(tape, p, reference, begin, last)
        late = lateness(tape, begin, last) * ages[begin - first :, None]
        motion = tape.xf[begin - 1 : last, [3, 4, 5, 10, 11, 12]]
        late[:, 9:] = 0.0  # body rates are those of the gyro, which are new
        split = self._jump(tape, begin, last)
        for low, high in ((begin, split), (split, last)):
            if low == split > begin:
                self._renew(float(tape.time[split - 1]))
            rows, slots = slice(low - begin, high - begin), np.array(self._open, np.int64)
            kernels.absorb(
                low, high, em.setup.lead, tape.time, tape.usable, tape.gain, tape.s, tape.e, tape.blocks, tape.middle,
                acting[rows], sensed[rows], acting_n[rows], sensed_n[rows], drifting[rows], late[rows], self.drift,
                self.columns.once, self.columns.block, self.columns.onboard, self.columns.seconds, self.columns.later,
                CORRECTION_SECONDS, motion[low - begin : high - begin + 1], slots, self.rows, self._slow[0], self.d,
                self.path, self.turned, self.d_slow, self.n, self.n_slow, self.n_now, self.e_slow, self.e_now,
                self.score, self.score_n, self.among, self.cross, self.among_n,
            )  # fmt: skip
        if self._found is None:
            kernels.correlate(
                begin, last, tape.time, tape.s, tape.e, COVARIANCE_MEMORY, CLIPPED, LAGS, self.past, self.seen,
                self.covariances,
            )  # fmt: skip
        if now - self._newest < SPACING - 1e-3:
            return None
        passed = min(now - self._newest, 1.0) if math.isfinite(self._newest) else SPACING
        self._newest = now
        self._memory.add(passed, self.score_n, self.among_n)
        self._compute(slots)
        report = self._judge(now, passed, slots) if self._open else None
        self._slow.append(slow_error(self.covariances))
        if self._found is None and now - self._since > LEARNING:
            self._renew(now)
        return report

    def _compute(self, slots: NDArray[np.int64]) -> None:
        """Statistics and sizes of the open windows; also without any, so that it is compiled before a flight."""
        begun = self._open[0] if self._open else -1
        kernels.judge(
            slots, self.columns.first, self._prior, self._usual, self._precision, self.score,
            self.score_n - self.score_n_of[begun], self.among, self.cross, self.among_n - self.among_n_of[begun],
            self.excess, self.statistic, self.determinant, self.size, self.variance,
        )  # fmt: skip

    def _jump(self, tape: Tape, begin: int, last: int) -> int:
        """The row with the largest innovation if it is beyond `CLIPPED` and the tests run; else `begin`.

        A sensor that jumps does so at one row. A window that opens some rows before expects it there, and finds
        nothing.
        """
        if not self._open or self._found is not None:
            return begin
        s = tape.s[begin:last]
        squares = tape.e[begin:last] ** 2 / (self.covariances[0] * np.where(s > 0.0, s, math.inf))
        row = int(squares.max(1).argmax())
        return begin + row if squares[row].max() > CLIPPED**2 else begin

    def _keep_reference(self, now: float, newest: Parameters, sd: NDArray[np.float64]) -> None:
        """Update the reference parameters of the innovations; an estimator that follows a change must not hide it.

        They are the newest ones while the estimator learns, then those of up to `REFERENCE` s ago, or older ones that
        are better known: after a supposed step of mass the estimator has only a few rows. After a detection they are
        kept.
        """
        start, _, known = self._reference
        age = now - start
        if self._found is None and (
            now - self._since < LEARNING or (age > REFERENCE and (sd <= known * age / REFERENCE).all())
        ):
            self._reference = (now, newest, sd)

    def _renew(self, now: float) -> None:
        """Close the windows that are no longer kept, and open one."""
        self._count += 1
        keep = []
        for w in self._open:
            number = int(self.number[w])
            step = number & -number  # largest power of two that divides it
            if self._count - number <= 4 * min(step, 2 ** (LEVELS - 1)):
                keep.append(w)
        free = next(w for w in range(WINDOWS) if w not in keep)
        self.rows[free], self.opened[free], self.number[free] = 0, now, self._count
        for array in (self.d, self.path, self.turned, self.d_slow, self.score, self.among, self.cross):
            array[free] = 0.0
        self.scale_of[free], self.known_of[free] = self.scale, self.known
        earlier, known = self._memory.sums(self._precision, float(self.scale[-1].mean()))
        self.score_n_of[free], self.among_n_of[free] = self.score_n - earlier, self.among_n - known
        self._open = [*keep, free]

    # decisions --------------------------------------------------------------------------------------------------

    def _level(self, w: int) -> int:
        """Group of a window by its length: up to 4, 8, 16 ... openings."""
        age = (self._newest - self.opened[w]) / SPACING
        return min(max(math.ceil(math.log2(max(age, 1.0) / 4.0)), 0), LEVELS - 1)

    def _judge(self, now: float, passed: float, slots: NDArray[np.int64]) -> Fault | None:
        self.tested += passed
        levels = np.array([self._level(w) for w in self._open])
        excess = self.excess[slots]
        scale = self.scale_of[slots, levels]
        seconds = np.maximum(SPACING * 4.0 * 2.0**levels, REGIME)
        freedom = SCALE_FREEDOM + (np.minimum(self.known_of[slots, levels], SCALE_MEMORY) / seconds)[:, None]
        normal = freedom * np.log1p(excess / (scale * freedom))
        over = np.where(self._normal, 0.0, normal / self.threshold)
        if self._found is not None:
            return self._settle(now, slots, scale)
        self.holds = bool(over.max() <= 1.0)
        if self.holds:
            self._learn(levels, excess, passed)
        if self.holds:
            return None
        report = self._report(now, slots, scale, settled=False)
        self._found = (now, report.onset)
        return self._first(report, now)

    def _learn(self, levels: NDArray[np.int64], statistic: NDArray[np.float64], passed: float) -> None:
        """Update the running moments of the statistics and the scales, by length.

        For chi-square times a scale, with d degrees of freedom, the first moment over d is the scale. The third moment
        over the second and over d + 4 is the scale, too; with heavier tails it is larger. Tails cause alarms, so the
        larger value is used.
        """
        d = self.freedom
        mine = np.minimum(statistic, (CLIPPED**2 * self.scale * d)[levels])
        members = levels == np.arange(LEVELS)[:, None]
        count = members.sum(1)
        powers = members @ np.stack([mine, mine**2, mine**3]) / np.maximum(count, 1)[:, None]
        rate = passed / np.minimum(SCALE_WEIGHT + self.known, SCALE_MEMORY) * (count > 0)
        self.moments += rate[:, None] * (powers - self.moments)
        first, second, third = self.moments
        self.scale = np.maximum(np.maximum(first / d, third / (second * (d + 4.0))), 1.0)
        self.known += passed * (count > 0)

    def _settle(self, now: float, slots: NDArray[np.int64], scale: NDArray[np.float64]) -> Fault | None:
        assert self._found is not None
        detected, onset = self._found
        if not self._reported:
            return self._first(self._report(now, slots, scale, settled=False), now)
        if now < max(onset + SETTLED, detected + LEAST_SETTLING):
            return None
        report = self._report(now, slots, scale, settled=True)
        self._restart(now)
        return report

    def _first(self, report: Fault, now: float) -> Fault | None:
        """The first report, once the posterior is clear enough or `UNCLEAR` s have passed; else None."""
        assert self._found is not None
        detected, _ = self._found
        if report.probability < CLEAR and now - detected < UNCLEAR:
            return None
        if self._sound:
            self._restart(now)
            self.holds = True
            return None
        self._reported = True
        self._found = (detected, report.onset)
        return report

    def _report(self, now: float, slots: NDArray[np.int64], scale: NDArray[np.float64], *, settled: bool) -> Fault:
        """Report of the most probable hypothesis and onset. Every signature has an error of `SIGNATURE_ERROR`.

        A statistic is divided by its own scale in the window, or by the scale of the test with the largest ratio if
        that is larger. After the detection, only windows near the onset count.
        """
        statistic, near = self.statistic[slots], np.ones(len(slots), bool)
        if self._found is not None:
            away = np.abs(self.opened[slots] - self._found[1])
            near = (away < NEAR_ONSET) | (away <= away.min())
        detected = now if self._found is None else self._found[0]
        at, k = np.unravel_index(int(np.argmax(np.where(near[:, None], statistic / scale, 0.0))), statistic.shape)
        noise = np.maximum(scale, scale[at, k]) + SIGNATURE_ERROR**2 * statistic[near].max()
        determinant = np.maximum(self.determinant[slots] - self.freedom * np.log(noise), 0.0)
        unusual = np.add.reduceat(self.size[slots] ** 2 * self._prior, self.columns.first[:-1], axis=1)
        evidence = np.where(near[:, None], 0.5 * (weakened(statistic, unusual, noise) - determinant), -np.inf)
        by_hypothesis = evidence.max(0) + self._log_prior
        posterior = np.exp(by_hypothesis - by_hypothesis.max())
        posterior /= posterior.sum()
        best = int(np.argmax(by_hypothesis))
        row = int(np.argmax(evidence[:, best]))
        w = int(slots[row])
        chosen = self.hypotheses[best]
        self._sound = chosen.normal
        of_name: dict[str, float] = {}
        for h, p in zip(self.hypotheses, posterior):
            of_name[h.name] = of_name.get(h.name, 0.0) + float(p)
        lo = int(self.columns.first[best])
        sizes = {}
        for i, column in enumerate(c for c in chosen.columns if c.changes):
            value, sd = float(self.size[w, lo + i]), math.sqrt(noise[row, best] * float(self.variance[w, lo + i]))
            sizes[column.label] = Size(value, (value - 1.96 * sd, value + 1.96 * sd), column.unit)
        others = {
            name: p
            for name, p in sorted(of_name.items(), key=lambda item: -item[1])
            if name != chosen.name and p > RULED_OUT
        }
        return Fault(
            chosen.effect, chosen.rotor, chosen.text, float(self.opened[w]), detected, sizes, of_name[chosen.name],
            others, settled, followed=bool(posterior[self._followed].sum() > RULED_OUT),
        )  # fmt: skip
