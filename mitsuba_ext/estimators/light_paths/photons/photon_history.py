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
