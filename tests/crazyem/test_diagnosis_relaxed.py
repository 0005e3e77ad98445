"""Passes of the filter settle where a velocity is shown far too large."""

import numpy as np
import pytest

from crazyem.diagnosis.fitting.model import under_relaxed


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.3, 1.9, 3.0])
@pytest.mark.parametrize("believed", [1.0, 0.7])
def test_a_velocity_shown_too_large_is_found_in_few_passes(scale: float, believed: float) -> None:
    """A filter that takes the offset of the pass before off what is shown, and believes that to a share."""
    random = np.random.default_rng(1)
    truth = random.normal(size=(200, 3))
    shown = scale * truth
    states = np.zeros((200, 19))
    states[:, 3:6] = shown
    for _ in range(12):
        offset = np.zeros((200, 12))
        offset[:, 3:6] = (scale - 1.0) * states[:, 3:6]
        filtered = states.copy()
        filtered[:, 3:6] = believed * (shown - offset[:, 3:6]) + (1.0 - believed) * truth
        states = under_relaxed(filtered, states, offset)
    assert states[:, 3:6] == pytest.approx(truth, abs=2e-3)


def test_without_an_offset_of_velocity_nothing_is_kept() -> None:
    filtered = np.ones((5, 19))
    assert under_relaxed(filtered, np.zeros((5, 19)), np.zeros((5, 12))) is filtered
    assert under_relaxed(filtered, None, np.ones((5, 12))) is filtered
