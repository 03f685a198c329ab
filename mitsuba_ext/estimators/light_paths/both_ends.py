"""Choices of lights that are the same whether a camera path or a light path reaches the vertex."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import EmitterSampling


def from_both_ends(si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """The interaction with ``wi`` replaced by a direction along the normal. For a two-sided BSDF
    that does not transmit, this direction is on the side of ``wi``, since camera paths and light
    paths reach the vertex from the same side. For others it is on the front side."""
    flags = si.bsdf().flags()
    transmits = mi.has_flag(flags, mi.BSDFFlags.Transmission)
    is_behind = (si.wi.z < 0) & mi.has_flag(flags, mi.BSDFFlags.BackSide) & ~transmits
    si = mi.SurfaceInteraction3f(si)
    si.wi = mi.Vector3f(0, 0, dr.select(is_behind, mi.Float(-1), 1))
    return si


class FromBothEnds(EmitterSampling):
    """Applies :func:`from_both_ends` to the vertices that a next event decision receives.

    A decision may distinguish the two sides of a surface. A camera path and a light path reach the
    vertex from different directions, and from different sides if the surface transmits. The MIS
    weights of all techniques add up to one only if both compute the same density.

    Parameters:
        decision: The decision that chooses the lights.
    """

    def __init__(self, decision: EmitterSampling) -> None:
        self._decision = decision
        self.choice_dimension = decision.choice_dimension

    def begin(self, sampler, ray, pixel=None) -> Any:
        return self._decision.begin(sampler, ray, pixel)

    def visit(self, state, scene, si, active) -> Any:
        return self._decision.visit(state, scene, from_both_ends(si), active)

    def sample(self, place, scene, numbers, si, active):
        return self._decision.sample(place, scene, numbers, si, active)

    def remember(self, place, scene, d, pdf, active):
        return self._decision.remember(place, scene, d, pdf, active)

    def density(self, state, scene, ref, si, ds, active):
        return self._decision.density(state, scene, ref, si, ds, active)

    def probability(self, state, scene, ref, emitter, active):
        return self._decision.probability(state, scene, ref, emitter, active)
