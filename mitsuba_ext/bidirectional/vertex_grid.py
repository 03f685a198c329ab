"""A hash grid of the stored vertices of light paths, which finds those near a point."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .light_vertices import VertexCache

#: Cells that a ball of one radius can overlap: cells are two radii wide.
_CELLS = 8


class VertexGrid:
    """The vertices, sorted by the cell of a regular grid that they lie in. Cells are numbered by a
    hash, so that memory does not depend on the size of the scene.

    The order of the vertices in a cell depends on threads: what is summed over them does so by
    rounding.

    Parameters:
        vertices: The vertices, at least one.
        radius: Radius of the balls in which vertices are looked for.
        only_caustic: Leave out vertices to which light does not come from a delta lobe?
    """

    def __init__(
        self, vertices: VertexCache, radius: mi.Float, only_caustic: bool = False
    ) -> None:
        self.radius = radius
        self._scale = 0.5 / radius
        dr.make_opaque(self._scale)
        # As many buckets as there is room for vertices, a power of two: kernels are shared
        self._mask = dr.opaque(mi.UInt32, (1 << (vertices.room - 1).bit_length()) - 1)
        buckets = 1 << (vertices.room - 1).bit_length()
        index = dr.arange(mi.UInt32, vertices.room)
        active = index < dr.opaque(mi.UInt32, vertices.count)
        if only_caustic:
            active &= vertices.is_caustic(index, active)
        p = vertices.position(index, active)
        bucket = self._bucket(self._cell(p))
        counts = dr.zeros(mi.UInt32, buckets)
        rank = dr.scatter_inc(counts, bucket, active)
        dr.eval(rank, counts)
        ends = dr.cumsum(counts)
        place = dr.gather(mi.UInt32, ends, bucket, active)
        place = place - dr.gather(mi.UInt32, counts, bucket, active) + rank
        self._counts = counts
        #: Of each bucket, the places of its first vertex and behind its last one.
        self._ranges = dr.ravel(mi.Vector2u(ends - counts, ends))
        self._sorted = dr.empty(mi.Float, 4 * vertices.room)
        packet = mi.Vector4f(p.x, p.y, p.z, dr.reinterpret_array(mi.Float, index))
        dr.scatter(self._sorted, packet, place, active)
        dr.eval(self._ranges, self._sorted)

    @property
    def count(self) -> int:
        """Number of vertices."""
        return int(dr.sum(self._counts)[0])

    @property
    def occupancy(self) -> float:
        """The number of other vertices in the cell of a vertex, on average over the vertices; of a
        grid of few vertices, as buckets stand for cells."""
        counts = mi.Float64(self._counts)
        total, squares = dr.sum(counts), dr.sum(dr.square(counts))
        return float((squares / dr.maximum(total, 1))[0]) - 1

    def kernel_state(self) -> tuple:
        """The arrays that kernels depend on."""
        return self.radius, self._scale, self._mask, self._ranges, self._sorted

    def _cell(self, p: mi.Point3f) -> mi.Vector3i:
        return mi.Vector3i(dr.floor(mi.Vector3f(p) * self._scale))

    def _bucket(self, cell: mi.Vector3i) -> mi.UInt32:
        c = mi.Vector3u(cell)
        return (c.x * 73856093 ^ c.y * 19349663 ^ c.z * 83492791) & self._mask

    def begin(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The state of a search before its first vertex: the number of the next cell, and the
        places of the next vertex and behind the last one of the current cell."""
        return mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

    @dr.syntax
    def next(
        self, state: tuple[mi.UInt32, mi.UInt32, mi.UInt32], p: mi.Point3f, active: mi.Bool
    ) -> tuple[Any, mi.UInt32, mi.Bool]:
        """The next vertex within the radius of ``p``.

        Returns:
            The new state; the index of the vertex; and where there was one.
        """
        number, place, end = mi.UInt32(state[0]), mi.UInt32(state[1]), mi.UInt32(state[2])
        first = mi.Vector3i(dr.floor(mi.Vector3f(p) * self._scale - 0.5))
        index, is_found, searches = mi.UInt32(0), mi.Bool(False), mi.Bool(active)
        while dr.hint(searches, label="grid"):
            is_empty = place >= end
            # ----- Go on to the next cell, or look at the next vertex of this one -----
            is_new = is_empty & (number < _CELLS)
            cell = first + mi.Vector3i(number & 1, (number >> 1) & 1, (number >> 2) & 1)
            bounds = dr.gather(mi.Vector2u, self._ranges, self._bucket(cell), is_new)
            packet = dr.gather(mi.Vector4f, self._sorted, place, ~is_empty)
            q = mi.Point3f(packet.x, packet.y, packet.z)
            last = number - 1
            own = first + mi.Vector3i(last & 1, (last >> 1) & 1, (last >> 2) & 1)
            # Other cells may have the same bucket
            is_found = ~is_empty & dr.all(self._cell(q) == own)
            is_found &= dr.squared_norm(q - p) < dr.square(self.radius)
            index = dr.select(is_found, dr.reinterpret_array(mi.UInt32, packet.w), index)
            searches = ~is_found & (~is_empty | is_new)
            place = dr.select(is_new, bounds.x, place + dr.select(is_empty, 0, 1))
            end = dr.select(is_new, bounds.y, end)
            number += dr.select(is_new, 1, 0)
        return (number, place, end), index, is_found
