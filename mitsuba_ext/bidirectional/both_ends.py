"""Choices of lights that do not depend on the end from which a path is looked at."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.path_decisions import EmitterSampling


def from_both_ends(si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """A vertex as if it were seen at right angles to the surface: from the side from which a BSDF
    that does not transmit is seen by camera and light alike, and from the front of others."""
    flags = si.bsdf().flags()
    transmits = mi.has_flag(flags, mi.BSDFFlags.Transmission)
    is_behind = (si.wi.z < 0) & mi.has_flag(flags, mi.BSDFFlags.BackSide) & ~transmits
    si = mi.SurfaceInteraction3f(si)
    si.wi = mi.Vector3f(0, 0, dr.select(is_behind, mi.Float(-1), 1))
    return si


class FromBothEnds(EmitterSampling):
    """Asks a next event decision about vertices as :func:`from_both_ends` shows them.

    A decision may distinguish the two sides of a surface. A camera path and a light path reach the
    vertex from different directions, behind transmission from different sides. Only if both are
    told the same density, the weights of all techniques add up to one.

    Parameters:
        decision: What chooses the lights.
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
