"""Paths weighted by how many of the optimized things they meet."""

from __future__ import annotations

import mitsuba as mi

from ..scene.gradients import Optimized
from .path_decisions import Weights


class Sensitivity(Weights):
    """Multiplies the light of a path by the number of its vertices whose BSDF is optimized, plus
    one if the light is: about the derivative of the path's radiance with respect to the logarithm
    of all optimized parameters. A walk with these weights renders that derivative instead of the
    radiance, and what observes the walk learns from it.

    The derivative is exact for parameters to which the BSDF or the emission is proportional, such
    as colours.

    Parameters:
        weights: The MIS weights. They must need no sums.
        optimized: What is optimized.
    """

    def __init__(self, weights: Weights, optimized: Optimized) -> None:
        self._weights, self._optimized = weights, optimized

    def begin(self, ray):
        # The number of optimized BSDFs before the vertex
        return mi.Float(0)

    def emission(self, scene, si, ds, path, pdf):
        count = path.sums + self._optimized.emitter(ds.emitter)
        return count * self._weights.emission(scene, si, ds, path, pdf)

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        return self._weights.connection(scene, vertex, ds, pdf, scattering_pdf)

    def worth(self, vertex, ds):
        return self.leave(vertex, None) + self._optimized.emitter(ds.emitter)

    def leave(self, vertex, bs):
        return vertex.path.sums + self._optimized.bsdf(vertex.bsdf)
