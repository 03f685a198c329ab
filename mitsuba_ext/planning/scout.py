"""Finds where in a scene the paths of a sensor scatter, before learning begins."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.regions.surface_sides import lit_normal
from ..transport.observer import Observer
from ..transport.vertex import Vertex

#: About the number of recorded paths, and the number of vertices recorded of each.
_PATHS, _VERTICES = 1 << 16, 3

#: Longest path of a scout in segments.
SCOUT_DEPTH = _VERTICES + 1


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

    def vertex(self, vertex: Vertex, active: mi.Bool) -> None:
        si = vertex.si
        slot = self._path * _VERTICES + vertex.depth
        active = active & self._is_recorded & (vertex.depth < _VERTICES)
        dr.scatter(self._p, si.p, slot, active)
        dr.scatter(self._n, lit_normal(si), slot, active)
        dr.scatter(self._seen, mi.UInt32(1), slot, active)

    def vertices(self) -> tuple[mi.Point3f, mi.Normal3f]:
        """The positions of the vertices, and the geometric normals on the side that was hit."""
        slots = dr.compress(self._seen > 0)
        if len(slots) == 0:
            return mi.Point3f(), mi.Normal3f()
        p, n = dr.gather(mi.Point3f, self._p, slots), dr.gather(mi.Normal3f, self._n, slots)
        finite = dr.compress(dr.all(dr.isfinite(p) & dr.isfinite(n)))
        return dr.gather(mi.Point3f, p, finite), dr.gather(mi.Normal3f, n, finite)
