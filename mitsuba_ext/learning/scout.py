"""Finding out where in a scene the paths of a sensor scatter, before anything is learned there."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..decisions.defaults import EmitterSampling
from .learner import Observer

#: Paths, about, and vertices of each.
_PATHS, _VERTICES = 1 << 16, 3

#: Longest path of a scout in segments.
SCOUT_DEPTH = _VERTICES + 1

#: Share of the vertices that may lie outside of the region, on either side of each axis.
_OUTSIDE = 2e-3

#: What is added to the region on each side.
_MARGIN = 0.02


class NoConnections(EmitterSampling):
    """Connects to no light: what is left are the directions of the BSDFs."""

    def sample(self, state, scene, sampler, si, active):
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0), state


class Scout(Observer):
    """Records where paths scatter, for about 65,000 of the paths of one pass."""

    def begin(self, lanes: int, pixel: mi.UInt32 | None = None) -> None:
        stride = max(1, lanes // _PATHS)
        paths = -(-lanes // stride)
        self._lane = dr.arange(mi.UInt32, lanes)
        self._path = self._lane // stride
        self._is_recorded = self._lane == self._path * stride
        self._p = dr.zeros(mi.Point3f, paths * _VERTICES)
        self._n = dr.zeros(mi.Normal3f, paths * _VERTICES)
        self._seen = dr.zeros(mi.UInt32, paths * _VERTICES)
        dr.eval(self._path, self._is_recorded, self._p, self._n, self._seen)

    def vertex(self, si: mi.SurfaceInteraction3f, depth: mi.UInt32, active: mi.Bool) -> None:
        slot = self._path * _VERTICES + depth
        active = active & self._is_recorded & (depth < _VERTICES)
        dr.scatter(self._p, si.p, slot, active)
        dr.scatter(self._n, lit_normal(si), slot, active)
        dr.scatter(self._seen, mi.UInt32(1), slot, active)

    def vertices(self) -> tuple[mi.Point3f, mi.Normal3f]:
        """The places, and the geometric normals on the side from which they were seen."""
        slots = dr.compress(self._seen > 0)
        if len(slots) == 0:
            return mi.Point3f(), mi.Normal3f()
        p, n = dr.gather(mi.Point3f, self._p, slots), dr.gather(mi.Normal3f, self._n, slots)
        finite = dr.compress(dr.all(dr.isfinite(p) & dr.isfinite(n)))
        return dr.gather(mi.Point3f, p, finite), dr.gather(mi.Normal3f, n, finite)


def region(p: mi.Point3f) -> mi.ScalarBoundingBox3f:
    """A box that holds nearly all of the points: a few that got far must not make it coarse."""
    points = p.numpy()
    low, high = np.quantile(points, [_OUTSIDE, 1 - _OUTSIDE], axis=1)
    # A flat region still has some depth, and distant coordinates are rounded
    size = max((high - low).max(), 1e-4 * np.abs(points).max(), 1e-30)
    margin = _MARGIN * (high - low) + 1e-3 * size
    return mi.ScalarBoundingBox3f(low - margin, high + margin)


def lit_normal(si: mi.SurfaceInteraction3f) -> mi.Normal3f:
    """The geometric normal on the side from which a surface is seen."""
    return dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, -si.n, si.n)
