"""Camera paths that end at cached irradiance.

Up to the first vertex at which a *diffuse lobe* is sampled, a camera path is one of ``path``. There,
the cache tells the irradiance of indirect light. One more segment finds direct light, as in
``path``; whatever it hits, the path ends there. Where no record is valid, the path goes on as one
of ``path``.

The lobe is the one that the BSDF says it has sampled. The other lobes go on as in ``path``: this is
the balance heuristic between lobes, so that what the diffuse one is left with has no highlight.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.path_decisions import Roulette, Subpaths, Weights
from .record_grid import RecordGrid

#: The parts of a camera path: it has not met the cache; it has left the vertex at which it did; it
#: is over.
BEFORE, LEAVES, ENDED = range(3)

#: The angle by which a cone of rays widens at a glossy lobe: what is seen there is blurred.
_GLOSSY_SPREAD = 0.1


@dataclass
class Progress:
    """The state of a camera path, in the place of its MIS sums.

    Attributes:
        phase: Which part of the path this is (:data:`BEFORE`, …).
        footprint: Width, at the vertex, of the cone of rays of one pixel.
        spread: The angle by which it widens.
    """

    phase: mi.UInt32
    footprint: mi.Float
    spread: mi.Float


class CameraPhases(Weights):
    """The MIS weights of ``path`` up to the vertex that asks the cache, and for light that reaches
    this vertex directly. The cache knows all other light.

    Parameters:
        footprint, spread: Of the cone of a pixel where it leaves the camera.
    """

    def __init__(self, footprint: float = 0.0, spread: float = 0.0) -> None:
        super().__init__()
        self._footprint = dr.opaque(mi.Float, footprint)
        self._spread = dr.opaque(mi.Float, spread)

    def begin(self, ray):
        lanes = dr.zeros(mi.Float, dr.width(ray))
        return Progress(mi.UInt32(BEFORE), lanes + self._footprint, lanes + self._spread)

    def arrive(self, path, si):
        sums = path.sums
        widened = sums.footprint + dr.select(si.is_valid(), sums.spread * si.t, 0)
        return Progress(sums.phase, widened, sums.spread)

    def emission(self, scene, si, ds, path, pdf):
        return dr.select(path.sums.phase != ENDED, super().emission(scene, si, ds, path, pdf), 0)

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.sums.phase == BEFORE, weight, 0)

    def leave(self, vertex, bs):
        sums = vertex.path.sums
        phase = dr.select(sums.phase == BEFORE, mi.UInt32(BEFORE), ENDED)
        is_glossy = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        spread = dr.select(is_glossy, dr.maximum(sums.spread, _GLOSSY_SPREAD), sums.spread)
        return Progress(phase, sums.footprint, spread)


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

    def _asks(self, vertex, bs, active) -> mi.Bool:
        """Does indirect light count there? It takes two more segments, at least."""
        is_diffuse = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Diffuse) & (bs.pdf > 0)
        is_first = vertex.path.sums.phase == BEFORE
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
        asks = self._asks(vertex, bs, active)
        E, found = self._grid.interpolated(vertex.si.p, self._normal(vertex, bs), asks)
        phase = dr.select(found, self._after, sums.phase)
        light = dr.select(found, β * E * dr.inv_pi, 0)
        return light, Progress(phase, sums.footprint, sums.spread)


class FindsPlaces(_AtDiffuseLobes):
    """Stores where camera paths ask the cache, and which of these places no record covers.

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
        self.footprint = dr.zeros(mi.Float, lanes)
        self.asks, self.covered = dr.zeros(mi.Bool, lanes), dr.zeros(mi.Bool, lanes)
        dr.eval(self._lane, self.p, self.n, self.geometric, self.footprint)
        dr.eval(self.asks, self.covered)

    def beyond(self, vertex, bs, β, sums, active):
        si, n = vertex.si, self._normal(vertex, bs)
        asks = self._asks(vertex, bs, active)
        _, covered = self._grid.interpolated(si.p, n, asks)
        for target, value in (
            (self.p, si.p), (self.n, n), (self.geometric, si.n), (self.asks, mi.Bool(True)),
            (self.footprint, vertex.path.sums.footprint), (self.covered, covered),
        ):  # fmt: skip
            dr.scatter(target, value, self._lane, asks)
        phase = dr.select(asks, ENDED, sums.phase)
        return 0.0, Progress(phase, sums.footprint, sums.spread)


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


