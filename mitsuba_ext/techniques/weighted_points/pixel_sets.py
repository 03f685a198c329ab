"""Primary samples of camera rays, from weighted sets."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.numbers import Numbers
from .weighted_sets import WeightedSets


class PixelSets:
    """Numbers for one purpose (time, lens, …) from weighted sets, which each pixel chooses and
    shifts at random.

    Parameters:
        sets: The sets. After the last sample of a set, a pixel begins another one.
        seed: Integers, different for each purpose.
    """

    def __init__(self, sets: WeightedSets, seed: list[int]) -> None:
        self._sets = sets
        key = int(np.random.SeedSequence(seed).generate_state(1)[0])
        self._key, self._count = (dr.opaque(mi.UInt32, n) for n in (key, sets.count))

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[Any, ...]:
        """The point and its weights (:meth:`WeightedSets.draw`) for the sample number ``index`` of
        each pixel, counted over the whole render."""
        turn = index // self._count
        a, b = mi.sample_tea_32(pixel, self._key + 0x9E3779B9 * turn)
        shift = mi.Point2f(mi.sample_tea_float32(a, b), mi.sample_tea_float32(b, a))
        number = self._sets.choose(mi.sample_tea_float32(b, a + 1))
        return self._sets.draw(number, shift, index - turn * self._count, mi.Bool(True))
