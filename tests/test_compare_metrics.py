"""The error figures against values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.compare import metrics


def constant(value: float, height: int = 2, width: int = 2) -> np.ndarray:
    return np.full((height, width, 3), value, dtype=np.float32)


def test_constant_images_give_the_formula():
    errors = metrics.errors(constant(3), constant(2))
    assert errors.mse == pytest.approx(1)
    assert errors.rmse == pytest.approx(1)
    # (3 − 2)² / (2² + 0.01 · 2²)
    assert errors.relmse == pytest.approx(1 / 4.04)


def test_floor_comes_from_the_mean_of_the_reference():
    reference = np.zeros((1, 2, 3), dtype=np.float32)
    reference[0, 0] = 2  # mean 1, ε = 0.01
    image = reference.copy()
    image[0, 1] = 0.1  # where the reference is black: 0.1² / 0.01 = 1, in one of two pixels
    assert metrics.relative_mse(image, reference) == pytest.approx(0.5)


def test_equal_images_have_no_error():
    assert metrics.errors(constant(1), constant(1)) == metrics.Errors(0, 0, 0, 0)


def test_variance_of_the_reference_is_subtracted():
    errors = metrics.errors(constant(3), constant(2), constant(0.25))
    assert errors.mse == pytest.approx(0.75)
    assert errors.rmse == pytest.approx(0.75**0.5)
    assert errors.relmse == pytest.approx(0.75 / 4.04)
    assert errors.relmse_trimmed == pytest.approx(0.75 / 4.04)
    assert metrics.reference_noise(constant(2), constant(0.25)) == pytest.approx(0.25 / 4.04)


def test_error_below_the_noise_of_the_reference_is_negative_and_has_no_root():
    errors = metrics.errors(constant(2), constant(2), constant(0.25))
    assert errors.mse == pytest.approx(-0.25)
    assert np.isnan(errors.rmse)


def test_subtraction_makes_a_noisy_reference_unbiased():
    rng = np.random.default_rng(1)
    shape, sigma_image, sigma_reference = (200, 200, 3), 0.3, 0.4
    image = 5 + sigma_image * rng.standard_normal(shape)
    reference = 5 + sigma_reference * rng.standard_normal(shape)
    errors = metrics.errors(image, reference, np.full(shape, sigma_reference**2))
    # Standard deviation of the mean of (I−R)²: √2 · 0.25 / √120 000 = 0.001
    assert errors.mse == pytest.approx(sigma_image**2, abs=0.004)


def test_trimming_drops_exactly_the_largest_thousandth():
    reference = constant(1, 40, 50)  # 2 000 pixels: two are dropped
    image = constant(2, 40, 50)
    image[3, 4] = image[5, 6] = 1000
    plain = 1 / 1.01
    assert metrics.errors(image, reference).relmse > 900
    assert metrics.errors(image, reference).relmse_trimmed == pytest.approx(plain)
    image[7, 8] = 1000  # a third firefly stays
    expected = (1997 * plain + 999**2 / 1.01) / 1998
    assert metrics.errors(image, reference).relmse_trimmed == pytest.approx(expected)


def test_one_pixel_is_never_trimmed_away():
    assert metrics.errors(constant(3, 1, 1), constant(2, 1, 1)).relmse_trimmed > 0


def test_precision_is_double():
    # In single precision, (1000.25 − 1000)² summed over a million values would be off
    errors = metrics.errors(constant(1000.25, 600, 600), constant(1000, 600, 600))
    assert errors.mse == pytest.approx(0.0625, rel=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_pixels_are_refused_and_located(value):
    image = constant(1, 4, 5)
    image[2, 3, 1] = value
    assert metrics.describe_non_finite(image) == "1 of 20 pixels not finite (first at x=3, y=2)"
    with pytest.raises(ValueError, match=r"image: 1 of 20 pixels not finite \(first at x=3, y=2\)"):
        metrics.errors(image, constant(1, 4, 5))
    with pytest.raises(ValueError, match="reference: 1 of 20"):
        metrics.errors(constant(1, 4, 5), image)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="shape"):
        metrics.errors(constant(1, 2, 3), constant(1, 3, 2))
    with pytest.raises(ValueError, match="variance"):
        metrics.errors(constant(1), constant(1), constant(1, 3, 3))


def test_black_reference_is_refused():
    with pytest.raises(ValueError, match="black"):
        metrics.errors(constant(1), constant(0))
