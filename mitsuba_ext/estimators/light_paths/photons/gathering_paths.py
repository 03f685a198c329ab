"""Camera paths that end at photons (``photon_maps.py``)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.heroes import Heroes
from ....transport.path_program import EndingProgram, Subpaths
from ....transport.vertex import Arrival, PathState, Vertex

#: The phases of a camera path, by the vertices that it has left: no diffuse vertex; the first
#: diffuse vertex, just now; the first one, and then others that are not diffuse; two diffuse ones.
BEFORE, GATHERS, GATHERS_ON, ENDED = range(4)


def is_diffuse(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Whether photons are stored on surfaces with this BSDF."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)


def first_vertex(scene: mi.Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> Vertex:
    """The vertex of a camera path of one segment."""
    arrival = Arrival(mi.Interaction3f(si), mi.Float(1), mi.Bool(True))
    path = PathState(
        mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0), arrival, Heroes(scene).begin(),
        mi.UInt32(BEFORE),
    )  # fmt: skip
    return Vertex(si, si.bsdf(ray), path)


class GatheringPaths(EndingProgram):
    """Weighs light as ``path`` does up to the first diffuse vertex, and light that reaches this
    vertex directly. Photons have brought all other light. Ends a path at the diffuse vertex at
    which the last segment arrives; before that, it decides as ``path`` does.

    The history is the phase of the path (:data:`BEFORE`, …).

    Parameters:
        subpaths: The photons.
        last: The phase in which a path ends.
    """

    def __init__(self, subpaths: Subpaths, last: int) -> None:
        self.subpaths, self._last = subpaths, last

    def begin(self, ray):
        return mi.UInt32(BEFORE)

    def leave(self, vertex, bs):
        phase = vertex.path.history
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        scatters = is_diffuse(vertex.bsdf) & ~is_delta
        after = dr.select(phase == BEFORE, mi.UInt32(GATHERS), ENDED)
        return dr.select(scatters, after, dr.select(phase == GATHERS, GATHERS_ON, phase))

    def emission(self, weights, scene, si, ds, path, pdf):
        weight = super().emission(weights, scene, si, ds, path, pdf)
        return dr.select(path.history <= GATHERS, weight, 0)

    def connection(self, weights, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(weights, scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.history == BEFORE, weight, 0)

    def survival(self, roulette, state, vertex, path, late, active):
        survival, state = super().survival(roulette, state, vertex, path, late, active)
        return dr.select(path.history >= self._last, 0, survival), state
