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
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ....transport.free_flight import extinction
from ....transport.path_decisions import SceneQuery
from ....transport.vertex import Vertex
from ....util.arrays import to_host
from ..light_vertices import LightVertex, VertexCache
from ..medium_scattering import MediumTerms
from .merging import (
    LARGEST,
    PHOTONS_PER_DISK,
    PILOT_PATHS,
    MergedSubpaths,
    crowded_radius,
    scene_diagonal,
)
from .vertex_grid import Kept

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


def absorbed(τ: mi.Float) -> mi.Float:
    """1 − exp(−τ), without cancellation."""
    return dr.select(τ < 0.01, τ * (1 - 0.5 * τ * (1 - τ / 3)), 1 - dr.exp(-τ))


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class FlightLine:
    """The line along which a camera path flies through a medium, from a surface (or a vertex, or
    the sensor) to the next surface, seen from a point of the line.

    A ball around that point finds a photon if the point lies on the chord that the ball around the
    photon cuts out of the line. Where a flight ends, a part of the chord is outside, and the photon
    is found too rarely: without :meth:`weight`, the medium is too dark within the radius of its
    boundary. With it, each photon counts as if it met the line in one point, with the transmittance
    there; only the blur across the line is left.

    Source: J. Křivánek et al. 2014 (see above): their estimator P-B2D, of which points of the line
    find a random part of the photons.

    Parameters:
        d, radius: The direction of the line, and the radius of balls.
        σ: The extinction, or one for each colour; 0 where it is not constant.
        back, ahead: How far the flight has come, and how far it goes on.
        n_back, n_ahead: The normals of the surfaces at its ends; 0 where there is none.
        before, behind: How much longer than the flight the line is (:func:`slant`).
    """

    def __init__(
        self,
        d: mi.Vector3f,
        radius: mi.Float,
        σ: Any,
        back: mi.Float,
        ahead: mi.Float,
        n_back: mi.Normal3f,
        n_ahead: mi.Normal3f,
        before: mi.Float | float = 0.0,
        behind: mi.Float | float = 0.0,
    ) -> None:
        self.d, self.radius, self.σ, self.back, self.ahead = d, radius, σ, back, ahead
        self.n_back, self.n_ahead, self.before, self.behind = n_back, n_ahead, before, behind

    def at(self, t: mi.Float) -> FlightLine:
        """The line as seen from the distance ``t`` ahead."""
        return FlightLine(
            self.d, self.radius, self.σ, self.back + t, self.ahead - t, self.n_back, self.n_ahead,
            self.before, self.behind,
        )  # fmt: skip

    def weight(self, offset: mi.Vector3f) -> Any:
        """What multiplies the light of a photon that was found, for each colour of the extinction.
        ``offset`` leads from the point to the photon."""
        σ = self.σ
        # The chord, of which an eighth lies on the line in any case: the weight has a bound
        along = dr.dot(offset, self.d)
        squared = dr.square(self.radius) - dr.squared_norm(offset) + dr.square(along)
        half = dr.safe_sqrt(squared)
        first, last = -(self.back + self.before), self.ahead + self.behind
        begins, ends = dr.maximum(along - half, first), dr.minimum(along + half, last)
        ends = dr.minimum(dr.maximum(ends, begins + half / 8), last)
        begins = dr.maximum(dr.minimum(begins, ends - half / 8), first)
        # Where the photon lies: measured parallel to the first surface, so that a flat one adds no
        # bias
        cosine = dr.dot(self.n_back, self.d)
        depth = dr.select(cosine != 0, dr.dot(offset, self.n_back) / cosine, along)
        # No light comes from behind the surfaces at both ends
        from_end = offset - dr.minimum(self.ahead, 1e30) * self.d
        is_between = dr.dot(from_end, self.n_ahead) * dr.dot(self.d, self.n_ahead) <= 0
        is_between &= depth >= -self.back
        depth = dr.clip(depth, along - self.radius, along + self.radius)
        depth = dr.clip(depth, -self.back, self.ahead)
        # The transmittance along the chord, relative to the point. It is 1 before the flight
        flat = dr.minimum(ends, -self.back) - dr.minimum(begins, -self.back)
        flat = dr.maximum(flat, 0)
        begins, ends = dr.maximum(begins, -self.back), dr.maximum(ends, -self.back)
        τ = σ * (ends - begins)
        passed = dr.exp(-σ * begins) * dr.select(τ > 0, absorbed(τ) / τ, 1) * (ends - begins)
        passed += dr.select(flat > 0, flat * dr.exp(σ * self.back), 0)
        found = 2 * half * dr.exp(-σ * depth) / passed
        return dr.select(is_between & (passed > 0), found, 0)


def slant(d: mi.Vector3f, n: mi.Normal3f, radius: mi.Float) -> mi.Float:
    """How much longer than a flight the line has to be: photons near an oblique surface lie beside
    the line before the flight begins, or behind its end. ``n`` is the normal, 0 for none."""
    cosine = dr.abs(dr.dot(n, d))
    tangent = dr.safe_sqrt(1 - dr.square(cosine)) / cosine
    return dr.select(cosine > 0, radius * dr.minimum(tangent, 1), 0)


def flight_to(
    query: SceneQuery, scene: mi.Scene, vertex: Vertex, radius: mi.Float, active: mi.Bool
) -> FlightLine:
    """The flight that ends at a vertex in a medium, and the line that goes on from there."""
    si, ref, medium = vertex.si, vertex.path.arrival.ref, vertex.medium.mei.medium
    ray = mi.Ray3f(si.p, -vertex.medium.mei.wi, si.time, si.wavelengths)
    known = active & medium.is_homogeneous()
    σ = mi.unpolarized_spectrum(extinction(medium, ray, known))
    # Chords end within a diameter of the vertex
    ray.maxt = 2 * radius
    pi = query.closest(scene, ray, coherent=False, active=active)
    ahead = dr.select(pi.is_valid(), pi.t, dr.inf)
    # Flights also begin at index-matched surfaces, which are no vertices
    begins = dr.squared_norm(ref.p + si.t * ray.d - si.p) < dr.square(0.01 * radius)
    n_back = dr.select(begins, ref.n, 0)
    if not query.has_chromatic_media:
        σ = σ[0]
    return FlightLine(ray.d, radius, σ, si.t, ahead, n_back, mi.Normal3f(0))


class MergedInMedia(MergedSubpaths):
    """Adds, where a camera path scatters in a medium, the light that light paths bring near it.

    Vertices merge only within a medium: light would otherwise leak through the surface of glass.
    The parameters are the same as for :class:`MergedSubpaths`; ``sums`` is not ``None``.
    """

    #: The volume in which vertices are found, from its radius.
    _measure = staticmethod(ball_volume)

    def __init__(self, *args: Any, query: SceneQuery) -> None:
        super().__init__(*args)
        self._query = query

    def _is_merged(self, vertex):
        return vertex.medium.scatters

    def _flight(self, scene, vertex, active):
        return flight_to(self._query, scene, vertex, self._grid.radius, active)

    def _merged(
        self, vertex: Vertex, other: LightVertex, flight: FlightLine, active: mi.Bool
    ) -> mi.Spectrum:
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
        value *= mi.Spectrum(flight.weight(far.p - si.p))
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
            self._observer.found_by(other.lane)
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
    crowded = crowded_radius(vertices, kept, least, lambda counts: counts.median_occupancy)
    if crowded is None:
        return None
    radius, others = crowded
    per_volume = others / (2 * radius) ** 3
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
