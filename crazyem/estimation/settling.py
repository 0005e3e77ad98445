"""The whole way to a maximum and its intervals: EM while far, scoring when near, weak noise scales integrated out."""

from dataclasses import dataclass

from crazyem.estimation.approach import approach
from crazyem.estimation.em import Information, WindowEM
from crazyem.estimation.marginal import Marginal, marginalise
from crazyem.estimation.scoring import ALIKE_FAR, Stop, climb
from crazyem.estimation.starting import beginning

PASSED = 0.2  # standard deviations: a score test that asks for a shorter step is passed
FAR = 10.0  # standard deviations from the maximum beyond which EM goes first: scoring would inflate the noise
APPROACHES = 3  # after them, as long as the parameters are that far off
PART = 1000  # rows of a longer window that the first of these makes do with
MAPS = 3  # of EM, at most
STEPS = 25  # of scoring, at most
ROUGH = 1.0  # standard deviations within which the first sample is looked for again
TOLERANCE = 0.02  # standard deviations: scoring ends
RETRY = 40  # passes of plain EM and scoring where the likelihood is too rough for it


@dataclass(frozen=True)
class Settled:
    """Where a window's estimation ended.

    Attributes:
        information: at the end.
        marginal: intervals with weak noise scales integrated out; None where none was weak.
        maps: EM maps taken first.
        path: every point on the way, those of the maps first; with the length of the scoring step there, from the
            first scoring step on that over parameters and noise scales together.
    """

    information: Information
    marginal: Marginal | None
    maps: int
    path: tuple[Stop, ...]

    @property
    def converged(self) -> bool:
        """Whether the score test was passed, for parameters and noise scales together."""
        return self.path[-1].length < PASSED

    @property
    def steps(self) -> int:
        """Scoring steps until the score test was passed for good; all of them if it was not."""
        lengths = [stop.length for stop in self.path[self.maps :]]
        failed = [k for k, length in enumerate(lengths) if not length < PASSED]
        return min(failed[-1] + 1, len(lengths) - 1) if failed else 0


def settle(em: WindowEM, first: int, last: int) -> Settled:
    """Maximise the posterior over rows first..last-1 from where `em` is; the tape is left as the maximum has it."""
    path: list[Stop] = []
    while True:
        em.refill_inputs(first, last)
        em.forward(first, last, restart=True)
        em.backward(first, last)
        there = em.information(first, last)
        length = max(there.decrement, there.noise_length)
        if len(path) == MAPS or length < FAR:
            break
        path.append(Stop(em.parameters.theta, length))
        em.parameters = em.maximise(first, last)
    maps = len(path)
    with beginning(em, first, last) as begin:
        for end in (min(first + PART, last), *(last,) * (APPROACHES - 1)):
            if length < FAR:
                break
            path.append(Stop(em.parameters.theta, length))
            if not approach(em, first, end) and end == last:
                break
            em.forward(first, last, restart=True)
            em.backward(first, last)
            length = em.information(first, last).decrement
        climb(em, first, last, steps=STEPS, tolerance=ROUGH, path=path, alike=ALIKE_FAR)
        begin()
        best = climb(em, first, last, steps=STEPS, tolerance=TOLERANCE, path=path)
        if not path[-1].length < PASSED:
            em.converge(first, last, passes=RETRY)
            best = climb(em, first, last, steps=STEPS, tolerance=TOLERANCE, path=path)
        # of known noise it says how sure mass and inertia are, so there it must be that of the very end
        of_noise = em.noise_information(first, last) if em.setup.carried.any() else best.of_noise
        information = em.information(first, last, of_noise=of_noise)
        marginal = marginalise(em, first, last, best, information)
    return Settled(information, marginal, maps, tuple(path))
