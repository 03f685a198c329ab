"""Spectra as numbers that lights are compared by."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def brightness(value: mi.Spectrum) -> mi.Float:
    """One number for a spectrum: luminance, or the mean over the sampled wavelengths."""
    return mi.luminance(value) if mi.is_rgb else dr.mean(value)


def comparison_wavelengths(width: int) -> mi.Spectrum:
    """Wavelengths of the middle sample in spectral variants, none in the others."""
    wavelengths = dr.zeros(mi.Interaction3f, width).wavelengths
    if mi.is_spectral:
        wavelengths[:] = mi.sample_rgb_spectrum(mi.sample_shifted(dr.full(mi.Float, 0.5, width)))[0]
    return wavelengths
