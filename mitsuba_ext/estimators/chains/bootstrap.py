"""Independent samples at which chains start."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rendering.device import SampleBytes, device_of
from ...transport.numbers import BothEnds, Numbers
from ...util.arrays import from_numpy
from .numbers import ProposedNumbers, StateNumbers, StratifiedNumbers, generator, stream
from .small_steps import SmallSteps
from .target import Found, ImageTarget

#: Bytes of a sample, about, without and with light paths, whose contributions are stored.
_BYTES = {False: 512, True: 2048}

#: Streams of random numbers, different from the streams of the chains.
_CAMERA, _LIGHT, _CHOICE = 0, 1, 2


class Bootstrap:
    """Samples of the target function, stratified over the film. Chains that start at some of them,
    chosen in proportion to the target function, have no start-up bias: the mean of the samples
    times the distribution of the chains' visits is unbiased from the first mutation on.

    Source: E. Veach, L. Guibas, *Metropolis Light Transport*, SIGGRAPH 1997, section 3.2; D. Cline,
    PhD thesis, 2007, section 7.11.2.

    Parameters:
        target: The target function.
        seed: The seed of the random numbers.
        count: The minimum number of samples.
        take: A function that is called with the contributions of the samples, part by part.

    Attributes:
        count: The number of samples, a square number.
        mean: The mean of the target function.
        error: The standard error of ``mean``, divided by ``mean``, as if the samples were not
            stratified.
    """

    def __init__(
        self,
        target: ImageTarget,
        seed: int,
        count: int,
        take: Callable[[Found], None] | None = None,
    ) -> None:
        self._seed, self._has_light = seed, target.has_light_paths
        self._cells = math.isqrt(count - 1) + 1
        self.count = self._cells**2
        # Parts of equal width, which share kernels
        most = device_of(mi.Float).lanes(SampleBytes(_BYTES[target.has_light_paths]))
        parts = -(-self.count // most)
        width, values = -(-self.count // parts), []
        for part in range(parts):
            index = dr.arange(mi.UInt32, width) + dr.opaque(mi.UInt32, part * width)
            found = target.evaluate(self.numbers(index), index < dr.opaque(mi.UInt32, self.count))
            values.append(found.target.numpy())
            if take is not None:
                take(found)
        values = np.concatenate(values)[: self.count]
        values = values.astype(np.float64)
        self._sums = np.cumsum(values)
        self.mean = float(self._sums[-1]) / self.count
        deviation = float(np.std(values)) / math.sqrt(self.count)
        self.error = deviation / self.mean if self.mean > 0 else 0.0
        # The last sample that is not black: rounding must not choose a later one
        self._last = int(np.searchsorted(self._sums, self._sums[-1]))
        self._offset = float(mi.sample_tea_float32(mi.UInt32(seed), _CHOICE)[0])

    def numbers(self, index: mi.UInt32, records: Sequence[StateNumbers] = ()) -> Numbers:
        """The random numbers of these samples. ``records`` receive the numbers drawn: the first for
        camera paths, the second for light paths."""
        camera, light = records or [StateNumbers(SmallSteps())] * 2
        seed = stream(self._seed, _CAMERA)
        numbers = StratifiedNumbers.begin(generator(seed, index), index, self._cells, camera)
        if not self._has_light:
            return numbers
        rng = generator(stream(self._seed, _LIGHT), index)
        # Not a literal: recorded kernels (transport/frozen.py) would keep the constant until the
        # first mutation, and a scene's first two renders would differ by rounding errors
        known = dr.opaque(mi.UInt32, 0, dr.width(index))
        return BothEnds(
            numbers, ProposedNumbers(rng, dr.zeros(mi.UInt32, dr.width(index)), known, light)
        )

    def choose(self, count: int) -> mi.UInt32:
        """The indices of ``count`` samples, chosen in proportion to the target function by
        systematic sampling: with one random offset for all, the number of times that a sample is
        chosen is close to its expected value."""
        return self._at((np.arange(count) + self._offset) / count * self._sums[-1])

    def choose_by_energy(self, energy: float) -> mi.UInt32:
        """The indices of samples, chosen by systematic sampling: on average, each occurs target
        function / ``energy`` times."""
        if self._sums[-1] == 0:
            return dr.zeros(mi.UInt32, 0)
        count = int(np.floor(self._sums[-1] / energy - self._offset)) + 1
        return self._at((np.arange(count) + self._offset) * energy)

    def _at(self, places: np.ndarray) -> mi.UInt32:
        index = np.searchsorted(self._sums, places, side="right")
        return from_numpy(mi.UInt32, np.minimum(index, self._last))
