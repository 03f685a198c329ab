"""Paths weighted by the number of optimized BSDFs, media and lights that they meet."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.gradients import Optimized
from .path_program import PathProgram


class Sensitivity(PathProgram):
    """Multiplies the light of a path by the number of its vertices whose BSDF or medium is
    optimized, plus one if the light is: about the derivative of the path's radiance with respect to
    the logarithm of all optimized parameters. A walk with this program renders that derivative
    instead of the radiance, and what observes the walk learns from it.

    The derivative is exact for parameters to which the BSDF or the emission is proportional, such
    as colours. The history is the number of optimized BSDFs and media before the vertex.

    Parameters:
        optimized: The BSDFs, media and lights that are optimized.
    """

    def __init__(self, optimized: Optimized) -> None:
        self._optimized = optimized

    def begin(self, ray):
        return mi.Float(0)

    def leave(self, vertex, bs):
        return self._count(vertex)

    def emission(self, weights, scene, si, ds, path, pdf):
        count = path.history + self._optimized.emitter(ds.emitter)
        return count * super().emission(weights, scene, si, ds, path, pdf)

    def worth(self, vertex, ds):
        return self._count(vertex) + self._optimized.emitter(ds.emitter)

    def _count(self, vertex) -> mi.Float:
        """The number of optimized BSDFs and media up to ``vertex``."""
        here, in_medium = self._optimized.bsdf(vertex.bsdf), vertex.medium
        if in_medium is not None:
            of_medium = self._optimized.medium(in_medium.mei.medium)
            here = dr.select(in_medium.scatters, of_medium, here)
        return vertex.path.history + here
