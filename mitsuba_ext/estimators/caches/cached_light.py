"""Camera paths that end at cached irradiance.

Up to the first vertex at which a *diffuse lobe* is sampled, a camera path is one of ``path``.
There, the cache tells the irradiance of indirect light. One more segment finds direct light, as in
``path``; whatever it hits, the path ends there. Where no record is valid, the path goes on as one
of ``path``.

The lobe is the one that the BSDF says it has sampled. The other lobes go on as in ``path``: this is
the balance heuristic between lobes, so that what the diffuse one is left with has no highlight.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import Roulette, Subpaths, Weights
from .record_grid import RecordGrid

#: The parts of a camera path that has not met the cache: it has been scattered by mirrors and clear
#: glass at most; by glossy lobes too. Then, it has left the vertex at which it met the cache; or it
#: is over.
SHARP, BLURRED, LEAVES, ENDED = range(4)


@dataclass
class Progress:
    """The state of a camera path, in the place of its MIS sums.

    Attributes:
        phase: Which part of the path this is (:data:`SHARP`, …).
        length: The way from the camera to the vertex.
    """

    phase: mi.UInt32
    length: mi.Float


class CameraPhases(Weights):
    """The MIS weights of ``path`` up to the vertex that asks the cache, and for light that reaches
    this vertex directly. The cache knows all other light."""

    def begin(self, ray):
        return Progress(mi.UInt32(SHARP), dr.zeros(mi.Float, dr.width(ray)))

    def arrive(self, path, si):
        sums = path.sums
        return Progress(sums.phase, sums.length + dr.select(si.is_valid(), si.t, 0))

    def emission(self, scene, si, ds, path, pdf):
        return dr.select(path.sums.phase != ENDED, super().emission(scene, si, ds, path, pdf), 0)

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.sums.phase <= BLURRED, weight, 0)

    def leave(self, vertex, bs):
        sums, is_delta = vertex.path.sums, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        before = dr.select(is_delta, sums.phase, BLURRED)
        return Progress(dr.select(sums.phase <= BLURRED, before, ENDED), sums.length)


class EndsAtTheCache(Roulette):
    """Ends a path that is over. Before that, it decides as ``path`` does.

    Parameters:
        rr_depth: See :class:`~mitsuba_ext.transport.walk.Walk`, whose own is 0.
    """

    def __init__(self, rr_depth: int) -> None:
        self._rr_depth = dr.opaque(mi.UInt32, rr_depth)

    def survival(self, state, vertex, path, active):
        survival, state = super().survival(state, vertex, path, active)
        is_early = (path.depth < self._rr_depth) | (path.sums.phase == LEAVES)
        survival = dr.select(is_early, 1, survival)
        return dr.select(path.sums.phase == ENDED, 0, survival), state


class _AtDiffuseLobes(Subpaths):
    """Acts where a camera path samples its first diffuse lobe.

    Parameters:
        max_depth: Longest path in segments.
    """

    def __init__(self, max_depth: int) -> None:
        self._max_depth = dr.opaque(mi.UInt32, max_depth)

    def gather(self, scene, sampler, vertex, active):
        return mi.Spectrum(0), mi.UInt32(0)

    def _asks(self, vertex, bs, active, last) -> mi.Bool:
        """Is this such a place, in a part of the path up to ``last``? Indirect light takes two more
        segments, at least."""
        is_diffuse = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Diffuse) & (bs.pdf > 0)
        is_first = vertex.path.sums.phase <= last
        return active & is_diffuse & is_first & (vertex.depth + 3 <= self._max_depth)

    def _normal(self, vertex, bs) -> mi.Normal3f:
        """The shading normal, on the side from which the sampled lobe gets light."""
        return dr.mulsign(vertex.si.sh_frame.n, mi.Frame3f.cos_theta(bs.wo))


class CachedLight(_AtDiffuseLobes):
    """Adds cached indirect light to camera paths.

    Parameters:
        grid: Finds and interpolates records.
        max_depth: Longest path in segments.
        finds_lights: Can a scattered ray hit a light? If not, the path is over at the cache.
    """

    def __init__(self, grid: RecordGrid, max_depth: int, finds_lights: bool) -> None:
        super().__init__(max_depth)
        self._grid, self._after = grid, LEAVES if finds_lights else ENDED

    def beyond(self, vertex, bs, β, sums, active):
        asks = self._asks(vertex, bs, active, BLURRED)
        E, found = self._grid.interpolated(vertex.si.p, self._normal(vertex, bs), asks)
        phase = dr.select(found, self._after, sums.phase)
        light = dr.select(found, β * E * dr.inv_pi, 0)
        return light, Progress(phase, sums.length)


class FindsPlaces(_AtDiffuseLobes):
    """Stores where camera paths ask the cache, and which of these places no record covers. What is
    seen by way of glossy lobes is left out: such places are many, and all over the scene.

    Parameters:
        grid: Finds records.
        max_depth: Longest path in segments.
        lanes: Number of paths.
    """

    def __init__(self, grid: RecordGrid, max_depth: int, lanes: int) -> None:
        super().__init__(max_depth)
        self._grid, self._lane = grid, dr.arange(mi.UInt32, lanes)
        self.p, self.n = dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Normal3f, lanes)
        self.geometric = dr.zeros(mi.Normal3f, lanes)
        self.length = dr.zeros(mi.Float, lanes)
        self.asks, self.covered = dr.zeros(mi.Bool, lanes), dr.zeros(mi.Bool, lanes)
        dr.eval(self._lane, self.p, self.n, self.geometric, self.length)
        dr.eval(self.asks, self.covered)

    def beyond(self, vertex, bs, β, sums, active):
        si, n = vertex.si, self._normal(vertex, bs)
        asks = self._asks(vertex, bs, active, SHARP)
        _, covered = self._grid.interpolated(si.p, n, asks)
        for target, value in (
            (self.p, si.p), (self.n, n), (self.geometric, si.n), (self.asks, mi.Bool(True)),
            (self.length, vertex.path.sums.length), (self.covered, covered),
        ):  # fmt: skip
            dr.scatter(target, value, self._lane, asks)
        phase = dr.select(asks | (sums.phase != SHARP), mi.UInt32(ENDED), SHARP)
        return 0.0, Progress(phase, sums.length)


class IndirectOnly(Weights):
    """The weights of ``path``, but for light that the first segment hits: that is direct light of
    the place where the path begins. Stores how long the first segment is.

    Parameters:
        lanes: Number of paths.
    """

    def __init__(self, lanes: int) -> None:
        super().__init__()
        self.distance = dr.full(mi.Float, dr.inf, lanes)
        self._lane = dr.arange(mi.UInt32, lanes)
        dr.eval(self.distance, self._lane)

    def arrive(self, path, si):
        dr.scatter(self.distance, si.t, self._lane, (path.depth == 0) & si.is_valid())
        return path.sums

    def emission(self, scene, si, ds, path, pdf):
        return dr.select(path.depth == 0, 0, super().emission(scene, si, ds, path, pdf))


