"""Estimates the variance of a growing image from what its snapshots add."""

from __future__ import annotations

import math

import numpy as np

from ..long_renders.announced_error import announced_error

#: The fewest parts of an image from which its variance is estimated.
FEWEST = 4


class Increments:
    """Mean and variance of the parts that were added to the film between snapshots.

    Parts are independent, since passes are. Each is weighted by its samples. Splats and samples
    share the film, whose sums are divided by the filter weights of the same part.

    Attributes:
        count: The number of parts.
        spp: Samples per pixel of all of them.
    """

    def __init__(self) -> None:
        self.count, self.spp = 0, 0
        self._sums: tuple[np.ndarray, np.ndarray] | None = None
        self._first = 0
        self._mean = self._squares = np.float32(0)

    def add(self, contents: np.ndarray, weight_channel: int, spp: int) -> None:
        """Adds the samples since the last call, if there are any.

        Args:
            contents: The film's sums, [height, width, channel].
            weight_channel: The channel with the sums of filter weights.
            spp: Samples per pixel of the image.
        """
        if self._sums is not None and spp == self._first:
            return
        colours = min(3, weight_channel)
        now = contents[..., :colours].copy(), contents[..., weight_channel, None].copy()
        if not now[1].any():  # a light tracer leaves no weights: its film holds the mean
            now = now[0] * spp, np.full_like(now[1], spp)
        before, own = self._sums, spp - self._first
        if before is not None and (before[0].shape != now[0].shape or own < 0):
            # Another film, or samples were discarded
            self.__init__()
            before, own = None, spp
        with np.errstate(invalid="ignore", over="ignore"):  # pixels may be infinite
            colour, weight = now if before is None else (x - y for x, y in zip(now, before))
            part = colour / np.where(weight == 0, 1, weight)
            # Welford's update, weighted by the samples of the part
            self.count, self.spp = self.count + 1, self.spp + own
            deviation = part - self._mean
            self._mean = self._mean + deviation * np.float32(own / self.spp)
            self._squares = self._squares + np.float32(own) * deviation * (part - self._mean)
        self._sums, self._first = now, spp

    def variance(self) -> np.ndarray | None:
        """The variance of the mean, [height, width, colour]; ``None`` while there are few parts."""
        if self.count < FEWEST:
            return None
        return self._squares / np.float32((self.count - 1) * self.spp)


#: The most pixels from which an error is estimated: of larger images, every other row and column is
#: taken, or every third, and so on.
_MOST_PIXELS = 1 << 18


def estimated_error(mean: np.ndarray, variance: np.ndarray) -> float | None:
    """The relMSE of an image, from its variance (:func:`announced_error`)."""
    step = math.ceil(math.sqrt(mean.shape[0] * mean.shape[1] / _MOST_PIXELS))
    return announced_error(mean[::step, ::step], variance[::step, ::step])
