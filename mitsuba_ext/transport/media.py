"""Participating media in the random walk.

The walk uses :class:`Media` in scenes with media, and :class:`NoMedia` in others. ``Media`` decides
as Mitsuba's ``volpath`` does, and (except for shadow rays through homogeneous media, whose
transmittance is computed) draws the same random numbers in the same order:

- a path that is in a medium reaches the next surface, or scatters at a sampled distance
  (``free_flight.py``); in the latter case, its vertex lies in the medium, and the phase function
  takes the place of the BSDF;
- shadow rays pass through media and index-matched surfaces (``transmittance.py``);
- index-matched surfaces do not count as vertices: the path keeps its depth, and the density with
  which it left the last vertex.

All decisions see a vertex in a medium as a surface interaction that has a position, but no shape,
no BSDF (a null pointer, whose calls return zero) and no normal.

Sources: Mitsuba 3.9.1, ``volpath``; E. Woodcock et al., *Techniques used in the GEM code*, 1965
(null collisions); J. Novák et al., *Monte Carlo Methods for Volumetric Light Transport Simulation*,
Computer Graphics Forum 37(2), 2018, sections 3 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..util.arrays import channel_mean
from .free_flight import Distances, attenuation, component, extinction, interaction_at, track
from .hidden_emitters import behind_emitters
from .no_media import NoMedia
from .transmittance import Way, transmittance
from .vertex import Arrival, MediumVertex, PathState, Vertex


@dataclass
class Inside:
    """The state of a path between two vertices, in a scene with media.

    Attributes:
        medium: The medium; null in a vacuum.
        channel: The colour whose extinction chooses distances.
        reach: The distance at which a homogeneous medium scatters, if no surface is closer.
        distances: The state of the decision that chooses distances (:class:`Distances`).
        shares: The probability with which each colour chooses the next distance, in scenes with
            chromatic media; ``None`` in others, where one colour chooses all distances of a path.
        number: The number of a flight whose distance is chosen at its end, −1 for other flights;
            ``None`` if there are only these.
        n: The normal of the surface that the path left last, 0 at the sensor; only for paths that
            pass through media (:attr:`Distances.scatter`), else ``None``.
    """

    medium: mi.MediumPtr
    channel: mi.UInt32
    reach: mi.Float
    distances: Any
    shares: mi.UnpolarizedSpectrum | None = None
    number: mi.Float | None = None
    n: mi.Normal3f | None = None


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class Media(NoMedia):
    """For scenes with media.

    Parameters:
        hide_emitters: Whether lights are invisible to rays that nothing has scattered yet.
        distances: Draws the random numbers that choose distances.
        has_grids: Whether there may be media that are not homogeneous.
        connects_all: Whether vertices are connected to lights also in media that switch emitter
            sampling off.
    """

    exist = True
    # Embree's packets miss shared edges of triangles more often than its single rays, which
    # ``volpath`` traces. A ray that misses the boundary of a medium never sees the medium
    coherent = False

    def __init__(
        self,
        hide_emitters: bool,
        distances: Distances,
        has_grids: bool = True,
        connects_all: bool = False,
    ) -> None:
        super().__init__(hide_emitters)
        self._distances, self._has_grids = distances, has_grids
        self._connects_all = connects_all

    def begin(self, sampler, rays):
        channel = mi.UInt32(0)
        if mi.is_rgb:
            count = len(mi.Spectrum())
            channel = mi.UInt32(dr.minimum(sampler.next_1d() * count, count - 1))
        sampler.next_1d()  # `volpath` draws a roulette number that camera rays do not use
        distances = self._distances.begin(rays)
        number = mi.Float(-1) if self._distances.waits else None
        reach = mi.Float(dr.inf)
        n = None if self._distances.scatter else dr.zeros(mi.Normal3f)
        return Inside(mi.MediumPtr(rays.medium), channel, reach, distances, number=number, n=n)

    def launch(self, inside, β, sampler, rays, ray, active):
        if not self._distances.scatter:
            return ray, inside
        in_medium = active & (inside.medium != None)  # noqa: E711
        known = in_medium & inside.medium.is_homogeneous()
        σ = self._rate(extinction(inside.medium, ray, known), inside)
        # 1 − u > 0; an extinction of 0 gives an infinite distance
        u, distances = self._distances.draw(inside.distances, sampler, rays, known)
        t = -dr.log(1 - u) / σ
        reach, number = dr.select(known & (t <= ray.maxt), t, dr.inf), None
        if self._distances.waits:
            is_late = known & self._distances.is_late(distances)
            reach, number = dr.select(is_late, dr.inf, reach), dr.select(is_late, u, -1)
        ray = mi.Ray3f(ray)
        ray.maxt = dr.minimum(ray.maxt, reach)
        return ray, replace(inside, reach=reach, distances=distances, number=number)

    def behind(self, query, scene, ray, pi, active):
        last, behind = behind_emitters(query, scene, ray, pi, active)
        # A hidden light is not a vertex: distances are measured from the ray's origin
        behind.t += dr.norm(last.o - ray.o)
        behind.valid &= behind.t <= ray.maxt
        behind.t = dr.select(behind.valid, behind.t, dr.inf)
        return ray, dr.select(active, behind, pi)

    def fly(self, inside, sampler, ray, si, β, active):
        in_medium = active & (inside.medium != None)  # noqa: E711
        is_homogeneous = in_medium & inside.medium.is_homogeneous()
        σ = extinction(inside.medium, ray, is_homogeneous)
        scatters = is_homogeneous & ~si.is_valid() & (inside.reach < dr.inf)
        t, guided = dr.minimum(inside.reach, si.t), None
        if self._distances.waits:
            t, scatters, guided = self._late(inside, ray, si, σ, t, scatters, is_homogeneous)
        flown = t
        mei = interaction_at(ray, ray(t), inside.medium)
        σ_s, _, _ = inside.medium.get_scattering_coefficients(mei, scatters)
        sampler.next_1d(scatters)  # `volpath` draws whether the collision is real
        weight = self._flown(σ, σ_s, t, scatters, inside)
        if guided is not None:
            weight *= guided
        β = dr.select(is_homogeneous, β * mi.Spectrum(weight), β)
        # ----- Media of varying density -----
        if self._has_grids:
            tracks = in_medium & ~is_homogeneous
            t, β, collides = track(
                sampler, ray, si.t, inside.medium, inside.channel, inside.shares, t, β, tracks
            )
            scatters |= collides
        mei = interaction_at(ray, ray(t), inside.medium)
        # Costs nothing where it is not used
        attenuated = dr.select(is_homogeneous, channel_mean(attenuation(σ, flown)), 1)
        return vertex_at(si, mei, t, scatters), β, MediumVertex(scatters, mei, attenuated, guided)

    def _late(self, inside, ray, si, σ, t, scatters, active):
        """``t`` and ``scatters``, also of flights whose distance is chosen now, and the weight of
        the choice."""
        is_late = active & (inside.number >= 0)
        σ_s, _, _ = inside.medium.get_scattering_coefficients(
            interaction_at(ray, ray.o, inside.medium), is_late
        )
        chosen = self._rate(mi.Spectrum(σ_s), inside)
        late_t, late_scatters, weight = self._distances.warp(
            inside.number, ray, si, self._rate(σ, inside), chosen, is_late
        )
        t = dr.select(is_late, late_t, t)
        return t, dr.select(is_late, late_scatters, scatters), weight

    def sampling_weight(self, path, in_medium):
        if in_medium.weight is None:
            return path.sampling_weight
        return path.sampling_weight * in_medium.weight

    def _rate(self, σ, inside):
        """The extinction ``σ`` with which the distance of a flight is sampled."""
        return component(σ, inside.channel)

    def _flown(self, σ, σ_s, t, scatters, inside):
        """What a flight to the distance ``t`` in a homogeneous medium multiplies the throughput
        by."""
        chosen = component(σ, inside.channel)
        # Relative to the probability of getting this far
        ratio = attenuation(σ - chosen if self._distances.scatter else σ, t)
        return ratio * dr.select(scatters, σ_s / chosen, 1)

    def meets(self, pi, inside):
        # A path may scatter although no surface ends its ray
        return pi.is_valid() | (inside.medium != None)  # noqa: E711

    def arriving(self, β, vertex):
        in_medium = vertex.medium
        scatters, mei = in_medium.scatters, in_medium.mei
        σ_s, _, _ = mei.medium.get_scattering_coefficients(mei, scatters)
        σ_s = mi.Spectrum(σ_s)
        # Where nothing is scattered, β is zero
        return dr.select(scatters, β * dr.select(σ_s > 0, dr.rcp(σ_s), 0), β)

    def goes_on(self, vertex, max_depth, active):
        flags, in_medium = vertex.bsdf.flags(), vertex.medium
        counts = vertex.depth + 1 < max_depth
        may_pass = mi.has_flag(flags, mi.BSDFFlags.Null)
        goes_on = active & vertex.si.is_valid() & (counts | may_pass)
        connects = in_medium.scatters & self._connects(in_medium.mei.medium)
        connects |= mi.has_flag(flags, mi.BSDFFlags.Smooth)
        return goes_on, goes_on & counts & connects

    def _connects(self, medium: mi.MediumPtr) -> mi.Bool:
        """Whether vertices in ``medium`` are connected to lights."""
        return mi.Bool(True) if self._connects_all else medium.use_emitter_sampling()

    def turns(self, vertex, active):
        is_matched = vertex.bsdf.flags() & mi.UInt32(+mi.BSDFFlags.All) == +mi.BSDFFlags.Null
        return active & ~is_matched

    def eval(self, vertex: Vertex, d, value, pdf, active) -> tuple[mi.Spectrum, mi.Float]:
        """The value and the density of the direction ``d`` (in world space): in a medium from the
        phase function, elsewhere ``value`` and ``pdf``, which come from the BSDF."""
        in_medium = vertex.medium
        active = active & in_medium.scatters
        phase_value, phase_pdf = eval_phase(in_medium.mei, d, active)
        return dr.select(active, phase_value, value), dr.select(active, phase_pdf, pdf)

    def transmittance(
        self, query, scene, vertex: Vertex, ds, inside, finds_way: bool, sampler, active
    ) -> tuple[mi.Spectrum, mi.Float, Way | None]:
        """The transmittance between ``vertex`` and the light sample ``ds``, and the part of it that
        is known; see :func:`transmittance`."""
        return transmittance(
            query, scene, vertex.si, ds, inside.medium, inside.channel, self._has_grids,
            self._distances.exact_transmittance, finds_way, sampler, active,
        )  # fmt: skip

    def scatter(self, vertex, sample_1, sample_2, bs, weight, is_given=False):
        in_medium, si = vertex.medium, vertex.si
        scatters, mei = in_medium.scatters, in_medium.mei
        if is_given:
            wo = direction_at(sample_2)
            value, pdf = eval_phase(mei, wo, scatters)
            phase_weight = value / pdf
        else:
            wo, phase_weight, pdf = sample_phase(mei, sample_1, sample_2, scatters)
        bs = mi.BSDFSample3f(bs)
        bs.wo = dr.select(scatters, si.to_local(wo), bs.wo)
        bs.pdf = dr.select(scatters, pdf, bs.pdf)
        bs.eta = dr.select(scatters, 1, bs.eta)
        is_smooth = dr.select(
            self._connects(mei.medium),
            mi.UInt32(+mi.BSDFFlags.DiffuseTransmission),
            # No connection finds light in this direction
            mi.UInt32(+mi.BSDFFlags.DeltaTransmission),
        )
        bs.sampled_type = dr.select(scatters, is_smooth, bs.sampled_type)
        phase_weight = dr.select(pdf > 0, phase_weight, 0)
        return bs, dr.select(scatters, phase_weight, weight)

    def scattered(self, bs, active):
        return active & ~_passes(bs)

    def depth_behind(self, bs, depth):
        return depth + dr.select(_passes(bs), mi.UInt32(0), 1)

    def leave(self, vertex, bs, path):
        passes = _passes(bs)
        before = vertex.path
        arrival = Arrival(
            dr.select(passes, before.arrival.ref, path.arrival.ref),
            dr.select(passes, before.arrival.pdf, path.arrival.pdf),
            dr.select(passes, before.arrival.is_delta, path.arrival.is_delta),
        )
        depth = dr.select(passes, before.depth, path.depth)
        return PathState(
            path.β, path.η, path.sampling_weight, depth, arrival, path.hero_is_alone,
            path.history, path.events, path.sums,
        )

    def is_within(self, depth, max_depth, active):
        # `goes_on` lets a path leave its last vertex if that may be index-matched
        return active & (depth < max_depth)

    def kept(self, bs, before, after):
        return dr.select(_passes(bs), before, after)

    def cross(self, inside, si, d):
        medium = dr.select(si.is_medium_transition(), si.target_medium(d), inside.medium)
        return replace(inside, medium=medium, n=None if inside.n is None else si.n)

    def sees_light(self, path, si, scattered):
        return path.depth != 0


def sample_phase(
    mei: mi.MediumInteraction3f, sample_1: mi.Float, sample_2: mi.Point2f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
    """A direction from the phase function (in world space), value / density, and its density."""
    phase = mei.medium.phase_function()
    return phase.sample(_context(), mei, sample_1, sample_2, active)


def direction_at(point: mi.Point2f) -> mi.Vector3f:
    """The direction (in world space) at a point of the unit square, which is mapped to the sphere
    with equal areas."""
    return mi.warp.square_to_uniform_sphere(point)


def point_of(d: mi.Vector3f) -> mi.Point2f:
    """The inverse of :func:`direction_at`."""
    return mi.warp.uniform_sphere_to_square(d)


def eval_phase(
    mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Float]:
    """The value of the phase function for light from the direction ``d`` (in world space), and the
    density with which scattering finds this direction."""
    return mei.medium.phase_function().eval_pdf(_context(), mei, d, active)


def _passes(bs: mi.BSDFSample3f) -> mi.Bool:
    """Whether the sample passes through an index-matched surface."""
    return mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)


def _context() -> mi.PhaseFunctionContext:
    return mi.PhaseFunctionContext(None)


def vertex_at(
    si: mi.SurfaceInteraction3f, mei: mi.MediumInteraction3f, t: mi.Float, scatters: mi.Bool
) -> mi.SurfaceInteraction3f:
    """The interaction of a vertex in a medium, where there is one; elsewhere ``si``."""
    point = dr.zeros(mi.SurfaceInteraction3f)
    point.t, point.p, point.time, point.wavelengths = t, mei.p, mei.time, mei.wavelengths
    # Rays leave a point without a normal where it is
    point.sh_frame, point.wi = mei.sh_frame, mi.Vector3f(0, 0, 1)
    return dr.select(scatters, point, si)
