"""Radiance as a colour."""

from __future__ import annotations

import mitsuba as mi


def to_rgb(L: mi.Spectrum, wavelengths: mi.Spectrum | None) -> mi.Color3f:
    """Radiance as the colour that films store."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(L, wavelengths)
    return mi.Color3f(L.x) if mi.is_monochromatic else L
