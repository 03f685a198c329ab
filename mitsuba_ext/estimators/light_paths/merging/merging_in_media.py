"""Merging in participating media: vertices at which camera paths scatter there, with the vertices
of light paths in a ball around them.

The light that arrives at x and is scattered towards the camera, Σ f_p β / (N · 4/3 π r³), is summed
over the vertices in a ball of radius r, of N light paths: their density is proportional to the
radiance times the coefficient of scattering, which is divided out of β.

Source: J. Křivánek et al., *Unifying Points, Beams, and Paths in Volumetric Light Transport
Simulation*, ACM Transactions on Graphics 33(4), 2014: their estimator P-P3D.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ....transport.vertex import Vertex
from ....util.arrays import to_host
from ..light_vertices import LightVertex, VertexCache
from ..medium_scattering import MediumTerms
from .merging import (
    DOUBLINGS,
    FEW,
    LARGEST,
    PHOTONS_PER_DISK,
    PILOT_PATHS,
    MergedSubpaths,
    scene_diagonal,
)
from .vertex_grid import Kept, VertexCounts

#: The number of photons in a ball that MIS weights count as one sample. (It is larger than on
#: surfaces, because few camera paths scatter in a beam of light, and these meet many photons there.
#: Variance with 8, 24 and 80: mirrored_beam 0.097, 0.063, 0.049; volume_caustic 0.37, 0.39, 0.53.)
PHOTONS_PER_SAMPLE = 24.0

#: The largest radius of a ball, in mean free paths.
_FREE_PATHS = 2.0

#: The largest radius of a ball, in footprints of pixels.
_WIDEST_BALL = 20.0


def ball_volume(radius: mi.Float) -> mi.Float:
    """The volume of a ball."""
    return 4 / 3 * dr.pi * radius * radius * radius


class MergedInMedia(MergedSubpaths):
    """Adds, where a camera path scatters in a medium, the light that light paths bring near it.

    Vertices merge only within a medium: light would otherwise leak through the surface of glass.
    The parameters are the same as for :class:`MergedSubpaths`; ``sums`` is not ``None``.
    """

    #: The volume in which vertices are found, from its radius.
    _measure = staticmethod(ball_volume)

    def _is_merged(self, vertex):
        return vertex.medium.scatters

    def _merged(self, vertex: Vertex, other: LightVertex, active: mi.Bool) -> mi.Spectrum:
        si, far, sums = vertex.si, other.si, self._sums
        terms: MediumTerms = sums.terms
        medium = vertex.medium.mei.medium
        active = active & (vertex.depth + other.depth + 1 <= self._max_depth)
        active &= other.medium == medium
        if self._shares_rays:
            active &= (far.time == si.time) & dr.all(far.wavelengths == si.wavelengths)
        wo = si.to_local(far.to_world(far.wi))
        value, pdf = terms.phase(si, medium, si.wi, wo, active)
        value = self._heroes.merge(
            vertex.path.hero_is_alone, other.hero_is_alone, value, vertex.bsdf, si, wo
        )
        σ_s = terms.scattering(far, medium, active)
        value *= mi.Spectrum(other.β * dr.select(σ_s > 0, dr.rcp(σ_s), 0))
        _, reverse = terms.phase(si, medium, wo, si.wi, active)
        ends = other.history, pdf, vertex.path.history, reverse
        mis = sums.merging_weight(*ends)
        value *= mis
        active &= dr.all(dr.isfinite(value))
        brought = value * vertex.path.β * self._per_vertex
        if self._channels is not None:
            self._channels.joined_in_medium(vertex.path, other.events, brought, active)
        if self._observer is not None:
            competing = None
            if sums.splits:
                is_first = other.depth == 1, vertex.depth == 0
                competing = sums.competing_with_merging(*ends, is_first)
            self._observer.merged(brought, mis, competing, active, in_medium=True)
        return dr.select(active, value, 0)


def widest_ball(scene: mi.Scene, footprint: float) -> float:
    """The largest radius of a ball, where a pixel is ``footprint`` wide (0: a radiance meter)."""
    largest = LARGEST * scene_diagonal(scene)
    return min(_WIDEST_BALL * footprint, largest) if footprint > 0 else largest


def suitable_ball(
    scene: mi.Scene,
    vertices: VertexCache,
    kept: Kept,
    footprint: float,
    pixels: int,
    free_path: float,
) -> float | None:
    """The radius in which a ball holds ``PHOTONS_PER_DISK`` vertices, with one light path per
    pixel: the median over the vertices, because their density near small lamps has no bound.
    ``None`` if there are too few vertices. See :func:`suitable_radius`.

    In dense media, light lies within a mean free path of the surface, and a wide ball would reach
    out of the medium: ``free_path``, the mean free path, limits the radius."""
    least = 2 * footprint or scene_diagonal(scene) / 500
    for doublings in range(DOUBLINGS):
        radius = least * 2**doublings
        counts = VertexCounts(vertices, dr.opaque(mi.Float, radius), kept)
        if counts.count < FEW:
            return None
        others = counts.median_occupancy
        if others > 4:
            break
    per_volume = max(others, 1e-6) / (2 * radius) ** 3
    count = PHOTONS_PER_DISK * PILOT_PATHS / pixels
    found = (count / (4 / 3 * math.pi * per_volume)) ** (1 / 3)
    return min(found, widest_ball(scene, footprint), _FREE_PATHS * free_path)


def median_free_path(vertices: VertexCache, kept: Kept) -> float:
    """The median of the mean free paths at these vertices, which know their media; 0 if there are
    none."""
    index, active = vertices.every()
    active &= kept(index, active)
    vertex = vertices.at(index, active)
    σ = MediumTerms(True).extinction(vertex.si, vertex.medium)
    (found,) = to_host(dr.select(active, σ, -1))
    found = found[found >= 0]
    return 1 / max(float(np.median(found)), 1e-30) if len(found) else 0.0
