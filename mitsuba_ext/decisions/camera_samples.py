"""Which numbers choose what a camera ray is, besides its place on the film."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .weighted_sets import WeightedSets


class PixelSets:
    """Numbers for one purpose from weighted sets: each pixel chooses and shifts them at random.

    Parameters:
        sets: After the last sample of a set, a pixel begins another.
        seed: Integers; no two purposes may have the same.
    """

    def __init__(self, sets: WeightedSets, seed: list[int]) -> None:
        self._sets = sets
        key = int(np.random.SeedSequence(seed).generate_state(1)[0])
        self._key, self._count = (dr.opaque(mi.UInt32, n) for n in (key, sets.count))

    def draw(self, pixel: mi.UInt32, index: mi.UInt32) -> tuple[Any, ...]:
        """The point and its weights (:meth:`WeightedSets.draw`) of the sample ``index``, of those
        of the whole render, of each pixel."""
        turn = index // self._count
        a, b = mi.sample_tea_32(pixel, self._key + 0x9E3779B9 * turn)
        shift = mi.Point2f(mi.sample_tea_float32(a, b), mi.sample_tea_float32(b, a))
        number = self._sets.choose(mi.sample_tea_float32(b, a + 1))
        return self._sets.draw(number, shift, index - turn * self._count, mi.Bool(True))


@dataclass
class CameraSamples:
    """Where numbers of camera rays come from: ``None`` stands for the sensor's sampler, which is
    Mitsuba's choice.

    Attributes:
        aperture: Points of the aperture, in two dimensions.
        time: Times of the shutter interval.
        wavelength: What chooses the four wavelengths u + k/4, with a second weight for spectra that
            all four find: they repeat themselves after 1/4.
    """

    aperture: PixelSets | None = None
    time: PixelSets | None = None
    wavelength: PixelSets | None = None
