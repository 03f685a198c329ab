"""The error of an image that its own batches announce: ``render --until``."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.images.metrics import RELATIVE_FLOOR
from mitsuba_ext.long_renders.announced_error import announced_error

_BATCHES, _SPP, _SIDE = 8, 16, 64


def _announced_and_true(chance: float, rng: np.random.Generator) -> tuple[float, float]:
    """Of an image whose pixels are 2: one from every sample, and one from samples that are rare."""
    shape = (_BATCHES, _SIDE, _SIDE, 1)
    batches = 1 + rng.binomial(_SPP, chance, shape) / (_SPP * chance) * np.ones(3)
    mean, variance = batches.mean(0), batches.var(0, ddof=1) / _BATCHES
    true = ((mean - 2) ** 2).mean() / (4 * (1 + RELATIVE_FLOOR))
    return announced_error(mean, variance), true


@pytest.mark.parametrize(("chance", "most"), [(0.5, 1.1), (1 / 64, 1.3), (1 / 1024, 4.1)])
def test_bright_spots_do_not_hide_their_error(chance, most):
    """An eighth of the pixels has one, in the last case. Too much is announced, never too little:
    4 times at most, since the median lacks half of the light."""
    rng = np.random.default_rng(1)
    announced, true = np.mean([_announced_and_true(chance, rng) for _ in range(10)], axis=0)
    assert 0.95 < announced / true < most


def test_pixels_that_are_not_finite_do_not_count():
    rng = np.random.default_rng(2)
    mean, variance = rng.uniform(1, 2, (2, 16, 16, 3))
    whole = announced_error(mean, variance)
    mean[3, 4, 1], variance[9, 9, 0], mean[12, 2] = np.nan, np.inf, np.inf
    assert announced_error(mean, variance) == pytest.approx(whole, rel=0.05)
    assert announced_error(mean * np.nan, variance) is None
    assert announced_error(np.zeros((4, 4, 3)), np.zeros((4, 4, 3))) is None


def test_one_pixel():
    mean, variance = np.full((1, 1, 3), 2.0), np.full((1, 1, 3), 0.04)
    assert announced_error(mean, variance) == pytest.approx(0.01 / (1 + RELATIVE_FLOOR))
