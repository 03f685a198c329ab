"""What photons and virtual lights remember of their way."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ....transport.path_decisions import SubpathSelection
from ....transport.vertex import Vertex
from ..both_ends import from_both_ends
from ..partial_sums import Sums


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

    def leave(self, sums, cosine, pdf, reverse_pdf, is_delta, is_first, by_light) -> Sums:
        """Behind a vertex."""
        return replace(sums, dVCM=dr.select(is_delta, sums.dVCM, 1))


class VertexRegions(PhotonHistory):
    """Tells the region in which each vertex lies.

    Parameters:
        selection: Divides surfaces into regions.
    """

    def __init__(self, selection: SubpathSelection) -> None:
        self.selection = selection

    def first(self, scene, emitted, si, active) -> Sums:
        sums = super().first(scene, emitted, si, active)
        sums.region = dr.zeros(mi.UInt32, dr.width(emitted.ray))
        sums.count = dr.full(mi.Float, 1, dr.width(emitted.ray))
        return sums

    def arrive(self, sums, si, squared_distance, is_first, by_light) -> Sums:
        return replace(sums, region=self.selection.region(from_both_ends(si), si.is_valid()))


class HiddenLight(PhotonHistory):
    """Tells the photons that only a camera path which hits the light can find too, in scenes with
    media: those that left the light by way of mirrors or clear glass, so that no connection leads
    there. Their ``dVCM`` is 0, that of others is 1. ``dVC`` is radiance / power of the emitted ray:
    the radiance that such a camera path finds, in units of what the photon carries; 0 of lights
    that it cannot hit.
    """

    def first(self, scene, emitted, si, active) -> Sums:
        density = emitted.probability * emitted.pdf_position * emitted.pdf_direction
        density *= dr.select(emitted.cosine > 0, dr.rcp(emitted.cosine), 0)
        is_delta = emitted.is_delta_position | emitted.is_delta_direction
        one = dr.full(mi.Float, 1, dr.width(emitted.ray))
        return Sums(one, dr.select(is_delta, 0, density))

    def scatter(self, sums: Sums, vertex: Vertex, bs: mi.BSDFSample3f) -> Sums:
        """Behind a vertex, which may lie in a medium."""
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & ~vertex.medium.scatters
        passes = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        is_hidden = (vertex.depth == 1) & is_delta & ~passes
        return replace(sums, dVCM=dr.select(is_hidden, 0, sums.dVCM))
