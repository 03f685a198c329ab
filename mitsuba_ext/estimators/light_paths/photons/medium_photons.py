"""Photons in participating media: vertices at which light paths scatter there, merged with points
of camera paths that lie in a ball around them.

The light that arrives at x and is scattered towards the camera, Σ f_p β / (N · 4/3 π r³), is summed
over the vertices in a ball of radius r, of N light paths: their density is proportional to the
radiance times the coefficient of scattering, which the light walk divides out of β.

In homogeneous media, a camera ray passes through, and gathers light at a few points on its way. In
others, it scatters where a collision is sampled, and gathers light there. Where a ball reaches over
the end of a flight, photons count for what is missing (:class:`FlightLine`).

Source: H. W. Jensen, P. H. Christensen, *Efficient Simulation of Light Transport in Scenes with
Participating Media Using Photon Maps*, SIGGRAPH 1998; C. Knaus, M. Zwicker, *Progressive Photon
Mapping: A Probabilistic Approach*, ACM Transactions on Graphics 30(3), 2011, section 6.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ....transport.chromatic_media import chosen_rate
from ....transport.free_flight import (
    Distances,
    attenuation,
    component,
    extinction,
    interaction_at,
    shared_mean,
)
from ....transport.heroes import Heroes
from ....transport.media import Inside, eval_phase
from ....transport.path_channels import PathChannels
from ....transport.path_decisions import SceneQuery
from ....transport.path_program import Subpaths
from ....transport.vertex import PathState, Vertex
from ..choice.technique_observer import TechniqueObserver
from ..light_vertices import LightVertex, VertexCache, group_of
from ..merging.merging import BATCH, MergedSubpaths, pushed
from ..merging.merging_in_media import FlightLine, absorbed, ball_volume, flight_to, slant
from ..merging.vertex_grid import VertexGrid

#: The number of points at which a ray gathers light on its way through a homogeneous medium. (In
#: volume_caustic, 64 samples: 1 has 0.82 of the efficiency, 2 0.97, 8 0.88, 16 0.67.)
_POINTS = 4


class PassesThrough(Distances):
    """Camera rays pass through homogeneous media: :meth:`PhotonsInMedia.along` finds the light that
    is scattered there."""

    scatter = False


def enters(vertex: Vertex, wo: mi.Vector3f) -> mi.Bool:
    """Whether light from the local direction ``wo`` crosses a rough, clear boundary of a medium
    (skin, wax). Such a boundary blurs what is behind it, and narrow lobes find few photons there: a
    camera path crosses it as if it were smooth, and gathers light inside."""
    flags = vertex.bsdf.flags()
    is_rough = mi.has_flag(flags, mi.BSDFFlags.GlossyTransmission)
    is_rough &= ~mi.has_flag(flags, mi.BSDFFlags.DiffuseTransmission)
    crosses = mi.Frame3f.cos_theta(vertex.si.wi) * mi.Frame3f.cos_theta(wo) < 0
    return is_rough & crosses & vertex.si.is_medium_transition()


class MergedOutside(MergedSubpaths):
    """Adds the light of photons at surfaces, without the light on the other side of boundaries that
    camera paths cross (:func:`enters`)."""

    def _merged(self, vertex, other, flight, active):
        wo = vertex.si.to_local(other.si.to_world(other.si.wi))
        return super()._merged(vertex, other, flight, active & ~enters(vertex, wo))


class PhotonsInMedia(MergedSubpaths):
    """Adds to camera paths the light that light paths bring near them in participating media.

    Parameters:
        vertices, grid, heroes, max_depth, paths, shares_rays, channels: See
            :class:`MergedSubpaths`.
        others: The light at surfaces.
        query: Intersects rays with the scene.
        has_grids: Whether there may be media that are not homogeneous.
        observer: See :class:`MergedSubpaths`.
    """

    _measure = staticmethod(ball_volume)

    def __init__(
        self,
        vertices: VertexCache,
        grid: VertexGrid,
        heroes: Heroes,
        max_depth: int,
        paths: int,
        shares_rays: bool,
        others: Subpaths,
        query: SceneQuery,
        has_grids: bool,
        observer: TechniqueObserver | None = None,
        channels: PathChannels | None = None,
    ) -> None:
        super().__init__(
            vertices, grid, None, heroes, max_depth, paths, shares_rays, others, observer, channels
        )
        self._query, self._has_grids = query, has_grids

    def gather(self, scene, sampler, vertex, active):
        if not self._has_grids:
            return self._others.gather(scene, sampler, vertex, active)
        return super().gather(scene, sampler, vertex, active)

    @dr.syntax
    def along(self, sampler, ray, si, inside, path, active):
        medium = inside.medium
        searches = active & (medium != None)  # noqa: E711
        searches &= medium.is_homogeneous()
        σ = extinction(medium, ray, searches)
        rates = _rates(σ, inside)
        chosen = component(σ, inside.channel) if rates is None else chosen_rate(
            rates, inside.channel
        )
        searches &= chosen > 0
        mei = interaction_at(ray, ray.o, medium)
        σ_s, _, _ = medium.get_scattering_coefficients(mei, searches)
        rate = chosen if rates is None else mi.unpolarized_spectrum(σ)
        line = self._line(ray, si, rate, inside.n)
        points = _Points(line, chosen)
        sample, number = sampler.next_1d(searches), mi.UInt32(0)
        t = points.distance(number, sample)
        weight = mi.Spectrum(σ_s) * path.β * (self._per_vertex / _POINTS)
        if dr.hint(rates is None, mode="scalar"):
            weight *= dr.select(searches, dr.rcp(points.density(0)), 0)
        gathered, state = mi.Spectrum(0), self._grid.begin()
        group = group_of(ray.time, ray.wavelengths) if self._shares_rays else mi.UInt32(0)
        near = [mi.UInt32(0) for _ in range(BATCH)]
        far, looked = [mi.Float(0) for _ in range(BATCH)], mi.UInt32(0)
        while dr.hint(searches, label="merge along a ray"):
            count, fills = mi.UInt32(0), mi.Bool(searches)
            while dr.hint(fills, label="search"):
                state, index, found, goes_on = self._grid.next(state, ray(t), fills, group)
                near, far = pushed(near, index, found), pushed(far, t, found)
                count += dr.select(found, 1, 0)
                looked += 1
                # Go on to the next point
                ends = fills & ~goes_on
                number += dr.select(ends, 1, 0)
                state = dr.select(ends, self._grid.begin(), state)
                t = dr.select(ends, points.distance(number, sample), t)
                searches &= ~ends | (number < _POINTS)
                fills &= searches & (count < BATCH)
            exists = count > 0
            while dr.hint(exists, label="evaluate"):
                other = self._vertices.at(near[0], exists)
                value = self._flux(mei, path, other, exists)
                part, offset = line.at(far[0]), other.si.p - ray(far[0])
                if dr.hint(rates is None, mode="scalar"):
                    value *= part.weight(offset)
                else:
                    passed = attenuation(σ, dr.maximum(far[0], 0))
                    density = _mixed_density(line, rates, inside.shares, far[0])
                    value *= passed * mi.Spectrum(part.weight(offset)) / density
                gathered += value
                if dr.hint(self._channels is not None, mode="scalar"):
                    self._channels.joined_in_medium(path, other.events, value * weight, exists)
                if dr.hint(self._observer is not None, mode="scalar"):
                    self._observer.photon(value * weight, exists)
                near, far = near[1:] + near[:1], far[1:] + far[:1]
                count -= 1
                exists = count > 0
        if dr.hint(self._observer is not None, mode="scalar"):
            self._observer.searched(looked)
        return gathered * weight

    def _line(
        self, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, σ: Any, n_back: mi.Normal3f
    ) -> FlightLine:
        """The line along ``ray``, up to ``si``."""
        radius, n = self._grid.radius, dr.select(si.is_valid(), si.n, 0)
        slants = slant(ray.d, n_back, radius), slant(ray.d, n, radius)
        return FlightLine(ray.d, radius, σ, mi.Float(0), si.t, n_back, n, *slants)

    def _is_merged(self, vertex):
        return vertex.medium.scatters

    def _flight(self, scene, vertex, active):
        return flight_to(self._query, scene, vertex, self._grid.radius, active)

    def _merged(
        self, vertex: Vertex, other: LightVertex, flight: FlightLine, active: mi.Bool
    ) -> mi.Spectrum:
        value = self._flux(vertex.medium.mei, vertex.path, other, active)
        value *= mi.Spectrum(flight.weight(other.si.p - vertex.si.p))
        if self._channels is not None:
            brought = value * vertex.path.β * self._per_vertex
            self._channels.joined_in_medium(vertex.path, other.events, brought, active)
        if self._observer is not None:
            self._observer.photon(value * vertex.path.β * self._per_vertex, active)
        return value

    def _flux(
        self, mei: mi.MediumInteraction3f, path: PathState, other: LightVertex, active: mi.Bool
    ) -> mi.Spectrum:
        """Phase function · flux of one light path."""
        far = other.si
        active = active & (path.depth + other.depth + 1 <= self._max_depth)
        if self._shares_rays:
            active &= (far.time == mei.time) & dr.all(far.wavelengths == mei.wavelengths)
        wo = far.to_world(far.wi)
        value = mi.Spectrum(eval_phase(mei, wo, active)[0])
        value = self._heroes.merge(
            path.hero_is_alone, other.hero_is_alone, value, dr.zeros(mi.BSDFPtr), far, far.wi
        )
        value *= other.β
        active &= dr.all(dr.isfinite(value))
        return dr.select(active, value, 0)


def _rates(σ: mi.UnpolarizedSpectrum, inside: Inside) -> mi.UnpolarizedSpectrum | None:
    """With chromatic media, the rate with which each colour samples distances: its extinction,
    where that is not so small that light of other colours would be missed; else ``None``."""
    return None if inside.shares is None else dr.maximum(σ, 1e-3 * dr.max(σ))


class _Points:
    """The points of a line at which it gathers light. Their density is proportional to the
    transmittance, and constant where the line begins before the flight
    (:func:`slant`).

    Parameters:
        line: The line.
        σ: The extinction.
    """

    def __init__(self, line: FlightLine, σ: mi.Float) -> None:
        self._σ, self._before = σ, σ * line.before
        self._total = self._before + absorbed(σ * (line.ahead + line.behind))

    def distance(self, number: mi.UInt32, sample: mi.Float) -> mi.Float:
        """The distance of a point: the inverse of the distribution at evenly spaced places."""
        x = (mi.Float(number) + sample) / _POINTS * self._total - self._before
        τ = dr.select(x < 0.01, x * (1 + 0.5 * x * (1 + x / 1.5)), -dr.log(1 - x))
        return dr.select(self._σ > 0, dr.select(x < 0, x, τ) / self._σ, 0)

    def density(self, t: mi.Float | float) -> mi.Float:
        """The density of points at the distance ``t``."""
        return self._σ * dr.exp(-self._σ * dr.maximum(t, 0)) / self._total


def _mixed_density(
    line: FlightLine,
    rates: mi.UnpolarizedSpectrum,
    shares: mi.UnpolarizedSpectrum,
    t: mi.Float,
) -> mi.Float:
    """The density with which all colours together choose points at the distance ``t``."""
    densities = [_Points(line, rate).density(t) for rate in rates]
    return shared_mean(mi.UnpolarizedSpectrum(densities), shares)
