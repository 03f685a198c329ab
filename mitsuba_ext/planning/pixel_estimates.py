"""Estimates of the radiance of pixels, and of the weights of errors in them."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images.box_filter import RADIUS, box_means, exact_box_sums
from ..util.arrays import channel_mean

#: Added to the squared radiance of a pixel, in units of the squared mean of the image.
_FLOOR = 1e-2

#: The least squared radiance. It matters only in images that are black all over, where every
#: contribution is 0.
_LEAST_SQUARE = 1e-30

#: The unit of sums of radiance, relative to the mean of the first samples: the floor makes smaller
#: differences irrelevant. And the most units of a sample.
_UNIT, _MOST_UNITS = 2.0**-20, 2.0**48


def brightness(L: mi.Spectrum) -> mi.Float:
    """The mean of the channels of a path's radiance: errors count the same in all channels."""
    return channel_mean(L)


class PixelEstimates:
    """Means over the samples of pilots, and over neighbouring pixels.

    Sums are integers, in fixed point: they do not depend on the order of the samples, and sums over
    neighbours are exact, however bright other pixels are.

    Parameters:
        width, height: Size of the film in pixels, with its border where that is sampled.
    """

    def __init__(self, width: int, height: int) -> None:
        self._size, self._count = (width, height), dr.opaque(mi.UInt32, width * height)
        # An image of the sums of radiance, in units, and an image of the numbers of samples
        self._sums = dr.zeros(mi.UInt64, 2 * width * height)
        self._unit = 0.0
        self._near: mi.UInt64 | None = None

    def add(self, pixel: mi.UInt32, radiance: mi.Float) -> None:
        """Adds samples; those that are negative or not finite count as black."""
        value = mi.Float64(dr.select(dr.isfinite(radiance), dr.maximum(radiance, 0), 0))
        if self._unit == 0:  # all samples until now were black
            mean = float(dr.sum(value)[0]) / max(1, len(value))
            # A power of two does not depend on how the mean was rounded
            self._unit = _UNIT * 2.0 ** math.floor(math.log2(mean)) if mean > 0 else 0.0
        per_unit = dr.opaque(mi.Float64, 1 / self._unit if self._unit > 0 else 0.0)
        units = mi.UInt64(dr.minimum(value * per_unit, _MOST_UNITS) + 0.5)
        for place, amount in ((pixel, units), (pixel + self._count, mi.UInt64(1))):
            # In place: copies for each thread would make the kernel depend on the film's size
            dr.scatter_add(self._sums, amount, place, mode=dr.ReduceMode.Direct)
        dr.eval(self._sums)
        self._near = None

    def scale(self) -> mi.Float:
        """1 / radiance of each pixel, row by row."""
        width, height = self._size
        return self._scale(self._means(dr.arange(mi.UInt32, width * height)))

    def importance(self, pixel: mi.UInt32, radiance: mi.Float) -> tuple[mi.Float, mi.Float]:
        """For samples that were added: the weight of squared errors in each one's pixel, and its
        own squared error with this weight.

        A sample is part of the mean to which its error is relative. The weighted error of a rare
        bright one is thereby bounded, by the square of the number of samples in the mean."""
        means = self._means(pixel)
        weight = dr.square(self._scale(means))
        radiance = dr.select(dr.isfinite(radiance), radiance, 0)
        return weight, dr.square(radiance - mi.Float(means)) * weight

    def _means(self, pixel: mi.UInt32) -> mi.Float64:
        """The means over pixels and their neighbours."""
        if self._near is None:
            running = dr.cumsum(self._sums)
            self._near = exact_box_sums(running, *self._size)
            last = self._count - 1
            total = dr.gather(mi.UInt64, running, last)
            samples = dr.gather(mi.UInt64, running, last + self._count) - total
            self._mean = self._ratio(total, samples)
            dr.eval(self._mean)
        total, samples = (
            dr.gather(mi.UInt64, self._near, i) for i in (pixel, pixel + self._count)
        )
        return self._ratio(total, samples)

    def _ratio(self, total: mi.UInt64, samples: mi.UInt64) -> mi.Float64:
        unit = dr.opaque(mi.Float64, self._unit)
        return mi.Float64(total) * unit / dr.maximum(mi.Float64(samples), 1)

    def _scale(self, means: mi.Float64) -> mi.Float:
        squares = dr.square(means) + _FLOOR * dr.square(self._mean)
        return mi.Float(1 / dr.sqrt(dr.maximum(squares, _LEAST_SQUARE)))


def relative_scale(image: np.ndarray, radius: int = RADIUS) -> np.ndarray:
    """1 / mean radiance of each pixel of an image and its neighbours within ``radius``, shape
    [y, x]."""
    means, mean = box_means(image, radius), image.mean()
    return 1 / np.sqrt(np.maximum(means**2 + _FLOOR * mean**2, _LEAST_SQUARE))
