"""How many samples each pixel gets in each pass, and what they count in the image.

The mean over samples whose *number* depends on their values is biased: a pixel that has not met its
rare bright path yet looks converged, gets few samples, and stays dark; one that has met it gets
many, which average it away. So each pass has a weight, and adds its weight times the mean of its
own samples. The weight and the number of samples are decided before the pass, from earlier passes:
whatever these were, the mean of the pass is right on average. The weights of all passes add up to
one. Hence the sum is right on average: it is unbiased.
"""

from __future__ import annotations

import numpy as np

from .pixel_moments import PixelMoments

#: Samples are distributed in proportion to this power of the relative deviation: it makes the sum
#: of the fourth powers of the pixels' relative errors least. The power 1 makes the sum of squares
#: least, 2 makes errors equal, which raises their mean.
_POWER = 4 / 3

#: Each pixel gets this share of the mean number of samples, at least.
_LEAST = 1 / 8

#: The first pass counts this much in comparison with its share of the samples. It decides nothing,
#: so it gives noisy pixels no more samples than others.
_FIRST_WEIGHT = 1 / 2


class SampleAllocation:
    """Counts and weights of the samples of a render.

    Parameters:
        moments: Of the samples that have been taken.
        spp: Samples per pixel of the render, on average.
        first: Samples per pixel of the first pass, or of the pilots.
        threshold: Relative error at which a pixel needs no more samples; 0 for none.
        set_size: Samples of a pixel that come together.

    Attributes:
        is_active: Which pixels get more samples.
    """

    def __init__(
        self, moments: PixelMoments, spp: int, first: int, threshold: float = 0.0, set_size: int = 1
    ) -> None:
        self._moments, self._threshold, self._set_size = moments, threshold, set_size
        size = len(moments.count)
        self._weight_left = np.ones(size)
        # Of the image, in units of the variance of a sample
        self._variance = np.zeros(size)
        self.is_active = np.ones(size, bool)
        # Of each sample of the first pass
        self._first_weight = _FIRST_WEIGHT / spp if first < spp else 1 / first

    def first(self, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """Sets of each pixel, and the weight of each of its samples, where a part of the first pass
        takes ``samples`` samples of every pixel."""
        sets = np.full(len(self.is_active), -(-samples // self._set_size))
        return sets, self._take(sets, self._first_weight * samples * np.ones(len(sets)))

    def next(self, budget: float, is_last: bool, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Sets of each pixel, and the weight of each of its samples, in the next pass.

        Parameters:
            budget: Samples of the pass.
            is_last: Does no pass follow?
            share: Of the weight that is left, the part that is for this pass.
        """
        active = self.is_active
        deviation = self._moments.deviation()
        wanted = np.where(active, deviation**_POWER, 0)
        count = max(1, int(active.sum()))
        mean = wanted.sum() / count
        relative = wanted / mean if mean > 0 else active.astype(float)
        samples = budget / count * (_LEAST + (1 - _LEAST) * relative)
        is_done = np.full(len(active), is_last)
        if self._threshold > 0:
            # Taking all the weight that is left, how many samples reach the threshold?
            variance = deviation**2
            left = self._threshold**2 - self._variance * variance
            needed = self._weight_left**2 * variance / np.maximum(left, 1e-30)
            is_done |= needed <= samples
            samples = np.minimum(samples, needed)
        sets = np.where(active, np.maximum(_whole(samples / self._set_size, active), 1), 0)
        weight = self._weight_left * np.where(is_done, 1.0, share)
        scale = self._take(sets, np.where(active, weight, 0))
        self.is_active = active & ~is_done
        return sets, scale

    def _take(self, sets: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Notes a pass; returns the weight of each sample."""
        samples = np.maximum(sets * self._set_size, 1)
        self._weight_left = np.maximum(self._weight_left - weight, 0)
        self._variance += weight**2 / samples
        return weight / samples


def _whole(values: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Whole numbers about as large as the ``values``, with about the same sum: what one pixel
    lacks, the next one gets."""
    total = np.floor(np.cumsum(np.where(active, values, 0)) + 0.5)
    return np.diff(total, prepend=0).astype(np.int64)
