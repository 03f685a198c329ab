"""MIS weights that leave out paths of some lengths, which another technique finds."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .path_decisions import Weights


class WithoutLengths(Weights):
    """MIS weights that leave out paths of ``first`` to ``last`` segments. Visible lights have one,
    direct light has two.

    Parameters:
        weights: The MIS weights of all other paths.
    """

    def __init__(self, weights: Weights, first: int, last: int) -> None:
        self._weights, self._first, self._last = weights, first, last

    def begin(self, ray):
        return self._weights.begin(ray)

    def arrive(self, path, si):
        return self._weights.arrive(path, si)

    def emission(self, scene, si, ds, path, pdf):
        weight = self._weights.emission(scene, si, ds, path, pdf)
        return self._kept(weight, path.depth + 1)

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        weight = self._weights.connection(scene, vertex, ds, pdf, scattering_pdf)
        return self._kept(weight, vertex.path.depth + 2)

    def leave(self, vertex, bs):
        return self._weights.leave(vertex, bs)

    def _kept(self, weight: mi.Float, length: mi.UInt32) -> mi.Float:
        is_left_out = (length >= self._first) & (length <= self._last)
        return dr.select(is_left_out, 0, weight)
