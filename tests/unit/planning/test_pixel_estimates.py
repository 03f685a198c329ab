"""Estimates of pixels, on the device."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.images.box_filter import box_means, box_sums, exact_box_sums
from mitsuba_ext.planning.pixel_estimates import PixelEstimates

pytestmark = pytest.mark.usefixtures("variant")


def _estimates(image: np.ndarray) -> PixelEstimates:
    pixels = PixelEstimates(image.shape[1], image.shape[0])
    index = dr.arange(mi.UInt32, image.size)
    pixels.add(index, mi.Float(image.ravel().astype(np.float32)))
    return pixels


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (200, 3), (70, 64), (33, 131)])
def test_sums_on_the_device_are_exact(size: tuple[int, int]) -> None:
    """Also where running sums exceed 64 bits: only their differences count."""
    rng, (width, height) = np.random.default_rng(1), size
    images = rng.integers(0, 1 << 57, (2, height, width), dtype=np.uint64)
    images[0, 0, 0] = 1
    found = exact_box_sums(dr.cumsum(mi.UInt64(images.ravel())), width, height)
    expected = [box_sums(image) for image in images]
    np.testing.assert_array_equal(found.numpy().reshape(images.shape), expected)


def test_a_bright_pixel_leaves_the_means_of_others_exact() -> None:
    """A pixel that is 10⁶ times as bright precedes most of the others, row by row."""
    image = np.random.default_rng(2).uniform(0.5, 1.5, (96, 80))
    image[3, 5] = 1e6
    scale = _estimates(image).scale().numpy().reshape(image.shape)
    mean = box_means(image)
    expected = 1 / np.sqrt(mean**2 + 1e-2 * image.mean() ** 2)
    np.testing.assert_allclose(scale, expected, rtol=1e-4)


def test_errors_are_those_of_double_precision() -> None:
    rng = np.random.default_rng(3)
    image = rng.exponential(1e-3, (50, 70))
    image[10, 20] = 1e3
    weight, error = _estimates(image).importance(
        dr.arange(mi.UInt32, image.size), mi.Float(image.ravel().astype(np.float32))
    )
    mean = box_means(image)
    expected = 1 / (mean**2 + 1e-2 * image.mean() ** 2)
    np.testing.assert_allclose(weight.numpy(), expected.ravel(), rtol=1e-4)
    expected *= (image - mean) ** 2
    np.testing.assert_allclose(error.numpy(), expected.ravel(), rtol=1e-3, atol=1e-9)


def test_black_samples_precede_others() -> None:
    pixels = _estimates(np.zeros((4, 6)))
    index = dr.arange(mi.UInt32, 24)
    pixels.add(index, dr.full(mi.Float, 2e-8, 24))
    floor = 1e-2 * 1e-16
    np.testing.assert_allclose(
        pixels.scale().numpy(), 1 / np.sqrt(1e-16 + floor), rtol=1e-5
    )


def test_the_order_of_samples_does_not_matter() -> None:
    rng, found = np.random.default_rng(4), []
    pixel = rng.integers(0, 64, 1 << 14).astype(np.uint32)
    radiance = rng.exponential(1.0, 1 << 14).astype(np.float32)
    for order in (np.arange(len(pixel)), rng.permutation(len(pixel))):
        pixels = PixelEstimates(8, 8)
        pixels.add(mi.UInt32(pixel[order]), mi.Float(radiance[order]))
        found.append(pixels.scale().numpy())
    np.testing.assert_array_equal(*found)
