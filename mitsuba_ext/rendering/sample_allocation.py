"""The number of samples of each pixel in each pass, and their weight in the image.

The mean over samples whose *number* depends on their values is biased: a pixel that has not found
its rare bright paths yet looks converged, gets few samples, and stays too dark; a pixel that has
found one gets many samples, which average it away. Therefore each pass adds the mean of its own
samples, times a weight. The weight and the number of samples are decided before the pass, from
earlier passes: whatever these were, the mean of the pass is unbiased. The weights of all passes add
up to one, so that the weighted sum is unbiased too.
"""

from __future__ import annotations

import numpy as np

from .pixel_moments import PixelMoments

#: Samples are distributed in proportion to this power of the relative deviation. It minimizes the
#: sum of the fourth powers of the pixels' relative errors. The power 1 minimizes the sum of
#: squares; 2 makes all errors equal, which raises their mean.
_POWER = 4 / 3

#: Each pixel gets at least this fraction of the mean number of samples.
_LEAST = 1 / 8

#: The weight of the first pass, in units of its fraction of all samples. It is less than one, since
#: the first pass does not give noisy pixels more samples than others.
_FIRST_WEIGHT = 1 / 2


class SampleAllocation:
    """Numbers and weights of the samples of a render.

    Parameters:
        moments: Moments of the samples that have been taken.
        spp: Average number of samples per pixel of the render.
        first: Samples per pixel of the first pass, or of the pilots.
        threshold: Relative error at which a pixel gets no more samples; 0 for no threshold.
        set_size: Number of samples of a pixel that are always taken together.

    Attributes:
        is_active: Pixels that get more samples.
    """

    def __init__(
        self, moments: PixelMoments, spp: int, first: int, threshold: float = 0.0, set_size: int = 1
    ) -> None:
        self._moments, self._threshold, self._set_size = moments, threshold, set_size
        size = len(moments.count)
        self._weight_left = np.ones(size)
        # The variance of the image so far, in units of the variance of a sample
        self._variance = np.zeros(size)
        self.is_active = np.ones(size, bool)
        # The weight of each sample of the first pass
        self._first_weight = _FIRST_WEIGHT / spp if first < spp else 1 / first

    def first(self, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """For a part of the first pass that takes ``samples`` samples of every pixel: the number of
        sets of each pixel, and the weight of each of its samples."""
        sets = np.full(len(self.is_active), -(-samples // self._set_size))
        return sets, self._take(sets, self._first_weight * samples * np.ones(len(sets)))

    def next(self, budget: float, is_last: bool, share: float) -> tuple[np.ndarray, np.ndarray]:
        """For the next pass: the number of sets of each pixel, and the weight of each of its
        samples.

        Parameters:
            budget: Number of samples of the pass.
            is_last: Whether it is the last pass.
            share: The fraction of the remaining weight that this pass gets.
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
            # The samples that reach the threshold if this pass gets all the remaining weight
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
        """Records a pass. Returns the weight of each sample."""
        samples = np.maximum(sets * self._set_size, 1)
        self._weight_left = np.maximum(self._weight_left - weight, 0)
        self._variance += weight**2 / samples
        return weight / samples


def _whole(values: np.ndarray, active: np.ndarray) -> np.ndarray:
    """The ``values``, rounded such that their sum stays about the same: rounding errors are carried
    over to the next pixel."""
    total = np.floor(np.cumsum(np.where(active, values, 0)) + 0.5)
    return np.diff(total, prepend=0).astype(np.int64)
