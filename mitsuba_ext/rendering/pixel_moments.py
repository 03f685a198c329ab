"""Mean and variance of the samples of each pixel."""

from __future__ import annotations

import numpy as np

#: The weight of a pixel's neighbourhood, in units of the pixel's own samples. A few samples say
#: little about rare bright values of a pixel; its neighbours add information.
_NEIGHBOURS = 16.0

#: Added to the squared brightness of a pixel, in units of the squared mean of all pixels, as in
#: relMSE.
_FLOOR = 1e-2


class PixelMoments:
    """Mean and variance of the samples of each pixel.

    Parameters:
        width, height: Size of the film in pixels.
        set_size: Number of samples that a stratified sampler distributes together. The variance is
            that of the means of sets, times this number.

    Attributes:
        count: Number of samples of each pixel, row by row.
    """

    def __init__(self, width: int, height: int, set_size: int = 1) -> None:
        self._shape, self._set_size = (height, width), set_size
        self.count = np.zeros(width * height, np.int64)
        self._sum, self._squares = np.zeros(width * height), np.zeros(width * height)

    def add(self, pixel: np.ndarray, values: np.ndarray) -> None:
        """Adds the sets of a pass. ``pixel`` holds the pixel of each set, ``values`` the brightness
        of their samples, set by set. Samples that are not finite count as black."""
        values = np.where(np.isfinite(values), values, 0).astype(np.float64)
        values = values.reshape(-1, self._set_size).mean(axis=1)
        size = len(self.count)
        # NumPy adds in a fixed order: equal seeds give equal sums
        self._sum += np.bincount(pixel, values, size)
        self._squares += np.bincount(pixel, values**2, size)
        self.count += self._set_size * np.bincount(pixel, minlength=size)

    def deviation(self) -> np.ndarray:
        """The standard deviation of one sample of each pixel, relative to its brightness.

        Each sample is part of the mean by which its deviation is divided. The influence of a rare
        bright sample is thereby bounded: by the number of samples."""
        sets = self.count / self._set_size
        mean = self._sum / np.maximum(sets, 1)
        # The variance of a single set is unknown: such a pixel only uses its neighbourhood
        variance = np.maximum(self._squares - sets * mean**2, 0) / np.maximum(sets - 1, 1)
        floor = _FLOOR * mean.mean() ** 2
        own = np.where(sets > 1, sets, 0)
        top = own * variance + _NEIGHBOURS * self._neighbours(variance)
        bottom = own * mean**2 + _NEIGHBOURS * self._neighbours(mean**2)
        # In a black image, the deviation is 0
        scale = np.maximum(bottom + (own + _NEIGHBOURS) * floor, 1e-30)
        return np.sqrt(self._set_size * top / scale)

    def _neighbours(self, values: np.ndarray) -> np.ndarray:
        """The mean over each pixel and the eight around it."""
        image = np.pad(values.reshape(self._shape), 1, mode="edge")
        rows = image[:-2] + image[1:-1] + image[2:]
        return ((rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9).ravel()
