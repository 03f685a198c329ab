"""Films with fewer pixels."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.merging.merging_radius import MergingRadius
from mitsuba_ext.images.coarse_film import CoarseFilm


@pytest.mark.parametrize(
    "width, height, count", [(320, 180, 32768), (333, 217, 3000), (7, 5, 8)]
)
def test_each_rectangle_has_pixels_and_two_samples_in_it(width, height, count) -> None:
    film = CoarseFilm.of(width, height, count)
    size = film.width * film.height
    assert abs(len(film.samples) / count - 1) < 0.7 and len(film.samples) == 2 * size
    rectangle = film.of_pixel[film.samples]
    np.testing.assert_array_equal(np.bincount(rectangle), np.full(size, 2))
    pixels = np.bincount(film.of_pixel)
    assert len(pixels) == size and pixels.max() <= 2 * film.pixel_width**2 + 2
    rows = film.of_pixel.reshape(height, width)
    assert (np.diff(rows, axis=1) >= 0).all() and (np.diff(rows, axis=0) >= 0).all()


def test_small_films_are_whole_and_have_more_samples() -> None:
    film = CoarseFilm.of(64, 32, 32768)
    assert film.of_pixel is None and film.pixel_width == 1
    np.testing.assert_array_equal(np.bincount(film.samples), np.full(64 * 32, 16))


def test_disks_are_as_much_wider_as_pixels() -> None:
    """They hold as many vertices, of one light path for each of the fewer pixels."""
    radius = MergingRadius(first=0.1, decay=0.75, pixels=6400, footprint=0.01, widest=0.2)
    coarse = radius.of_coarse_film(4.0)
    assert coarse.pixels == 400
    shared = [x.samples_per_vertex(1, 8, 3) for x in (coarse, radius)]
    assert shared[0] == pytest.approx(shared[1])
    for _ in range(3):
        assert coarse.next(400) == pytest.approx(4 * radius.next(6400))


def test_samples_share_vertices_less_in_later_passes() -> None:
    radius = MergingRadius(first=0.1, decay=0.5, pixels=100, footprint=0.05)
    one, four = (radius.samples_per_vertex(1, 8, passes) for passes in (1, 4))
    assert 1 < four < one < 8
    wide = MergingRadius(first=1.0, decay=0.5, pixels=100, footprint=1e-3)
    assert wide.samples_per_vertex(1, 8, 4) == pytest.approx(8, rel=1e-3)
