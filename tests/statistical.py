"""The integrators under test, and the statistics with which the tests judge them.

All statistics come from images of *independent seeds*: their scatter is the only estimate of the
noise, never a variance that the algorithm under test reports about itself. A Student t statistic
is given as the z score of equal probability, so that one threshold serves for any number of seeds.

The module is not called ``statistics``: pytest puts this folder on the path, where it would hide
the module of the standard library.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mitsuba_ext.decisions import guide_learner

SCENES = Path(__file__).parents[1] / "scenes"


@dataclass(frozen=True)
class UnderTest:
    """An integrator under test.

    Attributes:
        plugin: The name of the plugin.
        parameters: Besides ``max_depth``.
        min_depth, max_depth: The values of ``max_depth`` that it can render; -1 is tested where
            ``unlimited``.
        draws_like_path: At the same seed, does it draw the numbers that ``path`` draws?
        insists: Does it guide whatever that gains? On the small films of tests it gains little.
    """

    plugin: str
    parameters: dict[str, Any] = field(default_factory=dict)
    min_depth: int = 0
    max_depth: float = math.inf
    unlimited: bool = True
    draws_like_path: bool = False
    insists: bool = False

    def can_render(self, max_depth: int) -> bool:
        return self.unlimited if max_depth == -1 else self.min_depth <= max_depth <= self.max_depth

    def make(self, max_depth: int = -1, **parameters: Any) -> mi.Integrator:
        """The integrator; it takes the place of the scene's own in ``mi.render``."""
        integrator = mi.load_dict(
            {"type": self.plugin, "max_depth": max_depth, **self.parameters, **parameters}
        )
        if self.insists:
            integrator.render = insisting(integrator.render)
        return integrator


def insisting(render: Callable) -> Callable:
    """Guides all bounces, whatever the learner measures."""

    def whatever_it_gains(gains: dict[float, np.ndarray]) -> tuple[float, int, float, float]:
        share, _bounces, gain, _efficiency = best(gains)
        return share, len(gains[share]), gain, math.inf

    def insisting_render(*arguments: Any, **options: Any) -> mi.TensorXf:
        with mock.patch.object(guide_learner, "_best", whatever_it_gains):
            return render(*arguments, **options)

    best = guide_learner._best
    return insisting_render


#: Add a new integrator here: furnaces, z-tests and hard cases are then run on it.
UNDER_TEST: dict[str, UnderTest] = {
    "composed_path": UnderTest("composed_path", draws_like_path=True),
    "neepp": UnderTest("neepp"),
    "pss_guided": UnderTest("pss_guided", insists=True),
}

#: What they are compared with.
REFERENCE = UnderTest("path", draws_like_path=True)

#: Settings under which more is learned or gambled: unbiased all the same. The films of the tests
#: are so small that the default pilot learns little.
_TRAINED = {"pilot_spp": 32, "grid": 8}
_REJECTING = {**_TRAINED, "rejection": True}
_MAPPED = {**_REJECTING, "light_sampling": "uniform"}
UNUSUAL: dict[str, UnderTest] = {
    "trained": UnderTest("neepp", _TRAINED),
    "visibility": UnderTest("neepp", {**_TRAINED, "light_sampling": "visibility"}),
    "grid_64": UnderTest("neepp", {"pilot_spp": 16, "grid": 64}),
    "grid_1": UnderTest("neepp", {**_TRAINED, "grid": 1}),
    "rejecting": UnderTest("neepp", _REJECTING),
    "rejecting_paper": UnderTest("neepp", {**_REJECTING, "law": "paper", "grid": 4}),
    # Every connection is tested with the same small probability
    "rejecting_floor": UnderTest("neepp", {**_REJECTING, "slope": 0.0, "floor": 0.1}),
    # Rejection alone, by the map of pairs of voxels
    "mapped": UnderTest("neepp", _MAPPED),
    "mapped_paper": UnderTest("neepp", {**_MAPPED, "law": "paper", "grid": 4}),
    "mapped_floor": UnderTest("neepp", {**_MAPPED, "slope": 0.0, "floor": 0.1}),
    # Lights by power, by distance, by a loop over all of them; nothing is learned
    "power": UnderTest("composed_path", {"next_event": "power"}),
    "spatial": UnderTest("composed_path", {"next_event": "spatial"}),
    "linear": UnderTest("composed_path", {"next_event": "linear"}),
    "tiles": UnderTest("pss_guided", {"regions": "tiles", "tile": 5}, insists=True),
    "many_connections": UnderTest("reweighted_direct", {"light_samples": 4}),
}

#: Single tests accept |z| below this (p = 6e-5); several at once, its Šidák correction.
THRESHOLD = 4.0

#: Seeds of the integrators under test. Those of ``path`` are others: with equal numbers drawn, the
#: difference of two images says nothing about their noise.
SEEDS = range(1, 17)
REFERENCE_SEEDS = range(1001, 1017)

#: Relative rounding error that a mean of many floats may have.
_ROUNDING = 2e-6


def load(name: str, **options: Any) -> mi.Scene:
    """One of our scenes, in the active variant. Let go of it after use: Dr.Jit compiles the methods
    of *all* objects that exist into each kernel."""
    return mi.load_file(str(SCENES / f"{name}.xml"), **options)


def batches(
    scene: mi.Scene, integrator: mi.Integrator, spp: int, seeds: Iterable[int]
) -> np.ndarray:
    """Images of independent seeds, as an array [seed, height, width, channel]."""
    images = []
    for seed in seeds:
        images.append(np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp)))
    dr.sync_thread()
    return np.asarray(images, dtype=np.float64)


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
        regions, tiles: z scores; see the functions of that name.
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


def assert_same_mean(
    a: np.ndarray,
    b: np.ndarray,
    precision: float = 0.02,
    tile: int = 8,
    tolerance: float = 0.0,
) -> Comparison:
    """Fails if the means differ, or are known so badly that the test says nothing. ``tolerance`` is
    for colours outside of the gamut."""
    assert_images_are_sound(a, tolerance)
    assert_images_are_sound(b, tolerance)
    result = compare(a, b, tile)
    assert np.abs(result.regions).max() < sidak(result.regions.size), str(result)
    assert np.abs(result.tiles).max() < sidak(result.tiles.size), str(result)
    assert result.precision <= precision, f"too noisy to say anything: {result}"
    return result


def assert_exact(
    images: np.ndarray,
    exact: float,
    pixels: tuple[slice, slice] = (slice(None), slice(None)),
    uniform: bool = True,
    allowance: float = 0.0,
    precision: float = 0.02,
) -> float:
    """The mean over ``pixels`` is ``exact``, and where the answer is ``uniform``, that of each
    tile of them too. Returns the relative standard error of the mean."""
    assert_images_are_sound(images)
    part = images[:, pixels[0], pixels[1]]
    if exact == 0:
        assert not part.any()
        return 0.0
    z, error = z_exact(part.mean(axis=(1, 2, 3)), exact, allowance)
    assert abs(z) < THRESHOLD, f"mean {part.mean():.6g} instead of {exact:.6g}: z = {z:.2f}"
    assert error <= precision, f"too noisy to say anything: relative standard error {error:.2%}"
    if uniform:
        scores = [z_exact(column, exact, allowance)[0] for column in tiles(part, 8).T]
        assert max(map(abs, scores)) < sidak(len(scores)), f"tiles: z up to {max(scores)}"
    return error
