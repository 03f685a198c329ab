"""Small steps of chains: symmetric, and inside of the interval."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.estimators.chains.small_steps import SmallSteps
from tests.support.statistical import THRESHOLD

pytestmark = pytest.mark.usefixtures("variant")

#: A probability below which a test fails: that of |z| > THRESHOLD.
_UNLIKELY = 2 * stats.norm.sf(THRESHOLD)


def _uniform(count: int, seed: int) -> mi.Float:
    return mi.Float(np.random.default_rng(seed).random(count, dtype=np.float32))


_STEPS = [SmallSteps(), SmallSteps(1 / 64, 0.5), SmallSteps(0.1, 0.1)]


def test_the_logarithm_of_the_distance_of_a_small_step_is_uniform() -> None:
    steps, count = SmallSteps(1 / 512, 1 / 8), 1 << 16
    moved = steps.move(mi.Float(0.5), _uniform(count, 1)).numpy().astype(np.float64) - 0.5
    assert np.abs(moved).min() >= steps.low * (1 - 1e-4)
    assert np.abs(moved).max() <= steps.high * (1 + 1e-4)
    position = np.log(np.abs(moved) / steps.low) / math.log(steps.high / steps.low)
    for part in (position[moved > 0], position[moved < 0]):
        assert abs(len(part) - count / 2) < THRESHOLD * math.sqrt(count) / 2
        seen, _ = np.histogram(part, 32, (-1e-4, 1 + 1e-4))
        assert stats.chisquare(seen).pvalue > _UNLIKELY


def test_a_small_step_and_its_reverse_are_equally_likely() -> None:
    """Also over the ends of the interval."""
    count, bins = 1 << 20, 24
    value = _uniform(count, 2)
    moved = SmallSteps(1 / 256, 1 / 4).move(value, _uniform(count, 3)).numpy()
    pairs, _, _ = np.histogram2d(value.numpy(), moved, bins, [(0, 1), (0, 1)])
    assert pairs[0, -1] > 100 and pairs[-1, 0] > 100
    forward, backward = (p[np.triu_indices(bins, 1)] for p in (pairs, pairs.T))
    seen = forward + backward > 0
    z2 = (forward - backward)[seen] ** 2 / (forward + backward)[seen]
    assert stats.chi2.sf(z2.sum(), seen.sum()) > _UNLIKELY


@pytest.mark.parametrize("steps", _STEPS, ids=str)
def test_small_steps_stay_in_the_interval(steps: SmallSteps) -> None:
    largest = 1 - 2.0**-24
    ends = [0.0, 1e-30, 1e-9, steps.low, 0.5, 1 - steps.high, 1 - steps.low, largest]
    samples = [0.0, 1e-9, 0.25, 0.5 - 2.0**-25, 0.5, 0.75, largest]
    value, sample = (mi.Float(x) for x in np.array(np.meshgrid(ends, samples)).reshape(2, -1))
    moved = steps.move(value, sample).numpy()
    assert moved.min() >= 0 and moved.max() <= largest
    distance = np.abs(moved - value.numpy())
    distance = np.minimum(distance, 1 - distance)
    assert distance.min() >= steps.low * (1 - 1e-5) - 1e-7
    assert distance.max() <= steps.high * (1 + 1e-5) + 1e-7
