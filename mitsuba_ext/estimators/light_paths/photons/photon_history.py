"""What photons and virtual lights remember about their paths."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.path_decisions import SubpathSelection
from ..both_ends import from_both_ends
from ..light_program import LightProgram, StoredHistory


@dataclass
class PhotonHistory:
    """What a photon remembers.

    Attributes:
        scattered: 0 if the photon has met nothing but mirrors, glass and other surfaces that store
            no photons; 1 otherwise.
    """

    scattered: mi.Float


class _StoredPhoton(StoredHistory):
    def words(self, history: PhotonHistory) -> list[mi.Float]:
        return [history.scattered]

    def read(self, words, depth, region) -> PhotonHistory:
        return PhotonHistory(words[0])


class PhotonProgram(LightProgram):
    """Marks the photons of caustics."""

    stored = _StoredPhoton(word_count=1)

    def first(self, scene, query, emitted, pi, active) -> PhotonHistory:
        return PhotonHistory(dr.zeros(mi.Float, dr.width(emitted.ray)))

    def leave(self, history: PhotonHistory, vertex, bs, reverse_pdf, passes) -> PhotonHistory:
        return PhotonHistory(dr.select(passes, history.scattered, 1))


@dataclass
class RegionHistory:
    """
    Attributes:
        region: The region in which the last vertex lies.
    """

    region: mi.UInt32


class _StoredRegion(StoredHistory):
    def read(self, words, depth, region) -> RegionHistory:
        return RegionHistory(region)


class RegionProgram(LightProgram):
    """Stores the region in which each vertex lies.

    Parameters:
        selection: Divides surfaces into regions.
    """

    stored = _StoredRegion(has_region=True)

    def __init__(self, selection: SubpathSelection) -> None:
        self._selection = selection

    def first(self, scene, query, emitted, pi, active) -> RegionHistory:
        return RegionHistory(dr.zeros(mi.UInt32, dr.width(emitted.ray)))

    def arrive(self, history, vertex, start) -> RegionHistory:
        si = vertex.si
        return RegionHistory(self._selection.region(from_both_ends(si), si.is_valid()))


@dataclass
class HiddenLight:
    """What a photon remembers about its light.

    Attributes:
        connects_before: 1 if two vertices before the last one can be connected to each other, the
            vertex on the light included; 0 if there is a mirror or clear glass at every other one.
        connectable: The same with the photon as the last vertex: 0 if only a camera path that hits
            the light can find the photon too, unless the photon can be connected to the camera
            path.
        radiance: The radiance that such a camera path finds, in units of what the photon carries:
            radiance / power of the emitted ray. 0 for lights that no path can hit.
    """

    connects_before: mi.Float
    connectable: mi.Float
    radiance: mi.Float

    @property
    def is_hidden(self) -> mi.Bool:
        """Whether no connection finds the photon."""
        return self.connectable == 0


class _StoredHiddenLight(StoredHistory):
    def words(self, history: HiddenLight) -> list[mi.Float]:
        return [history.connectable, history.radiance]

    def read(self, words, depth, region) -> HiddenLight:
        return HiddenLight(mi.Float(0), *words)


class HiddenLightProgram(LightProgram):
    """Marks the photons of hidden lights, in scenes with media."""

    stored = _StoredHiddenLight(word_count=2)

    def first(self, scene, query, emitted, pi, active) -> HiddenLight:
        density = emitted.probability * emitted.pdf_position * emitted.pdf_direction
        density *= dr.select(emitted.cosine > 0, dr.rcp(emitted.cosine), 0)
        is_delta = emitted.is_delta_position | emitted.is_delta_direction
        lanes = dr.width(emitted.ray)
        zero, one = dr.zeros(mi.Float, lanes), dr.full(mi.Float, 1, lanes)
        return HiddenLight(zero, one, dr.select(is_delta, 0, density))

    def leave(self, history: HiddenLight, vertex, bs, reverse_pdf, passes) -> HiddenLight:
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & ~vertex.medium.scatters
        is_null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        before, with_last = history.connects_before, history.connectable
        # Radiance is smaller by η² in air than in glass; what photons carry is the same
        η = dr.select(vertex.medium.scatters, 1, bs.eta)
        return HiddenLight(
            dr.select(is_delta | is_null, before, with_last),
            dr.select(is_null, with_last, dr.select(is_delta, before, 1)),
            history.radiance * dr.square(η),
        )
