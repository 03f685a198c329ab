"""The statistics with which tests judge images.

The noise of a mean is estimated from the scatter of independent images, never from a variance that
the algorithm under test reports about itself. Two seeds are enough if the errors of pixels are
independent: the difference of the two images, over all pixels, estimates the noise as well as many
seeds do. That requires a ``box`` filter, so that no sample contributes to two pixels. It also holds
for integrators that learn, because the errors of the samples after the learning are independent of
what was learned. It does not hold if one sample contributes to many pixels (light paths, photons),
or if pixels share random numbers: these need many seeds (:func:`assert_same_mean`).

A Student t statistic is converted to the z score of equal probability, so that one threshold is
valid for any number of seeds or pixels.

The module is not called ``statistics``: pytest puts this folder on the path, where it would hide
the module of the standard library.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.startup.garbage import garbage_left_alone
from tests.support.paths import ROOT

SCENES = ROOT / "scenes"

#: Single tests accept |z| below this (p = 6e-5); several at once, its Šidák correction.
THRESHOLD = 4.0

#: Seeds of the integrators under test. ``path`` has others: with equal random numbers, the
#: difference of two images would not show their noise.
SEEDS = range(1, 17)
REFERENCE_SEEDS = range(1001, 1017)

#: Number of seeds if a light path brings light to many pixels, whose errors depend on each other.
MANY_SEEDS = 8

#: Relative rounding error that a mean of many floats may have.
_ROUNDING = 2e-6


def load(name: str, **options: Any) -> mi.Scene:
    """One of our scenes, in the active variant. Delete it after use: Dr.Jit compiles the methods of
    *all* living objects into each kernel."""
    return mi.load_file(str(SCENES / f"{name}.xml"), **options)


def some(*quick: Any, of: Iterable[str]) -> list:
    """Parameters of a test; all but the ``quick`` ones are marked ``slow``: each takes seconds to
    compile."""
    rows = [x if isinstance(x, tuple) else (x,) for x in of]
    marks = [() if x in quick else pytest.mark.slow for x in of]
    return [pytest.param(*row, marks=mark) for row, mark in zip(rows, marks)]


def batches(
    scene: mi.Scene, integrator: mi.Integrator, spp: int, seeds: Iterable[int]
) -> np.ndarray:
    """Images of independent seeds, as an array [seed, height, width, channel]."""
    images = []
    with _one_thread_per_worker(), garbage_left_alone():
        for seed in seeds:
            images.append(np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp)))
        dr.sync_thread()
    return np.asarray(images, dtype=np.float64)


def two_halves(
    scene: mi.Scene, integrator: mi.Integrator, spp: int, seeds: Iterable[int]
) -> np.ndarray:
    """Two images of half of the samples each; their difference estimates the noise of the mean."""
    first, second, *_ = seeds
    return batches(scene, integrator, spp // 2, [first, second])


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """With one thread of Dr.Jit, floats are added in the same order: the same seed gives bitwise
    the same image. No EXR file may be read or written meanwhile: Mitsuba 3.9.1 would wait for
    ever."""
    count = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(count)


def _one_thread_per_worker() -> contextlib.AbstractContextManager[None]:
    """Where a process for each core runs tests, its other threads would only wait for work, and
    keep the cores busy with that."""
    return one_thread() if "PYTEST_XDIST_WORKER" in os.environ else contextlib.nullcontext()


def assert_images_are_sound(images: np.ndarray, tolerance: float = 0.0) -> None:
    """Finite and non-negative pixels. ``tolerance`` is for filters with negative lobes."""
    assert np.isfinite(images).all(), f"{(~np.isfinite(images)).sum()} values are not finite"
    assert images.min(initial=0.0) >= -tolerance, f"the least value is {images.min()}"


def assert_same_image(a: np.ndarray, b: np.ndarray, share: float = 0.98) -> None:
    """Two images of the same random numbers: equal to float precision in a ``share`` of all values
    (a rounding error can send one path elsewhere), and in the mean. NaN and ∞ fail."""
    scale = np.abs(b).mean()
    assert a.shape == b.shape
    same = np.isclose(a, b, rtol=1e-4, atol=1e-5 * scale)
    assert same.mean() >= share, f"{1 - same.mean():.1%} of the values differ"
    np.testing.assert_allclose(a.mean(), b.mean(), rtol=1e-3, atol=1e-7 * scale)


def sidak(tests: int) -> float:
    """The threshold for the largest of ``tests`` |z| scores: as likely to be exceeded by chance as
    ``THRESHOLD`` is by one."""
    single = 2 * stats.norm.sf(THRESHOLD)
    return float(stats.norm.isf(-math.expm1(math.log1p(-single) / tests) / 2))


def z_exact(samples: np.ndarray, exact: float, allowance: float = 0.0) -> tuple[float, float]:
    """How far the mean of independent ``samples`` is from ``exact``.

    Returns:
        The z score (of the part of the deviation that exceeds ``allowance``), and the relative
        standard error of the mean.
    """
    mean, error = samples.mean(), samples.std(ddof=1) / math.sqrt(len(samples))
    deviation = max(0.0, abs(mean - exact) - allowance - _ROUNDING * abs(exact))
    z = _as_normal(np.array(deviation), np.array(error), np.array(len(samples) - 1.0))
    return math.copysign(float(z), mean - exact), float(error / max(abs(exact), 1e-30))


def z_welch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Welch's test for equal means of ``a`` and ``b``, [seed, …] each: z scores, […]."""
    errors = [x.var(axis=0, ddof=1) / len(x) for x in (a, b)]
    total = errors[0] + errors[1]
    terms = [e**2 / (len(x) - 1) for e, x in zip(errors, (a, b))]
    positive = total > 0
    # Welch–Satterthwaite; without any variance the degrees of freedom do not matter
    freedom = np.where(positive, total**2 / np.where(positive, terms[0] + terms[1], 1), 1.0)
    difference = a.mean(axis=0) - b.mean(axis=0)
    rounding = _ROUNDING * (np.abs(a).mean(axis=0) + np.abs(b).mean(axis=0))
    deviation = np.maximum(0, np.abs(difference) - rounding)
    return np.copysign(_as_normal(deviation, np.sqrt(total), np.maximum(freedom, 1)), difference)


