"""Camera paths that end at cached irradiance.

Up to the first vertex at which a *diffuse lobe* is sampled, a camera path is the same as in
``path``. There, the cache gives the irradiance of indirect light. One more segment finds direct
light, as in ``path``, and the path ends where this segment ends. Where no record is valid, the path
goes on as in ``path``.

The lobe is the one that the BSDF says it has sampled. The other lobes go on as in ``path``: this is
the balance heuristic between lobes, so the part of the diffuse lobe has no highlight.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...transport.path_program import EndingProgram, PathProgram
from .record_grid import RecordGrid

#: The phases of a camera path. Before it asks the cache: only mirrors and clear glass have
#: scattered it; or glossy lobes have scattered it, too. Afterwards: it has just left the vertex at
#: which it asked the cache; or it is over.
SHARP, BLURRED, LEAVES, ENDED = range(4)


@dataclass
class Progress:
    """The history of a camera path.

    Attributes:
        phase: The phase of the path (:data:`SHARP`, …).
        length: The length of the path from the camera to the vertex.
    """

    phase: mi.UInt32
    length: mi.Float


class CachedPaths(EndingProgram):
    """Weighs light as ``path`` does up to the vertex that asks the cache, and light that reaches
    this vertex directly. All other light comes from the cache. Ends a path in the phase
    :data:`ENDED`; before that, it decides as ``path`` does.

    Parameters:
        max_depth: Longest path in segments.
    """

    def __init__(self, max_depth: int) -> None:
        self._max_depth = dr.opaque(mi.UInt32, max_depth)

    def begin(self, ray):
        return Progress(mi.UInt32(SHARP), dr.zeros(mi.Float, dr.width(ray)))

    def arrive(self, path, si, in_medium):
        before = path.history
        return Progress(before.phase, before.length + dr.select(si.is_valid(), si.t, 0))

    def leave(self, vertex, bs):
        history, is_delta = vertex.path.history, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        before = dr.select(is_delta, history.phase, BLURRED)
        phase = dr.select(history.phase <= BLURRED, before, ENDED)
        return Progress(phase, history.length)

    def emission(self, weights, scene, si, ds, path, pdf):
        weight = super().emission(weights, scene, si, ds, path, pdf)
        return dr.select(path.history.phase != ENDED, weight, 0)

    def connection(self, weights, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(weights, scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.history.phase <= BLURRED, weight, 0)

    def survival(self, roulette, state, vertex, path, late, active):
        phase = path.history.phase
        late = late & (phase != LEAVES)
        survival, state = super().survival(roulette, state, vertex, path, late, active)
        return dr.select(phase == ENDED, 0, survival), state

    def _asks(self, vertex, bs, active, last) -> mi.Bool:
        """Whether the path samples its first diffuse lobe at ``vertex``, in a phase up to ``last``:
        there, it asks the cache. Indirect light takes two more segments, at least."""
        is_diffuse = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Diffuse) & (bs.pdf > 0)
        is_first = vertex.path.history.phase <= last
        return active & is_diffuse & is_first & (vertex.depth + 3 <= self._max_depth)

    def _normal(self, vertex, bs) -> mi.Normal3f:
        """The shading normal, on the side from which the sampled lobe gets light."""
        return dr.mulsign(vertex.si.sh_frame.n, mi.Frame3f.cos_theta(bs.wo))


class CachedLight(CachedPaths):
    """Adds cached indirect light to camera paths.

    Parameters:
        grid: Finds and interpolates records.
        max_depth: Longest path in segments.
        finds_lights: Whether a scattered ray can hit a light. If not, the path ends at the cache.
    """

    def __init__(self, grid: RecordGrid, max_depth: int, finds_lights: bool) -> None:
        super().__init__(max_depth)
        self._grid, self._after = grid, LEAVES if finds_lights else ENDED

    def known(self, vertex, bs, β, history, active):
        asks = self._asks(vertex, bs, active, BLURRED)
        E, found = self._grid.interpolated(vertex.si.p, self._normal(vertex, bs), asks)
        phase = dr.select(found, self._after, history.phase)
        light = dr.select(found, β * E * dr.inv_pi, 0)
        return light, Progress(phase, history.length)


class FindsPlaces(CachedPaths):
    """Stores the places where camera paths ask the cache, and which of these no record covers.
    Places seen by way of glossy lobes are left out, because there are many, all over the scene.

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

    def known(self, vertex, bs, β, history, active):
        si, n = vertex.si, self._normal(vertex, bs)
        asks = self._asks(vertex, bs, active, SHARP)
        _, covered = self._grid.interpolated(si.p, n, asks)
        for target, value in (
            (self.p, si.p), (self.n, n), (self.geometric, si.n), (self.asks, mi.Bool(True)),
            (self.length, vertex.path.history.length), (self.covered, covered),
        ):  # fmt: skip
            dr.scatter(target, value, self._lane, asks)
        phase = dr.select(asks | (history.phase != SHARP), mi.UInt32(ENDED), SHARP)
        return None, Progress(phase, history.length)


class IndirectOnly(PathProgram):
    """Weighs light as ``path`` does, but excludes light that the first segment hits, which is
    direct light at the place where the path begins. Stores the length of the first segment.

    Parameters:
        lanes: Number of paths.
    """

    def __init__(self, lanes: int) -> None:
        self.distance = dr.full(mi.Float, dr.inf, lanes)
        self._lane = dr.arange(mi.UInt32, lanes)
        dr.eval(self.distance, self._lane)

    def arrive(self, path, si, in_medium):
        dr.scatter(self.distance, si.t, self._lane, (path.depth == 0) & si.is_valid())
        return super().arrive(path, si, in_medium)

    def emission(self, weights, scene, si, ds, path, pdf):
        weight = super().emission(weights, scene, si, ds, path, pdf)
        return dr.select(path.depth == 0, 0, weight)
