"""The statistics of the tests detect errors and accept correct images."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.statistical import assert_exact, assert_same_pixels_on_average, compare_pixels


def _images(seed: int, mean: np.ndarray, noise: float = 0.1) -> np.ndarray:
    """Two images, with noise that is larger where they are brighter."""
    random = np.random.default_rng(seed)
    shape = (2, *mean.shape)
    return mean * (1 + noise * random.standard_normal(shape)).clip(0)


@pytest.fixture
def mean() -> np.ndarray:
    return np.random.default_rng(1).uniform(0.2, 2.0, (18, 32, 3))


@pytest.mark.slow
def test_equal_means_agree(mean: np.ndarray) -> None:
    """No z score is larger than expected of this number of normal variables."""
    for seed in range(60):
        result = compare_pixels(_images(seed, mean), _images(1000 + seed, mean))
        assert np.abs(result.regions).max() < 4.6 and np.abs(result.tiles).max() < 4.6
    assert_same_pixels_on_average(_images(1, mean), _images(2, mean), precision=0.005)


@pytest.mark.parametrize(
    ("pixels", "factor"),
    [
        (np.s_[:, :], 1.03),
        (np.s_[4:8, 8:12], 1.5),
        (np.s_[5:8, 9:12], 3.0),
        (np.s_[3::5, 7::9], 2.0),
        (np.s_[:9], 1.05),
        (np.s_[..., 1], 1.05),
    ],
    ids=["everywhere", "a block", "a small block", "scattered", "half", "a channel"],
)
def test_bias_is_found_wherever_it_is(mean: np.ndarray, pixels: tuple, factor: float) -> None:
    """Errors of a few pixels are found too: they are not taken for noise."""
    wrong = mean.copy()
    wrong[pixels] *= factor
    with pytest.raises(AssertionError, match="z up to"):
        assert_same_pixels_on_average(_images(1, wrong), _images(2, mean))


@pytest.mark.parametrize("is_uniform", [True, False])
def test_wrong_pixels_of_a_furnace_are_found(is_uniform: bool) -> None:
    right = np.full((16, 16, 3), 0.7)
    assert_exact(_images(3, right), 0.7, uniform=is_uniform)
    right[2:4, 2:4] *= 1.8
    with pytest.raises(AssertionError, match="z"):
        assert_exact(_images(3, right, noise=0.05), 0.7, uniform=is_uniform)


def test_noise_that_says_nothing_is_refused(mean: np.ndarray) -> None:
    with pytest.raises(AssertionError, match="too noisy"):
        assert_same_pixels_on_average(_images(1, mean, 0.9), _images(2, mean, 0.9), precision=0.01)
