"""Primary samples of camera rays that all pixels share."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ....transport.numbers import Numbers

#: Fractions of 2³², for time and wavelengths: multiples of them fill [0, 1) evenly, in both
#: dimensions at once. (Powers of 1 / 1.3247…, by M. Roberts, *The Unreasonable Effectiveness of
#: Quasirandom Sequences*, 2018.)
TIME_STEP, WAVELENGTH_STEP = 3242174889, 2447445413


class SharedNumbers:
    """The same number for sample k of each pixel, so that paths of different pixels have a time, or
    wavelengths, in common.

    Parameters:
        step: The difference of the numbers of a sample and the next one, times 2³².
        seed: Chooses the first number.
        weights: Number of weights that :meth:`draw` returns; all of them are 1.
    """

    def __init__(self, step: int, seed: int, weights: int) -> None:
        first = int(mi.sample_tea_32(mi.UInt32(seed & 0xFFFFFFFF), mi.UInt32(step))[0][0])
        self._first, self._step = dr.opaque(mi.UInt32, first), step
        self._weights = (1.0,) * weights

    def draw(self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32) -> tuple[Any, ...]:
        """The number for sample ``index`` of each pixel, and its weights."""
        word = self._first + index * mi.UInt32(self._step)
        return mi.Float(word >> 8) * 2**-24, *self._weights
