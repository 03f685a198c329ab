"""Reduces spectra to colours, and to single numbers by which lights are compared."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .arrays import channel_mean


def brightness(value: mi.Spectrum) -> mi.Float:
    """One number for a spectrum: the luminance in RGB variants, the mean of the channels (sampled
    wavelengths) in the others."""
    return mi.luminance(value) if mi.is_rgb else channel_mean(value)


def comparison_wavelengths(width: int) -> mi.Spectrum:
    """The wavelengths at which lights are compared: the wavelengths sampled with 0.5 in spectral
    variants, none in the others."""
    wavelengths = dr.zeros(mi.Interaction3f, width).wavelengths
    if mi.is_spectral:
        wavelengths[:] = mi.sample_rgb_spectrum(mi.sample_shifted(dr.full(mi.Float, 0.5, width)))[0]
    return wavelengths


def to_rgb(L: mi.Spectrum, wavelengths: mi.Spectrum | None) -> mi.Color3f:
    """Radiance as the colour that films store."""
    L = mi.unpolarized_spectrum(L)
    if mi.is_spectral:
        return mi.spectrum_to_srgb(L, wavelengths)
    return mi.Color3f(L.x) if mi.is_monochromatic else L


def colour_names() -> str:
    """The letters of the colours that an expression has in the film."""
    return "Y" if mi.is_monochromatic else "RGB"


def film_colours(L: mi.Spectrum, wavelengths: mi.Spectrum | None) -> list[mi.Float]:
    """Radiance as these colours."""
    return list(to_rgb(L, wavelengths))[: len(colour_names())]


def load_tables() -> None:
    """Makes Mitsuba load the tables of :func:`to_rgb`. Their first use evaluates all that learners
    have recorded so far: the first render of a process would launch the walk for these records,
    and again for the film, with other kernels than later renders."""
    if mi.is_spectral:
        mi.spectrum_to_srgb(mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(500))
