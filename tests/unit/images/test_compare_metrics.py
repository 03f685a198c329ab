"""The error figures against values computed by hand."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from mitsuba_ext.images import flip, metrics

needs_flip = pytest.mark.skipif(flip._evaluator() is None, reason="flip-evaluator is not installed")


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


@needs_flip
def test_equal_images_have_no_error():
    assert metrics.errors(constant(1), constant(1)) == metrics.Errors(0, 0, 0, 0, 0, 0, 0)


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


def test_errors_between_seeds_are_the_relative_variance():
    images = np.random.default_rng(3).gamma(4, 0.5, (6, 24, 32, 3))
    images[2, 5, 7] = 1e4  # the only pixel that is trimmed: 0.1 % of 768
    scale = np.full((24, 32, 3), 2.0)
    found = metrics.errors_between_seeds(images, scale)
    variance = images.var(axis=0, ddof=1) / (4 + 0.04)
    assert np.mean([e.relmse for e in found]) == pytest.approx(variance.mean())
    rest = variance[np.arange(24 * 32).reshape(24, 32) != 5 * 32 + 7]
    assert np.mean([e.relmse_trimmed for e in found]) == pytest.approx(rest.mean())
    assert all(np.isnan(e.flip) for e in found)
    # The error of each image against the mean of the others, less the variance of this mean
    others = np.delete(images, 4, axis=0)
    own = metrics.errors(images[4], others.mean(axis=0), others.var(axis=0, ddof=1) / 5, flip=False)
    assert found[4].mse == pytest.approx(own.mse)
    assert all(np.isnan(e.relmse) for e in metrics.errors_between_seeds(images[:2], scale))


def test_one_pixel_is_never_trimmed_away():
    assert metrics.errors(constant(3, 1, 1), constant(2, 1, 1)).relmse_trimmed > 0


def test_precision_is_double():
    # In single precision, (1000.25 − 1000)² summed over a million values would be off
    errors = metrics.errors(constant(1000.25, 600, 600), constant(1000, 600, 600), flip=False)
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


def test_images_must_be_rgb():
    with pytest.raises(ValueError, match=r"expected \(height, width, 3\)"):
        metrics.errors(np.ones((2, 2, 1)), np.ones((2, 2, 1)))


def test_relative_mse_is_the_plain_expression():
    rng = np.random.default_rng(2)
    image, reference = (rng.gamma(0.5, 2, (30, 40, 3)) for _ in range(2))
    expected = np.mean((image - reference) ** 2 / (reference**2 + 0.01 * np.mean(reference) ** 2))
    assert metrics.relative_mse(image, reference) == pytest.approx(expected, rel=1e-12)


# ---- σ/μ ----


@pytest.mark.parametrize("channel, weight", [(0, 0.299), (1, 0.587), (2, 0.114)])
def test_sigma_mu_weighs_the_channels(channel, weight):
    image = constant(2)
    image[:, :, channel] += 3
    assert metrics.errors(image, constant(2)).sigma_mu == pytest.approx(3 * weight / 2)


def test_sigma_mu_of_a_coloured_pixel():
    reference = np.float32([[[1, 2, 3], [0, 0, 0]]])
    image = np.float32([[[2, 1, 3], [0, 0, 10]]])
    # Colour differences 0.299·1 + 0.587·|−1| = 0.886 and 0.114·10 = 1.14: opposite signs add up
    sigma = ((0.886**2 + 1.14**2) / 2) ** 0.5
    mu = (0.299 * 1 + 0.587 * 2 + 0.114 * 3) / 2
    assert metrics.errors(image, reference).sigma_mu == pytest.approx(sigma / mu)


def test_sigma_mu_contains_the_noise_of_the_reference():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((2, 300, 300, 1))
    image, reference = 5 + noise[0] * [1, 1, 1], 5 + noise[1] / 4 * [1, 1, 1]  # as 16 × the samples
    errors = metrics.errors(image, reference, np.full(reference.shape, 1 / 16), flip=False)
    assert errors.rmse == pytest.approx(1, rel=0.01)
    assert errors.sigma_mu == pytest.approx(1 / 5 * (1 + 1 / 16) ** 0.5, rel=0.01)


def test_sigma_mu_of_a_reference_of_negative_luminance_is_unknown():
    assert np.isnan(metrics.errors(constant(1), constant(-1), flip=False).sigma_mu)


# ---- FLIP ----


def noisy_pair(shape=(24, 32), scale=1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    reference = scale * rng.gamma(1, 1, (*shape, 3))
    return (reference * rng.gamma(9, 1 / 9, reference.shape)).astype(np.float32), reference


@needs_flip
def test_flip_agrees_with_the_package():
    import flip_evaluator

    image, reference = noisy_pair()
    error_map, _, exposures = flip_evaluator.evaluate(
        reference.astype(np.float32), image, "HDR", applyMagma=False
    )
    assert exposures["numExposures"] > 2
    assert flip.mean_flip(image, reference) == pytest.approx(error_map.mean(), rel=1e-4)
    assert metrics.errors(image, reference).flip == flip.mean_flip(image, reference)


@needs_flip
def test_flip_lies_between_zero_and_one_and_grows_with_the_error():
    image, reference = noisy_pair()
    halfway = (image + reference) / 2
    figures = [flip.mean_flip(values, reference) for values in (reference, halfway, image)]
    assert figures[0] == 0 < figures[1] < figures[2] < 1
    white = np.full_like(reference, 1e6)
    assert figures[2] < flip.mean_flip(white, reference) <= 1


@needs_flip
@pytest.mark.parametrize("scale", [1e-30, 1e-9, 1e6, 1e20])
def test_flip_does_not_depend_on_the_scale_of_the_radiance(scale):
    expected = flip.mean_flip(*noisy_pair())
    image, reference = noisy_pair()
    scaled = flip.mean_flip(image * np.float64(scale), reference * scale)
    assert scaled == pytest.approx(expected, rel=1e-4)


@needs_flip
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 50), (50, 1)])
def test_flip_of_tiny_images(shape):
    assert 0 < flip.mean_flip(*noisy_pair(shape)) < 1
    assert flip.mean_flip(constant(1, *shape), constant(1, *shape)) == 0


@needs_flip
def test_flip_of_constant_images():
    figures = [flip.mean_flip(constant(value), constant(1)) for value in (1.1, 2, 1e6, 1e25)]
    assert 0 < figures[0] < figures[1] < figures[2]
    # White is white: FLIP sees no difference above what a display can show
    assert figures[2] == pytest.approx(figures[3], abs=1e-6)


@needs_flip
def test_flip_counts_negative_values_as_black():
    image, reference = noisy_pair()
    clipped = flip.mean_flip(np.maximum(image - 0.5, 0), np.maximum(reference - 0.4, 0))
    assert flip.mean_flip(image - np.float32(0.5), reference - 0.4) == clipped
    assert metrics.errors(image - 5, reference, flip=True).mse > 20  # the other figures do not


@needs_flip
def test_flip_of_a_mostly_black_reference():
    image, reference = noisy_pair()
    image[:20] = reference[:20] = 0
    assert 0 < flip.mean_flip(image, reference) < 1
    assert 0 < flip.mean_flip(image * 0, reference) < 1
    reference[-1, -1] = 1e8  # the range of exposures is bounded
    assert 0 < flip.mean_flip(image, reference) < 1


def test_flip_of_a_black_reference_is_unknown():
    assert np.isnan(flip.mean_flip(constant(1), constant(0)))
    assert np.isnan(flip.mean_flip(constant(1), constant(-1)))
    assert np.isnan(flip.mean_flip(constant(0), constant(0)))


@needs_flip
def test_flip_is_deterministic_and_takes_any_memory_layout(capfd):
    image, reference = noisy_pair((64, 48))
    expected = flip.mean_flip(image, reference)
    assert flip.mean_flip(image, reference) == expected
    assert flip.mean_flip(image.astype(np.float64), np.asfortranarray(reference)) == expected
    flipped = flip.mean_flip(image[:, ::-1], reference[:, ::-1])
    assert flipped == pytest.approx(expected, rel=1e-4)
    assert capfd.readouterr() == ("", "")


def test_flip_can_be_left_out(monkeypatch):
    monkeypatch.setattr(metrics, "mean_flip", None)
    errors = metrics.errors(constant(2), constant(1), flip=False)
    assert np.isnan(errors.flip) and errors.mse == 1
    assert metrics.relative_mse(constant(1), constant(1)) == 0


def test_flip_is_unknown_without_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    errors = metrics.errors(constant(2), constant(1))
    assert np.isnan(errors.flip) and errors.mse == 1


@needs_flip
def test_flip_and_mitsuba_share_a_process_in_any_order():
    # Both bring threads, and flip-evaluator an OpenMP of its own; here, Mitsuba comes first
    code = """
import flip_evaluator, mitsuba_ext
import mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "view": {
    "type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 6}}})
for _ in range(2):
    ones = np.array(mi.render(scene, spp=1, integrator=mi.load_dict({"type": "path"})))
    print(ones.shape, flip_evaluator.evaluate(ones, 2 * ones, "HDR")[1])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("(6, 8, 3) 0.1448") == 2
