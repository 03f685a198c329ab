"""The error of a render that is too short to find some light."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.choice.candidate_moments import GROUPS
from mitsuba_ext.estimators.light_paths.choice.path_moments import Estimate
from mitsuba_ext.estimators.light_paths.choice.predicted_errors import PredictedErrors
from mitsuba_ext.estimators.light_paths.choice.rare_contributions import BINS, error_of_render, rare
from mitsuba_ext.images.coarse_film import CoarseFilm

#: Pixels of a row, and pixels.
WIDTH, PIXELS = 40, 1200

#: A bin of values that are found.
SOME = 5


def _found(*contributions: tuple[int, float, float]) -> np.ndarray:
    """Bin, light and value of contributions that all pixels have."""
    found = np.zeros((PIXELS, BINS, 2))
    for index, light, value in contributions:
        found[:, index] = light, light * value
    return found


def _rare(found: np.ndarray, spp: float, share: float = 1e-3):
    return rare(found, np.ones(PIXELS), WIDTH, spp, [share])[0]


def test_light_that_no_sample_finds_counts_as_missing() -> None:
    found = _found((SOME, 1.0, 2.0))
    found[:, -1, 0] = 0.25
    lacks = _rare(found, spp=100)
    np.testing.assert_allclose(lacks.light, 0.25)
    np.testing.assert_allclose(lacks.square, 0.25**2)
    # Second moment 2; the mean that is found is 1
    error = error_of_render(np.full(PIXELS, 2 - 1.25**2), np.full(PIXELS, 1.25), lacks, 100)
    np.testing.assert_allclose(error, 1 + 100 * 0.25**2)


@pytest.mark.parametrize("spp, missing", [(4, 1.0), (64, 1 / 6.4)])
def test_sparks_are_missing_in_short_renders_and_variance_in_long_ones(
    spp: int, missing: float
) -> None:
    """One sample of 10 000 finds a spark of 1000: of 4 samples per pixel, 0.4 pixels in a thousand
    hold one; of 64, 6.4, of which the error leaves out one."""
    found = _found((SOME, 1.0, 1.0), (BINS - 3, 0.1, 1000.0))
    lacks = _rare(found, spp)
    assert lacks.light.mean() == pytest.approx(0.1 * missing, rel=0.02)
    assert lacks.moment.mean() == pytest.approx(100 * missing, rel=0.02)


def test_contributions_are_bright_in_relation_to_their_pixel() -> None:
    found = _found((SOME, 1e-3, 1e3))
    scale = np.where(np.arange(PIXELS) % 2, 1.0, 1e-3)
    (lacks,) = rare(found, scale, WIDTH, spp=1000, shares=[0.5005e-3])
    np.testing.assert_allclose(lacks.light[1::2], 1e-3)
    assert not lacks.light[::2].any()


def test_the_square_of_missing_light_is_free_of_noise() -> None:
    found = _found()
    found[:, -1, 0] = np.random.default_rng(1).exponential(0.5, PIXELS)
    assert _rare(found, 1).square.mean() == pytest.approx(0.25, rel=0.1)


@pytest.mark.parametrize("spp", [8, 512])
def test_the_error_agrees_with_renders_without_their_brightest_pixels(spp: int) -> None:
    """Against renders that draw contributions: in 8 samples, sparks are in fewer than one pixel of
    a thousand; in 512, in more."""
    kinds = [(0.5, 2.0), (2e-5, 1e4)]
    random = np.random.default_rng(2)
    pixels = 1 << 18
    sums = sum(value * random.binomial(spp, chance, pixels) for chance, value in kinds)
    mean = sum(chance * value for chance, value in kinds)
    errors = np.sort((sums / spp - mean) ** 2)
    measured = errors[: int(0.999 * pixels)].mean()
    found = _found(*((SOME + i, p * x, x) for i, (p, x) in enumerate(kinds)))
    moment = sum(chance * value**2 for chance, value in kinds)
    variance = np.full(PIXELS, moment - mean**2)
    lacks = _rare(found, spp)
    predicted = error_of_render(variance, np.full(PIXELS, mean), lacks, spp).mean() / spp
    assert predicted == pytest.approx(measured, rel=0.15)


def _estimate(never_found: float) -> Estimate:
    """``path``, with less variance, does not find some light that all techniques find."""
    common = _found((SOME, 1.0, 1.5))
    path, everything = common.copy(), common.copy()
    path[:, -1, 0] = never_found
    everything[:, SOME] += never_found, 4 * never_found
    mean = np.full(PIXELS, 1 + never_found)
    variances = [np.full(PIXELS, variance) for variance in (0.5, 1.0)]
    film = CoarseFilm.whole(WIDTH, PIXELS // WIDTH)
    by_group = np.full((2, GROUPS, PIXELS), 1 / GROUPS)
    return Estimate(mean, variances, np.stack([path, everything]), by_group, film)


def test_missing_light_outweighs_noise_in_long_renders_only() -> None:
    short, long = (
        PredictedErrors.of(_estimate(0.02), WIDTH, spp, PIXELS) for spp in (16, 1 << 14)
    )
    assert short.variances[1] > 1.5 and long.variances[1] < 0.2
    for predicted in (short, long):
        np.testing.assert_allclose(predicted.missed, [0.02 / 1.02, 0])
        np.testing.assert_array_equal(predicted.long_run, [1, 0])


def test_a_millionth_of_the_light_is_not_missing() -> None:
    predicted = PredictedErrors.of(_estimate(1e-8), WIDTH, 1 << 14, PIXELS)
    np.testing.assert_allclose(predicted.long_run, [1, 2], rtol=1e-3)


def test_one_light_path_in_many_pixels_makes_a_prediction_uncertain() -> None:
    """It brings ``path`` half of its second moment in all pixels, which therefore agree."""
    estimate = _estimate(0.0)
    alike = PredictedErrors.of(estimate, WIDTH, 16, PIXELS)
    estimate.by_group[0, 0] += 1
    by_one = PredictedErrors.of(estimate, WIDTH, 16, PIXELS)
    assert alike.uncertainty[1] < 0.01 and by_one.uncertainty[1] > 0.5
    assert alike.uncertainty[0] == by_one.uncertainty[0] == 0
