"""A few precomputed samples of each bin of an environment."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...util.spectra import brightness, comparison_wavelengths
from .environment_bins import EnvironmentBins

#: The number of directions along each of the two axes of a bin.
_SIDE = 8


class TabulatedBins:
    """Samples bins like :class:`EnvironmentBins`, but only tabulated directions: emission of an
    environment does not depend on position, and evaluating a sky at each point is slow. In a nearly
    black bin at the horizon, all tabulated values can be zero; such a bin must not be excluded.

    Parameters:
        bins: The bins.
    """

    def __init__(self, bins: EnvironmentBins) -> None:
        self.count = bins.count
        index = dr.arange(mi.UInt32, bins.count * _SIDE**2)
        bin, place = index // _SIDE**2, index % _SIDE**2
        sample = (mi.Point2f(place % _SIDE, place // _SIDE) + 0.5) / _SIDE
        ref = dr.zeros(mi.SurfaceInteraction3f, len(index))
        ref.wavelengths = comparison_wavelengths(len(index))
        ds, weight = bins.sample(bin, ref, sample, mi.Bool(True))
        self._directions = mi.Vector3f(ds.d)
        # Some emitters return a single number for all lanes: it is widened
        self._values = brightness(weight) + dr.zeros(mi.Float, len(index))
        dr.eval(self._directions, self._values)

    def sample(
        self, bin: mi.UInt32, ref: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction sample in ``bin`` with only ``d`` set, and its brightness / pdf in all
        channels."""
        place = mi.UInt32(sample.x * _SIDE) * _SIDE + mi.UInt32(sample.y * _SIDE)
        place += bin * _SIDE**2
        ds = dr.zeros(mi.DirectionSample3f, dr.width(place))
        ds.d = dr.gather(mi.Vector3f, self._directions, place, active)
        return ds, mi.Spectrum(dr.gather(mi.Float, self._values, place, active))
