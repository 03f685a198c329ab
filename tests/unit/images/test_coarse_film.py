"""Films with fewer, wider pixels, on which trials estimate errors."""

from __future__ import annotations

import numpy as np
import pytest

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
