"""Transmittance of media and index-matched surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..util.arrays import channel_mean
from .free_flight import attenuation, component, extinction, interaction_at
from .path_decisions import SceneQuery


@dataclass
class Way:
    """The way of light through media, for derivatives of its attenuation.

    Attributes:
        mei: The interaction with a medium at a random point of the way, uniform by length.
        length: The length of the way, vacuum not included.
    """

    mei: mi.MediumInteraction3f
    length: mi.Float

    def extended(
        self, u: mi.Float, ray: mi.Ray3f, end: mi.Float, medium: mi.MediumPtr, active: mi.Bool
    ) -> Way:
        """The way that goes on, where ``active``, along ``ray`` to ``end`` through ``medium``. The
        random number ``u`` decides whether its point lies there, and where."""
        start, added = stretch(medium, ray, end, active)
        length = self.length + added
        mei = interaction_at(ray, ray(start + u * length), medium)
        return Way(dr.select(u * length < added, mei, self.mei), length)


def stretch(
    medium: mi.MediumPtr, ray: mi.Ray3f, end: mi.Float, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """Where ``ray`` enters the bounding box of ``medium``, and how far it then flies inside up to
    the distance ``end``; 0 where not ``active``, or where nothing attenuates light up to an
    infinite ``end``. Outside of its box, a grid has no extinction."""
    meets, near, far = medium.intersect_aabb(ray)
    start = dr.maximum(near, 0)
    length = dr.minimum(far, end) - start
    is_inside = active & meets & (length > 0) & dr.isfinite(length)
    return dr.select(is_inside, start, 0), dr.select(is_inside, length, 0)


def for_weights(transmittance: mi.Float) -> mi.Float:
    """A known transmittance as MIS weights contain it: never so small that its square is zero."""
    return dr.maximum(transmittance, 1e-12)


@dr.syntax
def transmittance(
    query: SceneQuery,
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    ds: mi.DirectionSample3f,
    medium: mi.MediumPtr,
    channel: mi.UInt32,
    has_grids: bool,
    exact: bool,
    finds_way: bool,
    sampler: mi.Sampler,
    active: mi.Bool,
    passes_emitters: bool = False,
    reach: mi.Float | None = None,
) -> tuple[mi.Spectrum, mi.Float, Way | None]:
    """An unbiased estimate of the transmittance between a vertex and a point on a light. In
    homogeneous media, it is computed, or estimated with a random distance; in others, it is
    estimated by ratio tracking (Novák et al., section 4.2). It is 0 where a surface that is not
    index-matched lies in between.

    The second result is the transmittance of the homogeneous media alone, as the product of the
    means over the colours in each of them. It does not depend on random numbers, so MIS weights can
    contain it (:attr:`.MediumVertex.attenuation` is the same along a path).

    Parameters:
        query: How rays intersect the scene.
        si, ds: The vertex, and the direction of the light.
        medium, channel: The medium in front of the vertex, and the colour that chooses distances.
        has_grids: Whether there may be media that are not homogeneous.
        exact: Whether the transmittance of homogeneous media is computed without random distances.
        finds_way: Whether the :class:`Way` of the light is returned as well.
        passes_emitters: Whether area lights let light pass, because they are hidden.
        reach: The length of the ray from ``ds.p`` with which a path begins there; ``None`` if there
            is no limit. Behind an index-matched surface, the path goes on without a limit.
    """
    medium = dr.select(si.is_medium_transition(), si.target_medium(ds.d), medium)
    ray = query.shadow_ray(scene, si, ds)
    # Media attenuate light from infinity up to Mitsuba's ds.p; surfaces block it at any distance
    left = query.starts.towards(si, ds.p, ds.n).maxt
    T, known = mi.Spectrum(1), mi.Float(1)
    way = Way(dr.zeros(mi.MediumInteraction3f), mi.Float(0)) if finds_way else None
    first = left  # The length of the first segment from ds.p
    active = mi.Bool(active)
    while dr.hint(active, label="transmittance"):
        in_medium = active & (medium != None)  # noqa: E711
        is_homogeneous = in_medium & medium.is_homogeneous()
        σ = extinction(medium, ray, is_homogeneous)
        t, rate = _flight(σ, channel, exact, sampler, is_homogeneous)
        collides = is_homogeneous & (t <= left)
        segment = mi.Ray3f(ray)
        segment.maxt = dr.select(collides, dr.minimum(t, ray.maxt), ray.maxt)
        pi = query.closest(scene, segment, coherent=False, active=active)
        is_met = active & pi.is_valid()
        end = dr.minimum(dr.select(is_met, pi.t, dr.inf), left)
        # ----- Attenuation up to the next surface, or to the light -----
        T = dr.select(collides & ~is_met, 0, T)
        T = dr.select(is_homogeneous, T * attenuation(rate, end), T)
        known = dr.select(is_homogeneous, known * channel_mean(attenuation(σ, end)), known)
        if dr.hint(has_grids, mode="scalar"):
            T = ratio_tracking(ray, end, medium, channel, sampler, T, in_medium & ~is_homogeneous)
        if dr.hint(finds_way, mode="scalar"):
            way = way.extended(sampler.next_1d(in_medium), ray, end, medium, in_medium)
        # ----- Does the surface let it pass? -----
        met = query.interaction(pi, segment)
        is_met &= dr.max(T) > 0
        passing = mi.Spectrum(met.bsdf(segment).eval_null_transmission(met, is_met))
        is_hidden = mi.Bool(False)
        if dr.hint(passes_emitters, mode="scalar"):
            is_hidden = met.shape.emitter() != None  # noqa: E711
            passing = dr.select(is_hidden, 1, passing)
        T = dr.select(is_met, T * passing, T)
        is_met &= dr.max(T) > 0
        crosses = is_met & met.is_medium_transition() & ~is_hidden
        medium = dr.select(crosses, met.target_medium(ray.d), medium)
        onward = query.starts.along(met, ray.d)
        onward.maxt = ray.maxt - met.t
        ray = dr.select(is_met, onward, ray)
        left = dr.select(is_met, left - met.t, left)
        if dr.hint(reach is not None, mode="scalar"):
            first = dr.select(is_met & ~is_hidden, left, first)
        active &= is_met & (ray.maxt > 0)
    if dr.hint(reach is not None, mode="scalar"):
        T = dr.select(first < reach, T, 0)
    return T, known, way


def _flight(
    σ: mi.Spectrum, channel: mi.UInt32, exact: bool, sampler: mi.Sampler, active: mi.Bool
) -> tuple[mi.Float, mi.Spectrum]:
    """The distance at which light is absorbed, and the rate of its attenuation up to there."""
    if exact:
        return mi.Float(dr.inf), σ
    chosen = component(σ, channel)
    # The probability of getting that far is the transmittance of the chosen colour
    return -dr.log(1 - sampler.next_1d(active)) / chosen, σ - chosen


@dr.syntax
def ratio_tracking(
    ray: mi.Ray3f,
    end: mi.Float,
    medium: mi.MediumPtr,
    channel: mi.UInt32,
    sampler: mi.Sampler,
    T: mi.Spectrum,
    active: mi.Bool,
) -> mi.Spectrum:
    """``T`` times an estimate of the transmittance of a medium of varying density up to the
    distance ``end``: the product of the shares of null collisions."""
    ray = mi.Ray3f(ray)
    ray.maxt = end
    T = mi.Spectrum(T)
    active = mi.Bool(active)
    while dr.hint(active, label="ratio tracking"):
        mei = medium.sample_interaction(ray, sampler.next_1d(active), channel, active)
        is_inside = active & mei.is_valid()
        σ = mei.combined_extinction
        chosen = component(σ, channel)
        flown = dr.minimum(mei.t, ray.maxt) - mei.mint
        share = attenuation(σ - chosen, flown) * dr.select(is_inside, mei.sigma_n / chosen, 1)
        T = dr.select(active, T * mi.Spectrum(share), T)
        ray.o = dr.select(is_inside, mei.p, ray.o)
        ray.maxt = dr.select(is_inside, ray.maxt - mei.t, ray.maxt)
        active &= is_inside & (dr.max(T) > 0)
    return T
