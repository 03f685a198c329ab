"""Independent samples from which chains start."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from .numbers import StratifiedNumbers, generator
from .target import ImageTarget


class Bootstrap:
    """Samples of the target function, stratified over the film. Chains that start at some of them,
    chosen in proportion to the target function, have no start-up bias: the product of the mean of
    the samples and of what the chains find is right on average, from the first mutation on.

    Source: E. Veach, L. Guibas, *Metropolis Light Transport*, SIGGRAPH 1997, section 3.2; D. Cline,
    PhD thesis, 2007, section 7.11.2.

    Parameters:
        target: What is sampled.
        seed: Of the random numbers.
        count: How many samples there are at least.

    Attributes:
        count: How many there are: a square.
        mean: The mean of the target function.
    """

    def __init__(self, target: ImageTarget, seed: int, count: int) -> None:
        self._seed = int(mi.sample_tea_32(mi.UInt32(seed), 0)[0][0])
        self._cells = math.isqrt(count - 1) + 1
        self.count = self._cells**2
        found, _sample = target(self.numbers(dr.arange(mi.UInt32, self.count)))
        self._sums = np.cumsum(found.target.numpy().astype(np.float64))
        self.mean = float(self._sums[-1]) / self.count

    def numbers(self, index: mi.UInt32) -> StratifiedNumbers:
        """The numbers of these samples."""
        return StratifiedNumbers.begin(generator(self._seed, index), index, self._cells)

    def choose(self, count: int) -> mi.UInt32:
        """The indices of ``count`` samples, in proportion to the target function. One random offset
        for all of them keeps the numbers of choices near their expectation."""
        offset = float(mi.sample_tea_float32(mi.UInt32(self._seed), 1)[0])
        places = (np.arange(count) + offset) / count * self._sums[-1]
        index = np.searchsorted(self._sums, places, side="right")
        return mi.UInt32(np.minimum(index, self.count - 1).astype(np.uint32))
