"""Samplers that draw points of sequences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.stage import stage
from tests.support.statistical import some

pytestmark = pytest.mark.usefixtures("variant")

SAMPLERS = ["sobol_owen", "halton", "hammersley", "faure", "lattice", "latin_hypercube"]
#: Those whose aligned ranges of 2^k samples are stratified.
BINARY = ["sobol_owen", "lattice"]


def _seeded(kind: str, count: int, pixels: int = 1, seed: int = 0, **parameters: Any) -> mi.Sampler:
    sampler = mi.load_dict({"type": kind, "sample_count": count, **parameters})
    sampler.seed(seed, count * pixels)
    return sampler


def _points(sampler: mi.Sampler, pairs: int, pixels: int = 1) -> np.ndarray:
    """The points of each pixel: [pixel, sample, dimension]."""
    drawn = [np.array(sampler.next_2d()).T for _ in range(pairs)]
    return np.concatenate(drawn, axis=1).reshape(pixels, -1, 2 * pairs)


def _cells(x: np.ndarray, y: np.ndarray, nx: int, ny: int) -> int:
    """How many of the cells of a grid hold a point."""
    return len(set(zip((x * nx).astype(int).tolist(), (y * ny).astype(int).tolist())))


# ---- One point in each interval ----


@pytest.mark.parametrize("count", [1, 16, 21])
@pytest.mark.parametrize("kind", SAMPLERS)
def test_each_number_is_stratified(kind: str, count: int) -> None:
    base = {"halton": (2, 3), "hammersley": (count, 2), "faure": (5, 5)}.get(kind, (2, 2))
    if kind == "latin_hypercube":
        base = (count, count)
    points = _points(_seeded(kind, count, 5), 2, 5)[:, :, :2]
    assert points.min() >= 0
    assert points.max() < 1
    for pixel in points:
        for x, b in zip(pixel.T, base):
            # The largest power of the base that is not above the number of samples
            n = next(b**k for k in range(40, -1, -1) if b**k <= max(count, 1))
            # 21 samples are no aligned range, the first 16 are
            part = x[:n] if kind in BINARY else x
            found = np.bincount((part * n).astype(int), minlength=n)
            assert found.min() >= 1
            assert found.max() <= -(-len(part) // n)


@pytest.mark.parametrize("dimensions", [2, 4, 8])
def test_pairs_of_sobol_owen_are_stratified_in_all_cells_of_equal_area(dimensions: int) -> None:
    """The first pair of each set is a (0, m, 2)-net, and so are aligned ranges of its points."""
    m, count = 6, 64
    points = _points(_seeded("sobol_owen", count, 3, dimensions=dimensions), dimensions, 3)
    for pixel in points:
        for first in (0, dimensions):
            for part, bits in ((slice(0, count), m), (slice(32, 48), 4)):
                x, y = pixel[part, first], pixel[part, first + 1]
                for k in range(bits + 1):
                    assert _cells(x, y, 2**k, 2 ** (bits - k)) == 2**bits


@pytest.mark.parametrize("dimensions", [4, 6, 8])
def test_points_of_faure_are_a_net_in_any_two_dimensions(dimensions: int) -> None:
    base = {4: 5, 6: 7, 8: 11}[dimensions]
    pixel = _points(_seeded("faure", base**2, dimensions=dimensions), dimensions // 2)[0]
    for i in range(dimensions):
        for j in range(i):
            assert _cells(pixel[:, i], pixel[:, j], base, base) == base**2


def test_direction_numbers_agree_with_scipy() -> None:
    from mitsuba_ext.util.sequences.sobol import _direction_numbers

    columns = _direction_numbers(8)
    theirs = stats.qmc.Sobol(8, scramble=False, bits=32).random(1024)
    for index in (1, 2, 5, 77, 640, 1023):
        gray = index ^ (index >> 1)
        bits = [k for k in range(32) if gray >> k & 1]
        ours = np.bitwise_xor.reduce(columns[:, bits], axis=1) / 2.0**32
        np.testing.assert_array_equal(ours, theirs[index])


@pytest.mark.parametrize("kind", ["sobol_owen", "halton", "faure", "hammersley"])
def test_discrepancy_is_less_than_for_random_points(kind: str) -> None:
    points = _points(_seeded(kind, 128, 4), 2, 4)
    independent = np.random.default_rng(1).random(points.shape)
    ours, theirs = (
        np.mean([stats.qmc.discrepancy(pixel) for pixel in p]) for p in (points, independent)
    )
    assert ours < 0.4 * theirs


# ---- Random and independent ----


@pytest.mark.parametrize("kind", SAMPLERS)
def test_numbers_of_one_sample_are_uniform_over_pixels(kind: str) -> None:
    """Chi²: of one sample of a pixel, dimension by dimension, and of neighbouring dimensions."""
    pixels, cells = 20000, 16
    points = _points(_seeded(kind, 12, pixels), 5, pixels)
    for sample in (0, 7):
        for d in range(10):
            # In the whole interval, and in its small parts: points at their edges would be a bias
            for x in (points[:, sample, d], points[:, sample, d] * 48 % 1):
                found = np.bincount((x * cells).astype(int), minlength=cells)
                assert stats.chisquare(found).pvalue > 1e-5
        for d in range(9):
            cell = [(points[:, sample, k] * 4).astype(int) for k in (d, d + 1)]
            found = np.bincount(4 * cell[0] + cell[1], minlength=16)
            assert stats.chisquare(found).pvalue > 1e-5


@pytest.mark.parametrize("kind", SAMPLERS)
def test_pixels_seeds_and_sets_are_independent(kind: str) -> None:
    pixels = 4000
    points = _points(_seeded(kind, 4, pixels), 4, pixels)
    others = _points(_seeded(kind, 4, pixels, seed=1), 4, pixels)
    z = np.sqrt(pixels)
    for a, b in (
        (points[:-1, 0, 0], points[1:, 0, 0]),
        (points[:, 0, 0], others[:, 0, 0]),
        # Pixel p at a seed, and its neighbour at the next
        (points[1:, 0, 0], others[:-1, 0, 0]),
        (points[:-1, 0, 0], others[1:, 0, 0]),
        (points[:, 1, 0], points[:, 1, 4]),
        (points[:, 1, 0], points[:, 1, 6]),
        (points[:, 1, 1], points[:, 1, 5]),
    ):
        assert abs(np.corrcoef(a, b)[0, 1]) * z < 5


# ---- The contract of mi.Sampler ----


@pytest.mark.parametrize("kind", SAMPLERS)
def test_passes_go_on_with_one_sequence(kind: str) -> None:
    whole = _points(_seeded(kind, 12, 3), 3, 3)
    sampler = mi.load_dict({"type": kind, "sample_count": 12})
    sampler.set_samples_per_wavefront(4)
    sampler.seed(0, 4 * 3)
    passes = []
    for _ in range(3):
        passes.append(_points(sampler, 3, 3))
        sampler.advance()
        sampler.schedule_state()
    np.testing.assert_array_equal(np.concatenate(passes, axis=1), whole)


@pytest.mark.parametrize("kind", SAMPLERS)
def test_a_clone_continues_and_a_fork_starts_again(kind: str) -> None:
    sampler = _seeded(kind, 8, 2, seed=3)
    sampler.next_1d()
    clone, fork = sampler.clone(), sampler.fork()
    expected = np.array(sampler.next_2d())
    np.testing.assert_array_equal(np.array(clone.next_2d()), expected)
    assert (fork.sample_count(), fork.wavefront_size()) == (8, 0)
    fork.seed(3, 16)
    fork.next_1d()
    np.testing.assert_array_equal(np.array(fork.next_2d()), expected)


def test_the_seed_of_the_scene_is_added() -> None:
    shifted = _points(_seeded("sobol_owen", 4, seed=2), 1)
    ours = mi.load_dict({"type": "sobol_owen", "sample_count": 4, "seed": 2})
    ours.seed(0, 4)
    np.testing.assert_array_equal(_points(ours, 1), shifted)


@pytest.mark.parametrize("kind", some("sobol_owen", of=SAMPLERS))
@pytest.mark.parametrize("integrator", ["path", "composed_path"])
def test_renders_have_the_mean_of_independent_samples(kind: str, integrator: str) -> None:
    images = {}
    for sampler in ("independent", kind):
        scene = mi.load_dict(_room(sampler))
        made = mi.load_dict({"type": integrator, "max_depth": 4})
        seeds = range(101, 101 + 7919 * 8, 7919)
        images[sampler] = np.array(
            [np.array(mi.render(scene, integrator=made, seed=seed, spp=9)) for seed in seeds]
        ).mean(axis=(1, 2, 3))
    ours, theirs = images[kind], images["independent"]
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / len(ours))
    assert abs(ours.mean() - theirs.mean()) < 5 * error
    assert ours.var() < theirs.var()


def test_a_walk_of_ours_sees_the_numbers_of_path() -> None:
    scene = mi.load_dict(_room("sobol_owen"))
    images = [
        np.array(mi.render(scene, integrator=mi.load_dict({"type": kind}), seed=4, spp=6))
        for kind in ("path", "composed_path")
    ]
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6)


def _room(sampler: str) -> dict[str, Any]:
    room = stage()
    room["sensor"]["sampler"] = {"type": sampler, "sample_count": 9}
    return room


@pytest.mark.parametrize(
    ("parameters", "what"),
    [
        ({"sample_count": 0}, "sample_count"),
        ({"dimensions": 3}, "must be even"),
        ({"dimensions": 10}, "at most 8"),
        ({"seed": -1}, "at least 0"),
    ],
)
def test_bad_parameters_are_named(parameters: dict[str, Any], what: str) -> None:
    with pytest.raises((RuntimeError, ValueError), match=what):
        mi.load_dict({"type": "sobol_owen", **parameters})


def test_many_samples_of_halton_have_an_interval_each() -> None:
    """With 2^30 samples, powers of the bases have more than 32 bits."""
    from mitsuba_ext.util.sequences.halton import Halton

    point = dr.arange(mi.UInt32, 19**2) + 2**30 - 19**2
    x = Halton(8).coordinate(point, 2**30, mi.UInt32(7), dr.full(mi.UInt32, 5, 19**2))
    assert np.bincount((np.array(x) * 19**2).astype(int)).tolist() == [1] * 19**2
