"""In-scattered light where a medium scatters nothing, for derivatives with respect to its albedo
and extinction.

Where σ_t = 0, no path scatters, but a little more extinction would scatter light there. The
derivative of the radiance along a ray has a term ∫ T(t) σ_s'(t) L_s(t) dt, where L_s is the
in-scattered radiance. Paths that scatter in proportion to σ_t never see L_s in empty regions, and
rarely in thin ones; paths that scatter in a black medium carry no light. So in media of varying
density, and in homogeneous media that do not scatter light of some colour, some of the paths take a
*detour*: instead of flying on, they scatter at a uniform point, with the transmittance up to there.
What such a path gathers behind that point is L_s. It is not part of the path's radiance.

Points at which a path scatters and points of detours are weighed with the balance heuristic. The
density of the former is σ_t, of the latter ``rate``, both relative to the probability of a flight
that far. Detours alone find the light of a colour that is not scattered.

Source: M. Nimier-David, T. Müller, A. Keller, W. Jakob, *Unbiased Inverse Volume Rendering with
Differential Trackers*, ACM Transactions on Graphics 41(4), 2022, section 4 (which samples points in
proportion to the transmittance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .free_flight import attenuation, interaction_at
from .media import vertex_at
from .transmittance import ratio_tracking, stretch
from .vertex import FlightEnd

#: Returns the first surface that a ray meets (``mi.PreliminaryIntersection3f``), given the ray and
#: where it is active.
Closest = Callable[[Any, Any], Any]

#: In homogeneous media, no detour is longer than this number of mean free paths.
_FARTHEST = 18.0


@dataclass
class Detour:
    """The state of a path.

    Attributes:
        flights: The number of flights that might have become detours.
        taken: Whether the path has taken its detour.
        L: The radiance that it had gathered before.
    """

    flights: mi.UInt32
    taken: mi.Bool
    L: mi.Spectrum


@dataclass
class DetourPoint:
    """Where a flight may scatter for derivatives only.

    Attributes:
        chosen: Whether it does.
        mei: The interaction there.
        t: Its distance.
        weight: The transmittance up to the point, divided by its density.
        kept: The weight of flights that take no detour.
        rate: See above; 0 where there are no detours.
    """

    chosen: mi.Bool
    mei: mi.MediumInteraction3f
    t: mi.Float
    weight: mi.Spectrum
    kept: mi.Float
    rate: mi.Float

    def end(self, start: FlightEnd, end: FlightEnd) -> FlightEnd:
        """The end of flights of which some are detours. ``end`` is their end without; ``start`` has
        the throughput before."""
        scatters = end.in_medium.scatters | self.chosen
        mei = dr.select(self.chosen, self.mei, end.in_medium.mei)
        return FlightEnd(
            si=vertex_at(end.si, self.mei, self.t, self.chosen),
            # Without the scattering coefficient
            β=dr.select(self.chosen, start.β * self.weight, end.β * self.kept),
            in_medium=replace(end.in_medium, scatters=scatters, mei=mei),
        )


def detour_point(
    closest: Closest,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    end: mi.Float,
    medium: mi.MediumPtr,
    channel: mi.UInt32,
    detour: Detour,
    active: mi.Bool,
) -> tuple[DetourPoint, Detour]:
    """Chooses the flights that become detours, and their points.

    Parameters:
        closest: Finds the surface behind the point where a homogeneous medium has ended a ray.
        ray, end: The ray, and the distance of the surface that it hits.
        medium, channel: The medium, and the colour that chooses distances.
        detour: The state before the flight.

    Returns:
        The point, and the new state, except for the radiance.
    """
    flies = active & (medium != None)  # noqa: E711
    is_homogeneous = medium.is_homogeneous()
    mei = interaction_at(ray, ray.o, medium)
    σ_s, _, σ = medium.get_scattering_coefficients(mei, flies & is_homogeneous)
    flies &= ~is_homogeneous | (dr.min(mi.Spectrum(σ_s)) == 0)
    ends_early = flies & is_homogeneous & ~dr.isfinite(end) & (dr.max(mi.Spectrum(σ)) > 0)
    whole = mi.Ray3f(ray)
    whole.maxt = dr.largest(mi.Float)
    end = dr.select(ends_early, closest(whole, ends_early).t, end)
    end = dr.minimum(end, _FARTHEST / dr.min(mi.Spectrum(σ)))
    start, length = stretch(medium, ray, end, flies)
    flies &= (length > 0) & ~detour.taken
    # After n flights, 3 / (n + 3) of the paths are left
    probability = dr.rcp(mi.Float(detour.flights + 4))
    chosen = flies & (sampler.next_1d(flies) < probability)
    t = start + sampler.next_1d(chosen) * length
    T = dr.select(is_homogeneous, attenuation(mi.Spectrum(σ), t), 1)
    T = ratio_tracking(ray, t, medium, channel, sampler, T, chosen & ~is_homogeneous)
    point = DetourPoint(
        chosen=chosen,
        mei=interaction_at(ray, ray(t), medium),
        t=t,
        weight=T * (length / probability),
        kept=dr.select(flies, dr.rcp(1 - probability), 1),
        rate=dr.select(flies, probability / ((1 - probability) * length), 0),
    )
    flights = detour.flights + dr.select(flies, mi.UInt32(1), 0)
    return point, Detour(flights, detour.taken | chosen, detour.L)
