"""Which numbers choose what a camera ray is, besides its place on the film."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from ..transport.numbers import Numbers


class PixelNumbers(Protocol):
    """Numbers for one purpose."""

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[Any, ...]:
        """The number, and its weight (or two), of the sample ``index``, of those of the whole
        render, of each pixel. ``sampler`` is that of the sensor."""


@dataclass
class CameraSamples:
    """Where numbers of camera rays come from: ``None`` stands for the sensor's sampler, which is
    Mitsuba's choice.

    Attributes:
        aperture: Points of the aperture, in two dimensions.
        time: Times of the shutter interval.
        wavelength: What chooses the four wavelengths u + k/4, with a second weight for spectra that
            all four find: they repeat themselves after 1/4.
        distance: What chooses the first distance of a path in a homogeneous medium.
    """

    aperture: PixelNumbers | None = None
    time: PixelNumbers | None = None
    wavelength: PixelNumbers | None = None
    distance: PixelNumbers | None = None