def _as_normal(deviation: np.ndarray, error: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """The z score that is as unlikely as the t statistic deviation / error."""
    t = np.divide(deviation, error, out=np.full(error.shape, np.inf), where=error > 0)
    z = stats.norm.isf(stats.t.sf(t, freedom))
    return np.where(deviation <= 0, 0.0, z)


def regions(images: np.ndarray) -> np.ndarray:
    """Means of the whole image and of its four quarters, per channel: [seed, 5 · channels]."""
    height, width = images.shape[1:3]
    top, left = max(1, height // 2), max(1, width // 2)
    whole = images.mean(axis=(1, 2))
    quarters = [
        part.mean(axis=(1, 2)) if part.size else whole
        for rows in (images[:, :top], images[:, top:])
        for part in (rows[:, :, :left], rows[:, :, left:])
    ]
    return np.concatenate([whole, *quarters], axis=1)


def assert_same_quarters(
    images: np.ndarray, expected: np.ndarray, precision: float, paired: bool = False
) -> None:
    """The image and its quarters have the expected means. Only renders of different seeds count as
    independent: a light path brings light to many pixels.

    Parameters:
        images, expected: Of several seeds each: [seed, y, x, channel].
        precision: Relative standard error of the difference of the image means, at most.
        paired: Have the images of a seed the same camera rays? Then the noise of what these see
            directly cancels.
    """
    assert np.isfinite(images).all()
    # Some single wavelengths have negative components
    assert mi.is_spectral or images.min() >= 0
    assert expected.any(), "a black image proves nothing"
    means = [regions(x.mean(axis=-1, keepdims=True)) for x in (images, expected)]
    ratio, scale = means[0][:, 0].mean() / means[1][:, 0].mean(), means[1][:, 0].mean()
    if paired:
        means = [means[0] - means[1], np.zeros_like(means[1])]
    z = z_welch(*means)
    error = np.sqrt(sum(mean[:, 0].var(ddof=1) / len(mean) for mean in means)) / scale
    # Five parts: a little more than THRESHOLD
    assert np.abs(z).max() < THRESHOLD + 0.4, f"z = {z.round(2)}, ratio of the means {ratio:.4f}"
    assert error <= precision, f"known to {error:.2%} only"


def tiles(images: np.ndarray, size: int) -> np.ndarray:
    """Means over tiles of ``size`` × ``size`` pixels and all channels: [seed, tiles]. A sum over
    many pixels is near enough to a normal distribution for a t test; one pixel often is not."""
    height, width = images.shape[1:3]
    return np.stack(
        [
            images[:, y : y + size, x : x + size].mean(axis=(1, 2, 3))
            for y in range(0, height, size)
            for x in range(0, width, size)
        ],
        axis=1,
    )


@dataclass
class Comparison:
    """Two integrators on one scene.

    Attributes:
        regions, tiles: z scores of the image and its quarters, per channel, and of tiles.
        precision: Relative standard error of the difference of the image means, the noise of both
            included. A test that passes at 0.02 has shown agreement to about 6 % only.
    """

    regions: np.ndarray
    tiles: np.ndarray
    precision: float

    def __str__(self) -> str:
        return (
            f"regions: z up to {np.abs(self.regions).max():.2f} of {sidak(self.regions.size):.2f}; "
            f"tiles: z up to {np.abs(self.tiles).max():.2f} of {sidak(self.tiles.size):.2f}; "
            f"image means known to {self.precision:.2%}"
        )


def compare(a: np.ndarray, b: np.ndarray, tile: int = 8) -> Comparison:
    """Compares images of independent seeds, [seed, height, width, channel] each."""
    means = [images.mean(axis=(1, 2, 3)) for images in (a, b)]
    error = math.sqrt(sum(m.var(ddof=1) / len(m) for m in means))
    precision = error / max(abs(means[1].mean()), 1e-30)
    return Comparison(
        z_welch(regions(a), regions(b)), z_welch(tiles(a, tile), tiles(b, tile)), precision
    )


def compare_pixels(a: np.ndarray, b: np.ndarray, tile: int = 8, unit: int = 1) -> Comparison:
    """Compares images, [seed, height, width, channel] each, of two seeds at least.

    Parameters:
        tile: Edge of the tiles.
        unit: Edge of the squares whose errors are assumed to be independent: more than 1 for
            filters wider than a pixel.
    """
    height, width = a.shape[1:3]
    # Neighbouring squares share the samples at their border: measured for a gaussian filter
    caution = 1.0 if unit == 1 else 1.2

    def z(part: tuple[slice, slice], channels: slice = slice(None)) -> tuple[float, float]:
        means = [tiles(x[:, part[0], part[1], channels], unit) for x in (a, b)]
        return z_of_means(*means, caution)

    quarters = _cut(height, width, max(1, height // 2), max(1, width // 2))
    parts = [(slice(None), slice(None)), *quarters]
    channels = range(a.shape[3])
    by_part = [z(part, slice(c, c + 1))[0] for part in parts for c in channels]
    by_tile = [z(part)[0] for part in _cut(height, width, tile, tile)]
    scale = max(abs(b.mean()), 1e-30)
    return Comparison(np.array(by_part), np.array(by_tile), z(parts[0])[1] / scale)


def z_of_means(
    a: np.ndarray, b: np.ndarray | float, caution: float = 1.0, allowance: float = 0.0
) -> tuple[float, float]:
    """Tests whether the means of ``a`` and ``b`` (or a number) agree. Both have the shape [seed,
    value]: the values of a seed may have different means, and their errors are independent.

    Returns:
        The z score (of the part of the difference that exceeds ``allowance``), and the standard
        error of the difference, which is multiplied by ``caution``.
    """
    variances, terms, means, rounding = 0.0, 0.0, [], 0.0
    for x in (a, np.asarray(b)):
        means.append(x.mean())
        rounding += _ROUNDING * np.abs(x).mean()
        if x.ndim == 2:
            each = x.var(axis=0, ddof=1) / len(x) / x.shape[1] ** 2
            variances += each.sum()
            terms += (each**2).sum() / (len(x) - 1)
    difference = means[0] - means[1]
    # Welch–Satterthwaite: if few values make most of the noise, there are few degrees of freedom
    freedom = variances**2 / terms if terms > 0 else 1.0
    error = caution * math.sqrt(variances)
    deviation = max(0.0, abs(difference) - rounding - allowance)
    z = _as_normal(np.array(deviation), np.array(error), np.array(max(freedom, 1.0)))
    return math.copysign(float(z), difference), error


def _cut(height: int, width: int, rows: int, columns: int) -> list[tuple[slice, slice]]:
    """Tiles of at most ``size`` rows and columns."""
    return [
        (slice(y, y + rows), slice(x, x + columns))
        for y in range(0, height, rows)
        for x in range(0, width, columns)
    ]


def assert_same_mean(
    a: np.ndarray,
    b: np.ndarray,
    precision: float = 0.02,
    tile: int = 8,
    tolerance: float = 0.0,
) -> Comparison:
    """Fails if the means of images of independent seeds differ, or if their noise leaves the test
    without power. ``tolerance`` is for colours outside of the gamut."""
    return _assert_agreement(a, b, compare(a, b, tile), precision, tolerance)


def assert_same_pixels_on_average(
    a: np.ndarray,
    b: np.ndarray,
    precision: float = 0.02,
    tile: int = 8,
    unit: int = 1,
    tolerance: float = 0.0,
) -> Comparison:
    """Like :func:`assert_same_mean`, for two images of each. The noise is estimated from the
    scatter in all pixels: see :func:`compare_pixels`."""
    return _assert_agreement(a, b, compare_pixels(a, b, tile, unit), precision, tolerance)


def _assert_agreement(
    a: np.ndarray, b: np.ndarray, result: Comparison, precision: float, tolerance: float
) -> Comparison:
    assert_images_are_sound(a, tolerance)
    assert_images_are_sound(b, tolerance)
    assert b.any(), "a black image proves nothing"
    assert np.abs(result.regions).max() < sidak(result.regions.size), str(result)
    assert np.abs(result.tiles).max() < sidak(result.tiles.size), str(result)
    assert result.precision <= precision, f"too noisy to say anything: {result}"
    print(result)
    return result


def assert_exact(
    images: np.ndarray,
    exact: float,
    pixels: tuple[slice, slice] = (slice(None), slice(None)),
    uniform: bool = True,
    allowance: float = 0.0,
    precision: float = 0.02,
    independent: bool = True,
) -> float:
    """Asserts that the mean over ``pixels`` is ``exact``, and the mean of each tile too if each
    pixel has that value (``uniform``). Returns the relative standard error of the mean.

    Parameters:
        images: Of two seeds at least, with a box filter: [seed, height, width, channel].
        independent: True if the errors of pixels do not depend on each other. If they do, many
            seeds are needed.
    """
    assert_images_are_sound(images)
    part = images[:, pixels[0], pixels[1]].mean(axis=3)
    if exact == 0:
        assert not part.any()
        return 0.0

    def z(rows: slice, columns: slice) -> tuple[float, float]:
        values = part[:, rows, columns].reshape(len(part), -1)
        if not independent:
            values = values.mean(axis=1, keepdims=True)
        return z_of_means(values, exact, allowance=allowance)

    score, error = z(slice(None), slice(None))
    error /= exact
    assert abs(score) < THRESHOLD, f"mean {part.mean():.6g} instead of {exact:.6g}: z = {score:.2f}"
    assert error <= precision, f"too noisy to say anything: relative standard error {error:.2%}"
    if uniform:
        scores = [abs(z(*tile)[0]) for tile in _cut(*part.shape[1:], 8, 8)]
        limit = sidak(len(scores))
        assert max(scores) < limit, f"tiles: z up to {max(scores):.2f} of {limit:.2f}"
    print(f"mean {part.mean():.6g}, exact {exact:.6g}: z = {score:.2f}, known to {error:.3%}")
    return error
