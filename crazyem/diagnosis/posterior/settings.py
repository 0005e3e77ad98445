"""Every number that the posterior is tuned by, with unit and source. Sizes of effects stand with the effects."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Attributes:
    missing: prior probability that one effect is missing from a vehicle file: one drone in two lacks one of 26.
    memory: s, correlation time of the disturbing force that every flight has; moving air at a Crazyflie's speed.
    rounds: of Gauss-Newton for a model, at most.
    enough: nats; a round that gains less ends a fit.
    much: nats; a round that gains more asks for noise scales anew.
    steps: shares of a Gauss-Newton step that are tried, the first that is no worse is taken.
    rows: of a flight from which noise scales are taken, at most.
    asked: nats of log posterior odds, by the linear approximation, from which a single effect is fitted.
    worth: share of the best linear gain of a neighbour from which another one is fitted,
    near: and nats below the best from which it is, whatever its share.
    few, most: neighbours that are fitted in a turn, at least and, after the first turn, at most.
    still: share of the usual force with memory below which no model has one.
    quiet: share of the noise with memory that is left where neighbours are looked at without it.
    turns: of the search, at most.
    told: probability of inclusion from which an effect is named.
    rival: probability of models with a rival in place of a name, from which the two are told as one group.
    sure: probability of inclusion from which a name stands alone.
    """

    missing: float = 0.02
    memory: float = 1.0
    rounds: int = 6
    enough: float = 0.3
    much: float = 2.0
    steps: tuple[float, ...] = (1.0, 0.4, 0.1)
    rows: int = 4000
    asked: float = -1.5
    worth: float = 0.1
    near: float = 6.0
    few: int = 3
    most: int = 5
    still: float = 0.25
    quiet: float = 0.1
    turns: int = 6
    told: float = 0.5
    rival: float = 0.05
    sure: float = 0.9


SETTINGS = Settings()
