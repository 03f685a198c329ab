"""The filter weights by which a film divides its pixels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy

#: Intervals of the table of a filter's integral.
_TABLE = 1 << 12


def put_splats(film: mi.Film, splats: mi.TensorXf, offset: mi.ScalarPoint2i, spp: float) -> None:
    """Adds splats to a film that holds ``spp`` camera samples per pixel, by weight, and no splats
    yet.

    The film divides each pixel by the sum of the filter weights of its camera samples. This sum is
    random, and its inverse is too large on average: by 6 % for one sample and a gaussian filter.
    The splats are therefore multiplied by the sum, and divided by its mean.
    """
    if not film.rfilter().is_box_filter():
        channel = 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3
        sums = dr.detach(film.develop(raw=True))
        height, width, count = sums.shape
        pixel = dr.arange(mi.UInt32, height * width)
        weights = mi.Float64(dr.gather(mi.Float, sums.array, pixel * count + channel))
        ratio = weights / (dr.opaque(mi.Float64, spp) * expected_weights(film))
        splats = splats * mi.TensorXf(mi.Float(ratio), (height, width, 1))
    film.put_block(mi.ImageBlock(splats, offset=offset))


def mean_weights(film: mi.Film) -> np.ndarray:
    """The mean of the filter weights that one camera sample in each pixel adds to each pixel:
    [height, width]. Pixels at the edges get less where no samples are taken outside of the film
    (``sample_border``)."""
    rows, columns = _mean_weights(film)
    return rows[:, None] * columns


def expected_weights(film: mi.Film) -> mi.Float64:
    """:func:`mean_weights` on the device, row by row."""
    rows, columns = (from_numpy(mi.Float64, x) for x in _mean_weights(film))
    index = dr.arange(mi.UInt32, len(rows) * len(columns))
    width = dr.opaque(mi.UInt32, len(columns))
    y = index // width
    return dr.gather(mi.Float64, rows, y) * dr.gather(mi.Float64, columns, index - y * width)


def _mean_weights(film: mi.Film) -> tuple[np.ndarray, np.ndarray]:
    """The factors of :func:`mean_weights` of each row and of each column."""
    edges, values = _table(film.rfilter())
    integral = np.concatenate([[0], np.cumsum(values)]) * (edges[1] - edges[0])

    def along(size: int) -> np.ndarray:
        if film.sample_border():
            return np.full(size, integral[-1])
        centre = np.arange(size) + 0.5
        return np.interp(size - centre, edges, integral) - np.interp(-centre, edges, integral)

    width, height = film.crop_size()
    return along(height), along(width)


def share_of_squares(film: mi.Film) -> float:
    """The variance of a pixel, relative to the box filter with as many samples of each
    pixel: ∫w² / (∫w)² over the plane, for the filter w. (The film divides by the sum of the weights
    instead of its mean, which lowers the variance further where the image is even.)"""
    edges, values = _table(film.rfilter())
    step = edges[1] - edges[0]
    along = (values**2).sum() * step / (values.sum() * step) ** 2
    return float(along**2)


def shares_of_pixels(film: mi.Film) -> np.ndarray:
    """The share of each pixel in ∫w², for the filter around the pixel in the middle: [y, x]."""
    edges, values = _table(film.rfilter())
    place = np.round(0.5 * (edges[1:] + edges[:-1])).astype(int)
    along = np.bincount(place - place.min(), values**2)
    along /= along.sum()
    return along[:, None] * along


def _table(rfilter: mi.ReconstructionFilter) -> tuple[np.ndarray, np.ndarray]:
    """The ends of short intervals, and the weights in their middles."""
    radius = rfilter.radius()
    edges = np.linspace(-radius, radius, _TABLE + 1)
    values = rfilter.eval(mi.Float(0.5 * (edges[1:] + edges[:-1]))).numpy()
    return edges, values.astype(np.float64)
