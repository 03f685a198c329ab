"""What radiance the pixels have, about."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

#: Pixels on each side of one that count for it, along each axis.
_RADIUS = 4

#: Squared radiance of a dark pixel, in units of the squared mean of all.
_FLOOR = 1e-2


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
        # NumPy adds one after the other: equal seeds make equal sums
        self._sum = np.bincount(index, values, size) + _padded(self._sum, size)
        self._count = np.bincount(index, minlength=size) + _padded(self._count, size)

    def scale(self) -> mi.Float:
        """1 / radiance of each pixel, row by row."""
        total, count = (
            _box_sums(x.reshape(-1, self._width)).ravel() for x in (self._sum, self._count)
        )
        mean = total / np.maximum(count, 1)
        # An image that is black all over has no scale: all that is expected there is 0
        square = mean**2 + _FLOOR * (self._sum.sum() / max(self._count.sum(), 1)) ** 2
        return mi.Float((1 / np.sqrt(np.maximum(square, 1e-30))).astype(np.float32))


def _padded(x: np.ndarray, size: int) -> np.ndarray:
    return np.pad(x, (0, size - len(x)))


def _box_sums(image: np.ndarray) -> np.ndarray:
    """Sums over the neighbours of each pixel, itself included."""
    for axis in range(2):
        size = image.shape[axis]
        sums = np.insert(np.cumsum(image, axis), 0, 0, axis)
        index = np.arange(size)
        end = np.minimum(index + _RADIUS + 1, size)
        image = sums.take(end, axis) - sums.take(np.maximum(index - _RADIUS, 0), axis)
    return image
