"""Pixels that share the points of one sequence (``sobol_owen`` with ``blue_noise``)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.stage import stage
from tests.support.statistical import assert_same_quarters

pytestmark = pytest.mark.usefixtures("variant")


def _made(count: int, width: int, **parameters: Any) -> mi.Sampler:
    return mi.load_dict(
        {"type": "sobol_owen", "sample_count": count, "blue_noise": True, "film_width": width,
         **parameters}
    )  # fmt: skip


def _points(sampler: mi.Sampler, width: int, pairs: int) -> np.ndarray:
    """The points of a seeded sampler: [y, x, sample, dimension]."""
    drawn = np.concatenate([np.array(sampler.next_2d()).T for _ in range(pairs)], axis=1)
    return drawn.reshape(-1, width, sampler.sample_count(), 2 * pairs)


def _is_net(points: np.ndarray) -> bool:
    """Whether each cell of area 2^-m of the square holds one of 2^m points."""
    x, y = points.reshape(-1, points.shape[-1])[:, :2].T
    m = len(x).bit_length() - 1
    grids = [(2**k, 2 ** (m - k)) for k in range(m + 1)]
    return all(
        len(set(zip((x * nx).astype(int).tolist(), (y * ny).astype(int).tolist()))) == len(x)
        for nx, ny in grids
    )


@pytest.mark.parametrize("count", [1, 2, 16])
def test_pixels_and_aligned_squares_of_them_are_nets(count: int) -> None:
    sampler = _made(count, 11)
    sampler.seed(5, 11 * 9 * count)
    points = _points(sampler, 11, 3)
    for first in (0, 4):
        part = points[..., first:]
        for size in (1, 2, 4):
            for y in range(0, 9 - size + 1, size):
                for x in range(0, 11 - size + 1, size):
                    assert _is_net(part[y : y + size, x : x + size])


def test_ranges_of_the_samples_of_a_pixel_are_nets() -> None:
    sampler = _made(16, 4)
    sampler.seed(2, 16 * 16)
    points = _points(sampler, 4, 1)
    for pixel in points.reshape(-1, 16, 2):
        assert all(_is_net(pixel[first : first + 4]) for first in range(0, 16, 4))


def test_numbers_of_a_pixel_are_uniform() -> None:
    """Chi² over 2500 squares of 128 x 128 pixels, whose sequences are independent."""
    squares, cells = 2500, 16
    sampler = _made(2, 128 * squares)
    sampler.seed(0, 2 * 128 * squares)
    points = _points(sampler, 128 * squares, 3)[0].reshape(squares, 128, 2, 6)
    for pixel, sample in ((0, 0), (0, 1), (5, 0), (127, 1)):
        for d in range(6):
            for x in (points[:, pixel, sample, d], points[:, pixel, sample, d] * 48 % 1):
                found = np.bincount((x * cells).astype(int), minlength=cells)
                assert stats.chisquare(found).pvalue > 1e-5
        for a, b in ((0, 1), (0, 2), (0, 4), (1, 5), (2, 4)):
            cell = [(points[:, pixel, sample, k] * 4).astype(int) for k in (a, b)]
            found = np.bincount(4 * cell[0] + cell[1], minlength=16)
            assert stats.chisquare(found).pvalue > 1e-5


def test_quarters_of_a_square_are_in_any_order() -> None:
    from mitsuba_ext.util.sequences.pixel_order import shuffled

    seeds = 4800
    seed = mi.UInt32(np.repeat(np.arange(seeds, dtype=np.uint32), 16))
    places = np.array(shuffled(dr.arange(mi.UInt32, 16 * seeds) % 16, 2, seed)).reshape(-1, 16)
    np.testing.assert_array_equal(np.sort(places, axis=1), np.tile(np.arange(16), (seeds, 1)))
    squares = places.reshape(seeds, 4, 4)
    # All four pixels of a square stay together
    assert (squares // 4 == squares[:, :, :1] // 4).all()
    for order in (squares[:, 0] % 4, squares[:, 3] % 4, squares[:, :, 0] // 4):
        _, found = np.unique(order @ [64, 16, 4, 1], return_counts=True)
        assert len(found) == 24
        assert stats.chisquare(found).pvalue > 1e-5


def test_seeds_are_independent() -> None:
    size, drawn = 64, []
    for seed in (0, 1):
        sampler = _made(1, size)
        sampler.seed(seed, size * size)
        drawn.append(_points(sampler, size, 3)[:, :, 0])
    ours, others = drawn
    for a, b in (
        (ours[..., 0], others[..., 0]),
        (ours[:, 1:, 0], others[:, :-1, 0]),
        (ours[..., 0], ours[..., 4]),
        (ours[..., 1], ours[..., 5]),
    ):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) * size < 5


# ---- Less error at low frequencies ----


@pytest.mark.parametrize("count", [1, 3, 4, 16])
def test_error_has_less_power_at_low_frequencies(count: int) -> None:
    """A disk in the square, for each of 64x64 pixels."""
    size = 64
    frequency = np.fft.fftfreq(size)
    low = np.hypot(frequency, frequency[:, None]) < 0.1
    power = []
    for blue_noise in (True, False):
        sampler = _made(count, size, blue_noise=blue_noise)
        total = 0.0
        for seed in range(4):
            sampler.seed(seed, size * size * count)
            points = _points(sampler, size, 1)
            image = ((points**2).sum(axis=-1) < 1).mean(axis=-1)
            total += (np.abs(np.fft.fft2(image - np.pi / 4)) ** 2)[low].mean()
        power.append(total)
    assert power[0] < 0.5 * power[1]


# ---- Renders ----


def _room(crop: dict[str, Any], **sampler: Any) -> dict[str, Any]:
    room = stage()
    room["sensor"]["film"] = {**room["sensor"]["film"], **crop}
    room["sensor"]["sampler"] = {"type": "sobol_owen", "sample_count": 4, **sampler}
    return room


def test_a_render_of_ours_knows_the_film() -> None:
    """With a crop window: the same numbers as ``path``, which is told its width."""
    crop = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 9, "crop_height": 11}
    images = []
    for kind, width in (("path", 9), ("composed_path", 0)):
        scene = mi.load_dict(_room(crop, blue_noise=True, film_width=width))
        images.append(np.array(mi.render(scene, integrator=mi.load_dict({"type": kind}), seed=4)))
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6)


def test_batches_tell_an_integrator_of_mitsuba_the_film() -> None:
    from mitsuba_ext.rendering.batches import each_batch

    made = mi.load_dict({"type": "path"})
    scene = mi.load_dict(_room({}, blue_noise=True))
    (batches,) = each_batch(made, scene, 0, 4, [3])
    told = mi.load_dict(_room({}, blue_noise=True, film_width=16))
    image = np.array(mi.render(told, integrator=made, seed=3))
    np.testing.assert_allclose(batches.mean, image, rtol=1e-4, atol=1e-6)


def test_renders_have_the_quarters_of_independent_samples() -> None:
    made = mi.load_dict({"type": "path", "max_depth": 3})
    images = []
    for sampler in ({"type": "independent"}, {"blue_noise": True, "film_width": 16}):
        scene = mi.load_dict(_room({}, **sampler))
        seeds = range(101, 101 + 7919 * 24, 7919)
        images.append(
            np.array([np.array(mi.render(scene, integrator=made, seed=s, spp=6)) for s in seeds])
        )
    assert_same_quarters(images[1], images[0], 0.04)
    means = [x.mean(axis=(1, 2, 3)) for x in images]
    assert means[1].var() < means[0].var()


# ---- The contract of mi.Sampler ----


def test_passes_go_on_with_one_sequence() -> None:
    whole = _made(12, 5)
    whole.seed(0, 12 * 15)
    sampler = _made(12, 5)
    sampler.set_samples_per_wavefront(4)
    sampler.seed(0, 4 * 15)
    passes = []
    for _ in range(3):
        drawn = np.concatenate([np.array(sampler.next_2d()).T for _ in range(3)], axis=1)
        passes.append(drawn.reshape(3, 5, 4, 6))
        sampler.advance()
        sampler.schedule_state()
    np.testing.assert_array_equal(np.concatenate(passes, axis=2), _points(whole, 5, 3))


def test_a_clone_continues_and_a_fork_starts_again() -> None:
    sampler = _made(4, 0)
    sampler.set_film(3)
    sampler.seed(3, 4 * 6)
    sampler.next_1d()
    clone, fork = sampler.clone(), sampler.fork()
    expected = np.array(sampler.next_2d())
    np.testing.assert_array_equal(np.array(clone.next_2d()), expected)
    fork.seed(3, 4 * 6)
    fork.next_1d()
    np.testing.assert_array_equal(np.array(fork.next_2d()), expected)


def test_a_part_of_the_film_has_the_numbers_of_the_whole() -> None:
    drawn = []
    for first in (0, 10):
        sampler = _made(2, 0)
        sampler.set_film(7, first)
        sampler.seed(1, 2 * (7 * 5 - first))
        drawn.append(np.array(sampler.next_2d()).T)
    np.testing.assert_array_equal(drawn[1], drawn[0][2 * 10 :])


def test_lanes_that_are_no_pixels_are_independent() -> None:
    sampler, plain = _made(4, 0), _made(4, 0, blue_noise=False)
    sampler.set_film(0)
    for each in (sampler, plain):
        each.seed(1, 4 * 6)
    np.testing.assert_array_equal(np.array(sampler.next_2d()), np.array(plain.next_2d()))


@pytest.mark.parametrize("count", [3, 2**18, 2**30])
def test_point_numbers_have_32_bits(count: int) -> None:
    """Neighbouring pixels have different points, however many there are."""
    sampler = _made(count, 2)
    sampler.set_samples_per_wavefront(1)
    sampler.seed(0, 4)
    points = np.array(sampler.next_2d()).T
    assert len(np.unique(points, axis=0)) == 4


@pytest.mark.parametrize(("width", "what"), [(0, 'needs "film_width"'), (4, "has 18 pixels")])
def test_a_film_that_is_not_known_is_refused(width: int, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        _made(2, width).seed(0, 36)
