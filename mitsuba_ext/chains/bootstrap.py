"""Independent samples from which chains start."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.numbers import BothEnds, Numbers
from .numbers import ProposedNumbers, StateNumbers, StratifiedNumbers, generator, stream
from .small_steps import SmallSteps
from .target import ImageTarget

#: Streams of random numbers, which differ from those of the chains.
_CAMERA, _LIGHT, _CHOICE = 0, 1, 2


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
        found: What they found.
    """

    def __init__(self, target: ImageTarget, seed: int, count: int) -> None:
        self._seed, self._has_light = seed, target.has_light_paths
        self._cells = math.isqrt(count - 1) + 1
        self.count = self._cells**2
        self.found = target.evaluate(self.numbers(dr.arange(mi.UInt32, self.count)))
        self._sums = np.cumsum(self.found.target.numpy().astype(np.float64))
        self.mean = float(self._sums[-1]) / self.count

    def numbers(self, index: mi.UInt32, records: Sequence[StateNumbers] = ()) -> Numbers:
        """The numbers of these samples; ``records`` are told what is drawn, by camera paths and by
        light paths."""
        camera, light = records or [StateNumbers(SmallSteps())] * 2
        seed = stream(self._seed, _CAMERA)
        numbers = StratifiedNumbers.begin(generator(seed, index), index, self._cells, camera)
        if not self._has_light:
            return numbers
        rng = generator(stream(self._seed, _LIGHT), index)
        none = dr.zeros(mi.UInt32, dr.width(index))
        return BothEnds(numbers, ProposedNumbers(rng, none, mi.UInt32(none), light))

    def choose(self, count: int) -> mi.UInt32:
        """The indices of ``count`` samples, in proportion to the target function. One random offset
        for all of them keeps the numbers of choices near their expectation."""
        offset = float(mi.sample_tea_float32(mi.UInt32(self._seed), _CHOICE)[0])
        places = (np.arange(count) + offset) / count * self._sums[-1]
        index = np.searchsorted(self._sums, places, side="right")
        return mi.UInt32(np.minimum(index, self.count - 1).astype(np.uint32))
