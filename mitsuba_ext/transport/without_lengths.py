"""Paths of some lengths left out, which another technique finds."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .path_program import PathProgram


class WithoutLengths(PathProgram):
    """Leaves out the light of paths of ``first`` to ``last`` segments: it weighs 0. Visible lights
    have one, direct light has two.

    Parameters:
        program: Decides everything else.
    """

    def __init__(self, program: PathProgram, first: int, last: int) -> None:
        self._program, self._first, self._last = program, first, last
        self.subpaths, self.ends_early = program.subpaths, program.ends_early

    def begin(self, ray):
        return self._program.begin(ray)

    def arrive(self, path, si, in_medium):
        return self._program.arrive(path, si, in_medium)

    def leave(self, vertex, bs):
        return self._program.leave(vertex, bs)

    def known(self, vertex, bs, β, history, active):
        return self._program.known(vertex, bs, β, history, active)

    def emission(self, weights, scene, si, ds, path, pdf):
        weight = self._program.emission(weights, scene, si, ds, path, pdf)
        return self._kept(weight, path.depth + 1)

    def connection(self, weights, scene, vertex, ds, pdf, scattering_pdf):
        weight = self._program.connection(weights, scene, vertex, ds, pdf, scattering_pdf)
        return self._kept(weight, vertex.path.depth + 2)

    def worth(self, vertex, ds):
        return self._program.worth(vertex, ds)

    def survival(self, roulette, state, vertex, path, late, active):
        return self._program.survival(roulette, state, vertex, path, late, active)

    def _kept(self, weight: mi.Float, length: mi.UInt32) -> mi.Float:
        is_left_out = (length >= self._first) & (length <= self._last)
        return dr.select(is_left_out, 0, weight)
