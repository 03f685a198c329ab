"""Leaves out direct light, where something else finds it."""

from __future__ import annotations

import drjit as dr

from .path_decisions import Weights


class WithoutDirect(Weights):
    """MIS weights that leave out paths of one and two segments: visible lights, and what they
    shine on without detours.

    Parameters:
        weights: Those of all other paths.
    """

    def __init__(self, weights: Weights) -> None:
        self._weights = weights

    def begin(self, ray):
        return self._weights.begin(ray)

    def arrive(self, path, si):
        return self._weights.arrive(path, si)

    def emission(self, scene, si, ds, path, pdf):
        return dr.select(
            path.depth > 1, self._weights.emission(scene, si, ds, path, pdf), 0
        )

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        weight = self._weights.connection(scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.depth > 0, weight, 0)

    def leave(self, vertex, bs):
        return self._weights.leave(vertex, bs)
