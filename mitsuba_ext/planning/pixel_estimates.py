"""Estimates of the radiance of pixels, and of the weights of errors in them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images.box_filter import RADIUS, box_means, box_sums
from ..util.arrays import channel_mean, from_numpy

#: Added to the squared radiance of a pixel, in units of the squared mean of the image.
_FLOOR = 1e-2


def brightness(L: mi.Spectrum) -> mi.Float:
    """The mean of the channels of a path's radiance: errors count the same in all channels."""
    return channel_mean(L)


class PixelEstimates:
    """Means over the samples of pilots, and over neighbouring pixels.

    Parameters:
        width: Pixels of a row of the film.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._sum = self._count = np.zeros(0)

    def add(self, pixel: mi.UInt32, radiance: mi.Float) -> None:
        """Adds samples; those that are not finite count as black."""
        index, values = pixel.numpy(), radiance.numpy()
        rows = -(-(int(index.max(initial=0)) + 1) // self._width)
        size = max(rows * self._width, len(self._sum))
        values = np.where(np.isfinite(values), values, 0)
        # NumPy adds in a fixed order: equal seeds make equal sums
        self._sum = np.bincount(index, values, size) + _padded(self._sum, size)
        self._count = np.bincount(index, minlength=size) + _padded(self._count, size)

    def scale(self) -> mi.Float:
        """1 / radiance of each pixel, row by row."""
        return self._scale(self._means())

    def importance(self, pixel: mi.UInt32, radiance: mi.Float) -> tuple[mi.Float, mi.Float]:
        """For samples that were added: the weight of squared errors in each one's pixel, and its
        own squared error with this weight.

        A sample is part of the mean to which its error is relative. The weighted error of a rare
        bright one is thereby bounded, by the square of the number of samples in the mean."""
        means = self._means()
        weight = dr.square(dr.gather(mi.Float, self._scale(means), pixel))
        radiance = dr.select(dr.isfinite(radiance), radiance, 0)
        mean = dr.gather(mi.Float, from_numpy(mi.Float, means), pixel)
        return weight, dr.square(radiance - mean) * weight

    def _means(self) -> np.ndarray:
        total, count = (
            box_sums(x.reshape(-1, self._width)).ravel() for x in (self._sum, self._count)
        )
        return total / np.maximum(count, 1)

    def _scale(self, means: np.ndarray) -> mi.Float:
        mean = self._sum.sum() / max(self._count.sum(), 1)
        return from_numpy(mi.Float, _inverse(means, mean))


def relative_scale(image: np.ndarray, radius: int = RADIUS) -> np.ndarray:
    """1 / mean radiance of each pixel of an image and its neighbours within ``radius``, shape
    [y, x]."""
    return _inverse(box_means(image, radius), image.mean())


def _inverse(means: np.ndarray, mean: float) -> np.ndarray:
    # The bound of 1e-30 matters only in images that are black all over: every contribution is 0
    return 1 / np.sqrt(np.maximum(means**2 + _FLOOR * mean**2, 1e-30))


def _padded(x: np.ndarray, size: int) -> np.ndarray:
    return np.pad(x, (0, size - len(x)))
