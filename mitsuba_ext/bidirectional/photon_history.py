"""What photons remember of their way."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from .partial_sums import Sums


class PhotonHistory:
    """Tells the photons of caustics, in the place of :class:`PartialSums`: those that have met
    nothing but mirrors, glass and other surfaces that store no photons. Their ``dVCM`` is 0, as it
    is behind delta lobes; that of others is 1.
    """

    selection, splits, merging = None, False, None

    def first(self, scene, emitted, si, active) -> Sums:
        """At the first vertex after the light."""
        lanes = dr.width(emitted.ray)
        return Sums(dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes))

    def arrive(self, sums, si, squared_distance, is_first, by_light) -> Sums:
        """At the next vertex."""
        return sums

    def leave(self, sums, cosine, pdf, reverse_pdf, is_delta, is_first=False) -> Sums:
        """Behind a vertex."""
        return replace(sums, dVCM=dr.select(is_delta, sums.dVCM, 1))
