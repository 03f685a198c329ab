"""The number of samples of each pixel in each pass, and their weight in the image.

The mean over samples whose *number* depends on their values is biased: a pixel that has not found
its rare bright paths yet looks converged, gets few samples, and stays too dark; a pixel that has
found one gets many samples, which average it away. Therefore each pass adds the mean of its own
samples, times a weight. The weight and the number of samples are decided before the pass, from
earlier passes: whatever these were, the mean of the pass is unbiased. The weights of all passes add
up to one, so that the weighted sum is unbiased too.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

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

#: Fixed point of numbers of sets: their running sums are exact.
_UNIT = 2.0**24


class SampleAllocation:
    """Numbers and weights of the samples of a render.

    Parameters:
        moments: Moments of the samples that have been taken.
        spp: Average number of samples per pixel of the render.
        first: Samples per pixel of the first pass, or of the pilots.
        threshold: Relative error at which a pixel gets no more samples; 0 for no threshold.
        set_size: Number of samples of a pixel that are always taken together.

    Attributes:
        has_active: Whether there are pixels that get more samples.
    """

    def __init__(
        self, moments: PixelMoments, spp: int, first: int, threshold: float = 0.0, set_size: int = 1
    ) -> None:
        self._moments, self._threshold, self._set_size = moments, threshold, set_size
        size = moments.pixel_count
        self._weight_left = dr.full(mi.Float64, 1, size)
        # The variance of the image so far, in units of the variance of a sample
        self._variance = dr.zeros(mi.Float64, size)
        self._is_active, self.has_active = dr.full(mi.Bool, True, size), True
        # The weight of each sample of the first pass
        self._first_weight = _FIRST_WEIGHT / spp if first < spp else 1 / first

    def first(self, samples: int) -> tuple[mi.UInt32, mi.Float]:
        """For a part of the first pass that takes ``samples`` samples of every pixel: the number of
        sets of each pixel, and the weight of each of its samples."""
        size = self._moments.pixel_count
        sets = dr.opaque(mi.UInt32, -(-samples // self._set_size), size)
        return sets, self._take(sets, dr.opaque(mi.Float64, self._first_weight * samples, size))

    def next(self, budget: float, is_last: bool, share: float) -> tuple[mi.UInt32, mi.Float]:
        """For the next pass: the number of sets of each pixel, and the weight of each of its
        samples.

        Parameters:
            budget: Number of samples of the pass.
            is_last: Whether it is the last pass.
            share: The fraction of the remaining weight that this pass gets.
        """
        active, deviation = self._is_active, self._moments.deviation()
        wanted = dr.select(active, dr.power(deviation, _POWER), 0)
        dr.eval(deviation, wanted)
        count = dr.maximum(mi.Float64(dr.count(active)), 1)
        mean = dr.sum(wanted) / count
        relative = dr.select(mean > 0, wanted / mean, dr.select(active, mi.Float64(1), 0))
        budget, share = dr.opaque(mi.Float64, budget), dr.opaque(mi.Float64, share)
        samples = budget / count * (_LEAST + (1 - _LEAST) * relative)
        is_done = dr.opaque(mi.Bool, is_last, len(active))
        if self._threshold > 0:
            # The samples that reach the threshold if this pass gets all the remaining weight
            variance = dr.square(deviation)
            left = dr.opaque(mi.Float64, self._threshold**2) - self._variance * variance
            needed = dr.square(self._weight_left) * variance / dr.maximum(left, 1e-30)
            is_done |= needed <= samples
            samples = dr.minimum(samples, needed)
        sets = _whole(samples / dr.opaque(mi.Float64, self._set_size), active)
        sets = dr.select(active, dr.maximum(sets, 1), 0)
        weight = self._weight_left * dr.select(is_done, mi.Float64(1), share)
        scale = self._take(sets, dr.select(active, weight, 0))
        self._is_active = active & ~is_done
        dr.eval(sets, scale, self._is_active)
        self.has_active = bool(dr.any(self._is_active))
        return sets, scale

    def _take(self, sets: mi.UInt32, weight: mi.Float64) -> mi.Float:
        """Records a pass. Returns the weight of each sample."""
        samples = dr.maximum(mi.Float64(sets) * dr.opaque(mi.Float64, self._set_size), 1)
        self._weight_left = dr.maximum(self._weight_left - weight, 0)
        self._variance += dr.square(weight) / samples
        scale = mi.Float(weight / samples)
        dr.eval(self._weight_left, self._variance, scale)
        return scale


def _whole(values: mi.Float64, active: mi.Bool) -> mi.UInt32:
    """The ``values``, rounded such that their sum stays about the same: rounding errors are carried
    over to the next pixel."""
    running = dr.cumsum(mi.UInt64(dr.select(active, values, 0) * _UNIT + 0.5))
    total = mi.UInt64(mi.Float64(running) / _UNIT + 0.5)
    dr.eval(total)
    index = dr.arange(mi.UInt32, len(total))
    return mi.UInt32(total - dr.gather(mi.UInt64, total, index - 1, index > 0))
