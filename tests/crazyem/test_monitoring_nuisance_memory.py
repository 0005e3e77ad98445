"""What is remembered of the drag: against dense algebra, forgetting, and a restart."""

import numpy as np
import pytest

from crazyem.monitoring.columns import LASTING, NUISANCES
from crazyem.monitoring.nuisance_memory import NuisanceMemory


def test_the_posterior_is_that_of_all_rows_with_the_other_nuisances_integrated_out() -> None:
    random = np.random.default_rng(1)
    rows, seen = random.standard_normal((200, NUISANCES)), random.standard_normal(200)
    precision = random.uniform(0.5, 2.0, NUISANCES)
    memory = NuisanceMemory(seconds=1e12)  # forgets nothing
    for last in (50, 120, 200):
        memory.add(0.04, rows[:last].T @ seen[:last], np.tril(rows[:last].T @ rows[:last]))
    score, among = memory.sums(precision, 1.0)
    own = np.isin(np.arange(NUISANCES), LASTING)
    got = np.linalg.solve(among[np.ix_(own, own)] + np.diag(precision[own]), score[own])
    whole = np.linalg.solve(rows.T @ rows + np.diag(precision), rows.T @ seen)
    np.testing.assert_allclose(got, whole[own], rtol=1e-9)
    assert not score[~own].any()
    assert not among[~own].any()
    halved = memory.sums(precision, 2.0)
    np.testing.assert_allclose(halved[1], among / 2.0)
    np.testing.assert_allclose(halved[0], score / 2.0)


def test_old_rows_count_less_and_none_after_a_restart() -> None:
    memory = NuisanceMemory(seconds=10.0)
    one = np.tril(np.ones((NUISANCES, NUISANCES)))
    memory.add(0.04, np.ones(NUISANCES), one)
    memory.add(10.0, np.ones(NUISANCES), one)  # no rows since
    score, _ = memory.sums(np.full(NUISANCES, 1e12), 1.0)
    np.testing.assert_allclose(score[list(LASTING)], np.exp(-1.0), rtol=1e-9)
    memory.restart()
    memory.add(0.04, 3.0 * np.ones(NUISANCES), 3.0 * one)  # two rows since
    score, _ = memory.sums(np.full(NUISANCES, 1e12), 1.0)
    assert score[-1] == pytest.approx(2.0, rel=1e-9)
