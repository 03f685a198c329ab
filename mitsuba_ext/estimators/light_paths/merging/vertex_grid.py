"""A hash grid of the stored vertices of light paths, which finds the vertices near a point."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..light_vertices import VertexCache

#: Cells are two radii wide in y and z, so a ball overlaps four rows of cells along x. In x, this
#: number of cells is two radii wide. The cells of a row have adjacent buckets, so the vertices of
#: all cells of a row that a ball overlaps are one range.
_PER_DIAMETER, _ROWS = 2, 4

#: Functions of vertices, which are given by their indices and a mask: whether they are kept, and
#: their groups.
Kept = Callable[["mi.UInt32", "mi.Bool"], "mi.Bool"]
Group = Callable[["mi.UInt32", "mi.Bool"], "mi.UInt32"]


def all_of(*conditions: Kept | None) -> Kept | None:
    """Keeps the vertices that fulfil all of these conditions; ``None`` stands for no condition."""
    given = [condition for condition in conditions if condition is not None]
    if len(given) < 2:
        return given[0] if given else None
    return lambda index, active: functools.reduce(
        lambda kept, condition: kept & condition(index, active), given, active
    )


class Counted(NamedTuple):
    """The vertices while they are counted.

    Attributes:
        index, active: A vertex in each lane, and whether the lane has one that is kept.
        p: Its position.
        hashed, bucket: The number of its row of cells, and the bucket of its cell.
        rank: The number of vertices of this bucket that were counted before.
        counts: The number of vertices in each bucket.
    """

    index: mi.UInt32
    active: mi.Bool
    p: mi.Point3f
    hashed: mi.UInt32
    bucket: mi.UInt32
    rank: mi.UInt32
    counts: mi.UInt32


class HashedGrid:
    """A regular grid. Its cells are numbered by a hash, so that memory does not depend on the size
    of the scene.

    Parameters:
        radius: Radius of the balls in which vertices are looked for.
        room: The number of buckets is at least this number.
    """

    def __init__(self, radius: mi.Float, room: int) -> None:
        scale = 0.5 / radius
        self._scale = mi.Vector3f(_PER_DIAMETER * scale, scale, scale)
        # A power of two: kernels are shared
        self._buckets = 1 << (room - 1).bit_length()
        self._mask = dr.opaque(mi.UInt32, self._buckets - 1)

    def _count(self, vertices: VertexCache, kept: Kept | None, group: Group | None) -> Counted:
        """Counts the vertices in each bucket. Nothing is evaluated."""
        index, active = vertices.every()
        if kept is not None:
            active &= kept(index, active)
        p = vertices.position(index, active)
        cell = self._cell(p)
        hashed = _hash(cell, mi.UInt32(0) if group is None else group(index, active))
        bucket = (hashed + mi.UInt32(cell.x)) & self._mask
        counts = dr.zeros(mi.UInt32, self._buckets)
        rank = dr.scatter_inc(counts, bucket, active)
        return Counted(index, active, p, hashed, bucket, rank, counts)

    def _cell(self, p: mi.Point3f) -> mi.Vector3i:
        return mi.Vector3i(dr.floor(mi.Vector3f(p) * self._scale))


class VertexCounts(HashedGrid):
    """The number of vertices in each cube of a grid, two radii wide. There must be few vertices,
    because buckets are counted as cells.

    Parameters:
        vertices, radius, kept: See :class:`VertexGrid`.
    """

    def __init__(self, vertices: VertexCache, radius: mi.Float, kept: Kept | None) -> None:
        super().__init__(radius, vertices.room)
        counted = self._count(vertices, kept, None)
        dr.eval(counted.rank, counted.counts)
        # The two buckets of a cube follow each other, since hashes are even
        even = 2 * dr.arange(mi.UInt32, self._buckets // 2)
        counts = dr.gather(mi.UInt32, counted.counts, even)
        self._cubes = mi.Float64(counts + dr.gather(mi.UInt32, counted.counts, even + 1))
        dr.eval(self._cubes)
        self._total = dr.sum(self._cubes)

    @property
    def count(self) -> int:
        """Number of vertices."""
        return int(self._total[0])

    @property
    def occupancy(self) -> float:
        """The number of other vertices in the cube around a vertex, on average over the vertices.
        There must be at least one vertex."""
        return float((dr.dot(self._cubes, self._cubes) / self._total)[0]) - 1

    @property
    def median_occupancy(self) -> float:
        """Like :attr:`occupancy`, but the median over the vertices."""
        counts = np.sort(self._cubes.numpy())
        vertices = np.cumsum(counts)
        return float(counts[np.searchsorted(vertices, 0.5 * vertices[-1])]) - 1


class VertexGrid(HashedGrid):
    """The vertices, sorted by the cell of a regular grid that they lie in.

    The order of the vertices in a cell depends on threads; sums over them therefore differ from run
    to run by rounding.

    Parameters:
        vertices: The vertices, at least one.
        radius: Radius of the balls in which vertices are looked for.
        kept: Tells which vertices, given by their indices and a mask, are in the grid; all of them
            if it is ``None``.
        group: Returns the number of a vertex's group; its arguments are the same as for ``kept``.
            Vertices are looked for in one group at a time. (Different groups may have the same
            number: callers check.) ``None`` if there is only one.
    """

    def __init__(
        self,
        vertices: VertexCache,
        radius: mi.Float,
        kept: Kept | None = None,
        group: Group | None = None,
    ) -> None:
        # As many buckets as there is room for vertices
        super().__init__(radius, vertices.room)
        self.radius = radius
        index, active, p, hashed, bucket, rank, counts = self._count(vertices, kept, group)
        tags = dr.zeros(mi.UInt32, self._buckets)
        dr.scatter_reduce(dr.ReduceOp.Or, tags, _tag(hashed), bucket, active)
        dr.eval(rank, counts, tags)
        starts = dr.prefix_reduce(dr.ReduceOp.Add, counts, exclusive=True)
        place = dr.gather(mi.UInt32, starts, bucket, active) + rank
        self._sorted = dr.empty(mi.Float, 4 * vertices.room)
        packet = mi.Vector4f(p.x, p.y, p.z, dr.reinterpret_array(mi.Float, index))
        dr.scatter(self._sorted, packet, place, active)
        final = mi.UInt32(self._mask)
        self._total = dr.gather(mi.UInt32, starts, final) + dr.gather(mi.UInt32, counts, final)
        # For each bucket, the range of places from its first vertex to the last vertex of the
        # buckets that a ball overlaps, and the tags of their cells. The first bucket follows the
        # last one
        first = dr.arange(mi.UInt32, self._buckets)
        last = first + _PER_DIAMETER
        end = dr.gather(mi.UInt32, starts, last & self._mask)
        end += dr.gather(mi.UInt32, counts, last & self._mask)
        end += dr.select(last > self._mask, self._total, 0)
        for k in range(1, _PER_DIAMETER + 1):
            tags = tags | dr.gather(mi.UInt32, tags, (first + k) & self._mask)
        self._ranges = dr.ravel(mi.Vector4u(starts, end, tags, 0))
        dr.eval(self._ranges, self._sorted, self._total, self._scale)

    @property
    def count(self) -> int:
        """Number of vertices."""
        return int(self._total[0])

    def kernel_state(self) -> tuple:
        """The arrays that kernels depend on."""
        return self.radius, self._scale, self._mask, self._total, self._ranges, self._sorted

    def crowd(self, p: mi.Point3f, active: mi.Bool) -> mi.UInt32:
        """The number of vertices in the cells that a ball around ``p`` overlaps: on a surface, they
        cover about four times the area of its disk."""
        count, first = mi.UInt32(0), self._cell(p - self.radius)
        for row in range(_ROWS):
            bounds, holds = self._range(first, mi.UInt32(row), mi.UInt32(0), active)
            count += dr.select(holds, bounds.y - bounds.x, 0)
        return count

    def _range(
        self, first: mi.Vector3i, row: mi.UInt32, group: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Vector4u, mi.Bool]:
        """The range of a row of cells, from its first cell on, and whether it may hold vertices."""
        cell = first + mi.Vector3i(0, row & 1, row >> 1)
        hashed = _hash(cell, group)
        bucket = (hashed + mi.UInt32(cell.x)) & self._mask
        bounds = dr.gather(mi.Vector4u, self._ranges, bucket, active)
        return bounds, (bounds.z & _tag(hashed)) != 0

    def begin(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The state of a search before its first vertex: the number of the next row of cells, and
        the places of the next vertex and behind the last one of the current row."""
        return mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

    def next(
        self,
        state: tuple[mi.UInt32, mi.UInt32, mi.UInt32],
        p: mi.Point3f,
        active: mi.Bool,
        group: mi.UInt32 | None = None,
    ) -> tuple[Any, mi.UInt32, mi.Bool, mi.Bool]:
        """Looks at one more vertex.

        Returns:
            The new state; the index of the vertex; whether there was one within the radius of
            ``p``; and whether the search goes on.
        """
        number, place, end = state
        first = self._cell(p - self.radius)

        # ----- Go on to the next row if this one is at its end -----
        is_new = active & (place >= end)
        group = mi.UInt32(0) if group is None else group
        bounds, holds = self._range(first, number, group, is_new)
        place = dr.select(is_new, bounds.x, place)
        end = dr.select(is_new, dr.select(holds, bounds.y, bounds.x), end)
        number += dr.select(is_new, 1, 0)

        # ----- Look at the next vertex -----
        exists = active & (place < end)
        wrapped = place - dr.select(place < self._total, 0, self._total)
        packet = dr.gather(mi.Vector4f, self._sorted, wrapped, exists)
        q = mi.Point3f(packet.x, packet.y, packet.z)
        # Other rows may have the same buckets
        last, own = number - 1, self._cell(q)
        is_found = exists & (own.y == first.y + mi.Int32(last & 1))
        is_found &= own.z == first.z + mi.Int32(last >> 1)
        is_found &= dr.squared_norm(q - p) < dr.square(self.radius)
        index = dr.reinterpret_array(mi.UInt32, packet.w)
        place += dr.select(exists, 1, 0)
        goes_on = active & ((place < end) | (number < _ROWS))
        return (number, place, end), index, is_found, goes_on


def _hash(cell: mi.Vector3i, group: mi.UInt32) -> mi.UInt32:
    """An even number for the row of cells along x that this cell lies in."""
    word = mi.UInt32(cell.y) * 0x9E3779B1 ^ mi.UInt32(cell.z) * 0x85EBCA77 ^ group
    return ((word ^ (word >> 15)) * 0xC2B2AE3D) & 0xFFFFFFFE


def _tag(hashed: mi.UInt32) -> mi.UInt32:
    """One of 32 bits, which distinguishes rows of cells that share buckets."""
    return mi.UInt32(1) << (hashed >> 27)
