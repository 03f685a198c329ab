"""The parts of a camera path that ends at photons (``photon_maps.py``): their MIS weights, and
where a path ends."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.heroes import Heroes
from ....transport.path_decisions import Roulette, Weights
from ....transport.vertex import Arrival, PathState, Vertex

#: The parts of a camera path, by what it has left behind: no diffuse vertex; the first one, just
#: now; the first one, and others that are not diffuse; two diffuse vertices.
BEFORE, GATHERS, GATHERS_ON, ENDED = range(4)


def is_diffuse(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Are photons stored on surfaces of this BSDF?"""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)


def first_vertex(scene: mi.Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> Vertex:
    """The vertex of a camera path of one segment."""
    arrival = Arrival(mi.Interaction3f(si), mi.Float(1), mi.Bool(True))
    path = PathState(
        mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0), arrival, Heroes(scene).begin(),
        mi.UInt32(BEFORE),
    )  # fmt: skip
    return Vertex(si, si.bsdf(ray), path)


class Phases(Weights):
    """The MIS weights of a camera path: those of ``path`` up to its first diffuse vertex, and for
    light that reaches this vertex directly. Photons have brought all other light. The sums of the
    path are the part that it is in (:data:`BEFORE`, …)."""

    def begin(self, ray):
        return mi.UInt32(BEFORE)

    def emission(self, scene, si, ds, path, pdf):
        return dr.select(path.sums <= GATHERS, super().emission(scene, si, ds, path, pdf), 0)

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.sums == BEFORE, weight, 0)

    def leave(self, vertex, bs):
        phase = vertex.path.sums
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        scatters = is_diffuse(vertex.bsdf) & ~is_delta
        after = dr.select(phase == BEFORE, mi.UInt32(GATHERS), ENDED)
        return dr.select(scatters, after, dr.select(phase == GATHERS, GATHERS_ON, phase))


class EndsWithTheGather(Roulette):
    """Ends a path at the diffuse vertex at which the last segment arrives. Before that, it decides
    as ``path`` does.

    Parameters:
        rr_depth: See :class:`~mitsuba_ext.transport.walk.Walk`, whose own is 0.
        last: The part of a path in which it ends.
    """

    def __init__(self, rr_depth: int, last: int) -> None:
        self._rr_depth, self._last = dr.opaque(mi.UInt32, rr_depth), last

    def survival(self, state, vertex, path, active):
        survival, state = super().survival(state, vertex, path, active)
        survival = dr.select(path.depth >= self._rr_depth, survival, 1)
        return dr.select(path.sums >= self._last, 0, survival), state
