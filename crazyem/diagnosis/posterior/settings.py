"""Every number that the posterior is tuned by, with unit and source. Sizes of effects stand with the effects.

Numbers without a source weigh time against the number of models that are fitted. None has an ablation yet.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Attributes:
    prior_missing: probability that one effect is missing from a vehicle file: one drone in two lacks one of 26.
    correlation_time: s, of the disturbing force that every flight has; moving air at a Crazyflie's speed.
    max_rounds: of Gauss-Newton for a model.
    convergence: nats; a round that gains less ends a fit.
    noise_refit: nats; a round that gains more asks for noise scales anew.
    step_shares: of a Gauss-Newton step, the first that is no worse is taken.
    noise_rows: of a flight from which noise scales are taken, at most.
    deviation_range: usual standard deviations within which a recording stays, also beyond the physical range of a
        drone: a delay that is counted too long.
    max_full_starts: starting points of an effect up to which each is looked at with all parameters.
    single_log_odds: nats of linear log posterior odds from which a single effect is fitted.
    gain_share: of the best linear gain, from which another neighbour is fitted,
    gain_margin: and nats below the best within which a neighbour is, whatever its share.
    min_neighbours, max_neighbours: that are fitted in a turn; the first turn has no maximum.
    negligible_share: of the usual force with memory, below which no model has one.
    reduced_share: of the noise with memory that is left where neighbours are looked at without it.
    max_turns: of the search.
    naming_probability: of inclusion, from which an effect is named.
    look_alike_probability: of models with a rival in place of a name, from which the two are one group.
    separate_probability: of inclusion, from which a name stands alone.
    """

    prior_missing: float = 0.02
    correlation_time: float = 1.0
    max_rounds: int = 6
    convergence: float = 0.3
    noise_refit: float = 2.0
    step_shares: tuple[float, ...] = (1.0, 0.4, 0.1)
    noise_rows: int = 4000
    deviation_range: float = 4.0
    max_full_starts: int = 5
    single_log_odds: float = -1.5
    gain_share: float = 0.1
    gain_margin: float = 6.0
    min_neighbours: int = 3
    max_neighbours: int = 5
    negligible_share: float = 0.25
    reduced_share: float = 0.1
    max_turns: int = 6
    naming_probability: float = 0.5
    look_alike_probability: float = 0.05
    separate_probability: float = 0.9


SETTINGS = Settings()
