"""Which numbers choose what a camera ray is besides its place on the film."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .weighted_sets import WeightedSets


class CameraSamples:
    """Those of the sampler, each with the same weight. This is Mitsuba's choice, and leaves no code
    of its own in the kernel."""

    def begin(self, pixel: mi.UInt32, index: mi.UInt32) -> Any:
        """The state of rays: ``index`` numbers the samples of each pixel in the whole render."""
        return ()

    def aperture(
        self, state: Any, sampler: mi.Sampler
    ) -> tuple[mi.Point2f, mi.Float | float]:
        """The numbers that choose the point of the aperture, and the factor by which everything is
        multiplied that the ray brings back."""
        return sampler.next_2d(), 1.0


class WeightedLens(CameraSamples):
    """Points of the aperture from weighted sets: each pixel chooses and shifts them at random.

    Parameters:
        sets: Of two dimensions. After the last sample of a set, a pixel begins another.
        seed: That of the render.
    """

    def __init__(self, sets: WeightedSets, seed: int) -> None:
        self._sets = sets
        self._seed, self._count = (dr.opaque(mi.UInt32, x) for x in (seed, sets.count))

    def begin(self, pixel, index):
        number = index // self._count
        choice, key = mi.sample_tea_32(pixel, self._seed + 0x9E3779B9 * number)
        shift = mi.Point2f(mi.sample_tea_float32(key, choice), mi.sample_tea_float32(choice, key))
        return choice, shift, index - number * self._count

    def aperture(self, state, sampler):
        choice, shift, index = state
        return self._sets.draw(choice, shift, index, mi.Bool(True))
