"""The sources of the numbers that make a camera ray, besides its film position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from ..transport.numbers import Numbers


class PixelNumbers(Protocol):
    """A source of numbers for one purpose."""

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[Any, ...]:
        """The number for sample ``index`` (among all of the render) of each pixel, and its weight
        (or two weights). ``sampler`` is that of the sensor."""


@dataclass
class CameraSamples:
    """The sources of the numbers of camera rays. ``None`` stands for the sensor's sampler, as in
    Mitsuba.

    Attributes:
        aperture: Chooses points of the aperture, in two dimensions.
        time: Chooses times in the shutter interval.
        wavelength: Chooses the four wavelengths u + k/4. Its draws have a second weight, for
            radiance that all four wavelengths carry: the density of u then has the period 1/4.
        distance: Chooses the first distance of a path in a homogeneous medium.
    """

    aperture: PixelNumbers | None = None
    time: PixelNumbers | None = None
    wavelength: PixelNumbers | None = None
    distance: PixelNumbers | None = None
