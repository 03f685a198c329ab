"""How far a path flies in a medium before it scatters."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..util.arrays import channel_mean
from .estimator import CameraRays


class Distances:
    """Draws the random numbers that choose the distances of flights in homogeneous media. The first
    flight uses the number of the camera ray, if it has one (its density is part of the ray's
    weight); all others use uniform numbers.

    Attributes:
        scatter: Whether paths scatter in homogeneous media. If not, they pass through, and their
            throughput is multiplied by the transmittance.
        exact_transmittance: Whether shadow rays use the closed-form transmittance of homogeneous
            media. ``volpath`` samples a distance in each, with more noise in the same time.
        waits: Whether some distances are chosen when the surface at the end of the flight is known
            (:meth:`is_late`, :meth:`warp`).
    """

    scatter = True
    exact_transmittance = True
    waits = False

    def begin(self, rays: CameraRays) -> Any:
        """The state before the first flight: whether the number of the ray has been used."""
        return None if rays.distance is None else mi.Bool(False)

    def draw(
        self, state: Any, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> tuple[mi.Float, Any]:
        """The number, in [0, 1), of the next flight where ``active``, and the new state."""
        if rays.distance is None:
            return sampler.next_1d(active), state
        u = dr.select(state, sampler.next_1d(active & state), rays.distance)
        return u, state | active

    def is_late(self, state: Any) -> mi.Bool:
        """Whether the distance of the flight whose number was drawn last is chosen when the surface
        at its end is known; called where :attr:`waits`."""
        raise NotImplementedError

    def warp(
        self,
        u: mi.Float,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        σ: mi.Float,
        σ_s: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Bool, mi.Float]:
        """Warps the number of a flight towards the surface ``si``; called where :attr:`waits`.

        Parameters:
            σ, σ_s: The extinction with which the distance is sampled, and the scattering
                coefficient.

        Returns:
            The distance at which the path scatters; whether it does so before the surface; and
            1 / density of the warped number.
        """
        raise NotImplementedError


def component(σ: mi.Spectrum, channel: mi.UInt32) -> mi.Float:
    """The colour ``channel`` of an extinction. In spectral and monochromatic variants, it is always
    the first: the hero wavelength is distributed as each of the others."""
    chosen = σ[0]
    if mi.is_rgb:
        for index in range(1, len(σ)):
            chosen = dr.select(channel == index, σ[index], chosen)
    return chosen


def interaction_at(ray: mi.Ray3f, p: mi.Point3f, medium: mi.MediumPtr) -> mi.MediumInteraction3f:
    """The interaction of a ray with a medium at ``p``, without its coefficients."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi, mei.time, mei.wavelengths = p, -ray.d, ray.time, ray.wavelengths
    mei.sh_frame, mei.medium = mi.Frame3f(mei.wi), medium
    return mei


def extinction(medium: mi.MediumPtr, ray: mi.Ray3f, active: mi.Bool) -> mi.Spectrum:
    """The majorant of the extinction, with which distances are sampled (in homogeneous media, the
    extinction itself); 0 where not ``active``."""
    σ = medium.get_majorant(interaction_at(ray, mi.Point3f(0), medium), active)
    return dr.select(active, mi.Spectrum(σ), 0)


def attenuation(σ: mi.Spectrum, t: mi.Float) -> mi.Spectrum:
    """exp(−σ t), also where t is infinite and σ zero."""
    return mi.Spectrum(dr.select(σ == 0, 1, dr.exp(-t * σ)))


def shared_mean(value: mi.UnpolarizedSpectrum, shares: mi.UnpolarizedSpectrum | None) -> mi.Float:
    """The mean of ``value`` over colours that have the probabilities ``shares``; ``None`` if these
    are equal."""
    return channel_mean(value) if shares is None else dr.dot(value, shares)


@dr.syntax
def track(
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    end: mi.Float,
    medium: mi.MediumPtr,
    channel: mi.UInt32,
    shares: mi.UnpolarizedSpectrum | None,
    t: mi.Float,
    β: mi.Spectrum,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Spectrum, mi.Bool]:
    """Delta tracking: samples collisions with the majorant, some of which are null collisions.

    Parameters:
        ray, end: The ray, and the distance of the surface that it hits.
        medium, channel: The medium, and the colour whose extinction chooses distances.
        shares: The probability with which each colour chooses whether a collision is real, in
            scenes with chromatic media; ``None`` in others, where all are equal.
        t, β: Returned where not ``active``; ``β`` is the throughput at the origin of the ray.
        active: Whether the ray begins in a medium of varying density.

    Returns:
        The distance of the first real collision; the throughput up to the collision (scattering
        coefficient included) or to the surface; and whether there is a collision.
    """
    ray = mi.Ray3f(ray)
    start, t, β = mi.Point3f(ray.o), mi.Float(t), mi.Spectrum(β)
    collides = mi.Bool(False)
    active = mi.Bool(active)
    end = mi.Float(end)
    while dr.hint(active, label="flight"):
        mei = medium.sample_interaction(ray, sampler.next_1d(active), channel, active)
        is_inside = active & mei.is_valid() & ~(end < mei.t)
        # Transmittance of each colour, relative to the colour that chose the distance
        σ = mei.combined_extinction
        chosen = component(σ, channel)
        flown = dr.minimum(dr.select(is_inside, mei.t, dr.inf), end) - mei.mint
        weight = attenuation(σ - chosen, flown) * dr.select(is_inside, dr.rcp(chosen), 1)
        # Whether the collision is real
        passing = shared_mean(dr.select(σ > 0, mei.sigma_n / σ, 0), shares)
        is_null = is_inside & (sampler.next_1d(is_inside) < passing)
        is_real = is_inside & ~is_null
        weight *= dr.select(is_null, mei.sigma_n / passing, 1)
        real = shared_mean(dr.select(σ > 0, mei.sigma_t / σ, 0), shares)
        weight *= dr.select(is_real, mei.sigma_s / real, 1)
        if dr.hint(shares is not None, mode="scalar"):
            # In proportion to the throughput
            carried = shares * dr.select(is_null, weight, 1)
            shares = carried * dr.rcp(dr.sum(carried))
        β = dr.select(active, β * mi.Spectrum(weight), β)
        t = dr.select(is_real, dr.norm(mei.p - start), t)
        collides |= is_real
        sampler.next_1d(is_null)  # `volpath` plays roulette at each collision
        ray.o = dr.select(is_null, mei.p, ray.o)
        end = dr.select(is_null, end - mei.t, end)
        active &= is_null
    return t, β, collides
