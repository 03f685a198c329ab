"""Numbers places on surfaces: the voxel of a point, the side of the surface in it, and the rows of
tables that are learned for such pairs."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy, joined
from ...util.discrete_sampling import ONE_MINUS_EPSILON

#: The number of sides: the positive and the negative direction of each axis.
SIDES = 6

#: The size of the table of rows, in bytes per voxel of the region.
BYTES_PER_VOXEL = 4 * SIDES

#: The maximum fraction of vertices outside the region, on either side of each axis; and about the
#: most vertices that tell where the region ends.
_MAX_OUTSIDE, _ENOUGH = 2e-3, 1 << 14

#: The margin of the region on each side, in units of its size.
_MARGIN = 0.02


class VoxelSides:
    """Numbers the pairs of a voxel and a side as 6 · voxel + side.

    The side of a surface is the axis direction, positive or negative, that is nearest to its
    normal: 2 · axis, plus 1 where it is negative. The two faces of a wall that is thinner than a
    voxel have different sides, and so do the floor and the wall in a corner.

    Parameters:
        origin: The lower corner of the box that is divided into voxels.
        scale: Voxels per unit of length along each axis.
        resolution: Voxels along each axis: an integer that is compiled into the kernels, or an
            opaque ``mi.Int32`` if several resolutions share kernels.
    """

    def __init__(
        self, origin: mi.Point3f, scale: mi.Vector3f, resolution: int | mi.Int32
    ) -> None:
        self._origin, self._scale, self._resolution = origin, scale, resolution
        # Opaque so that other scenes and sensors share the kernels
        dr.make_opaque(self._origin, self._scale)

    def number(
        self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Bool]:
        """The number of the voxel and the side of points with normals, and whether the points are
        ``active`` and in the box; otherwise, the number has no meaning."""
        voxel, inside = voxel_at((p - self._origin) * self._scale, self._resolution, active)
        return mi.UInt32(voxel) * SIDES + _side(n), inside


def voxel_at(
    p: mi.Point3f, resolution: int | mi.Int32, active: mi.Bool
) -> tuple[mi.Int32, mi.Bool]:
    """The number of the voxel that holds ``p``, a point in units of voxels, and whether the point
    is ``active`` and there is such a voxel."""
    cell = mi.Vector3i(dr.floor(p))
    inside = active & dr.all((cell >= 0) & (cell < resolution))
    return voxel_number(cell.x, cell.y, cell.z, resolution), inside


def voxel_number(x: Any, y: Any, z: Any, resolution: Any) -> Any:
    """The number of the voxel at integer coordinates in a grid of resolution³: x changes fastest.
    Arguments are integers, or arrays of NumPy or Dr.Jit."""
    return x + resolution * (y + resolution * z)


def voxel_coordinates(number: Any, resolution: Any) -> tuple[Any, Any, Any]:
    """The inverse of :func:`voxel_number`."""
    return number % resolution, number // resolution % resolution, number // resolution**2


def sides(normals: np.ndarray) -> np.ndarray:
    """The side of each normal [n, 3], as :class:`VoxelSides` numbers them; shape [n]."""
    axis = np.abs(normals).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)


def _side(n: mi.Normal3f) -> mi.UInt32:
    a = dr.abs(n)
    x_longest = (a.x >= a.y) & (a.x >= a.z)
    y_longest = a.y >= a.z
    axis = dr.select(x_longest, mi.UInt32(0), dr.select(y_longest, mi.UInt32(1), mi.UInt32(2)))
    component = dr.select(x_longest, n.x, dr.select(y_longest, n.y, n.z))
    return 2 * axis + dr.select(component < 0, mi.UInt32(1), 0)


def region(p: mi.Point3f) -> mi.ScalarBoundingBox3f:
    """A box that holds nearly all points. A few distant ones are left out because they would make
    the voxels of the box coarse."""
    stride = -(-dr.width(p) // _ENOUGH)
    count = -(-dr.width(p) // stride)
    p = dr.gather(mi.Point3f, p, dr.arange(mi.UInt32, count) * dr.opaque(mi.UInt32, stride))
    in_order = dr.sort(mi.TensorXf(joined([p.x, p.y, p.z]), (3, count))).array
    place = np.array([_MAX_OUTSIDE, 1 - _MAX_OUTSIDE]) * (count - 1)
    below = place.astype(int)
    # The extremes of each axis, and the neighbours of both quantiles
    chosen = np.array([0, count - 1, *below, *np.minimum(below + 1, count - 1)])
    index = from_numpy(mi.UInt32, np.arange(3)[:, None] * count + chosen)
    found = dr.gather(mi.Float, in_order, index).numpy().reshape(3, 3, 2).astype(np.float64)
    low, high = (found[:, 1] + (found[:, 2] - found[:, 1]) * (place - below)).T
    # A flat region needs some depth, and distant coordinates are rounded
    size = max((high - low).max(), 1e-4 * np.abs(found[:, 0]).max(), 1e-30)
    margin = _MARGIN * (high - low) + 1e-3 * size
    return mi.ScalarBoundingBox3f(low - margin, high + margin)


def lit_normal(si: mi.SurfaceInteraction3f) -> mi.Normal3f:
    """The geometric normal on the side from which a surface is seen."""
    return dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, -si.n, si.n)


class SurfaceRows:
    """Numbers, without gaps, the pairs of a voxel and a side (:class:`VoxelSides`) in which
    vertices were found. Each pair is a row of the tables, because the two sides of a thin wall, or
    the floor and the wall in a corner, are lit by different lights.

    Parameters:
        bbox: The box that is divided into voxels.
        resolution: Voxels along each axis.
        p, n: Vertices, and normals on the lit side. At least one vertex lies in ``bbox``.

    Attributes:
        count (int): Number of rows; the last one stands for all other points.
        pairs (mi.UInt32): The pair of each row except the last, as 6 · voxel + side; shape [count −
            1].
        first, size (mi.UInt32): The vertices of a row have the indices ``first`` to ``first + size
            − 1`` in ``p`` and ``n``; shape [count − 1].
        p, n: The vertices inside ``bbox``, row by row.
    """

    def __init__(
        self, bbox: mi.ScalarBoundingBox3f, resolution: int, p: mi.Point3f, n: mi.Normal3f
    ) -> None:
        self.bbox, self.resolution = bbox, resolution
        scale = 1 / voxel_edges(bbox, resolution)
        # Opaque so that other scenes and sensors share the kernels
        self._pairs = VoxelSides(mi.Point3f(bbox.min), scale, dr.opaque(mi.Int32, resolution))
        pair, inside = self._pairs.number(p, n, mi.Bool(True))
        dr.eval(pair, inside)
        order = dr.compress(inside)
        order = dr.gather(mi.UInt32, order, dr.argsort(dr.gather(mi.UInt32, pair, order)))
        self.p, self.n = dr.gather(mi.Point3f, p, order), dr.gather(mi.Normal3f, n, order)
        pair_count = resolution**3 * SIDES
        size = counts_below(pair_count, pair, inside)
        self.pairs = dr.compress(size > 0)
        self.size = dr.gather(mi.UInt32, size, self.pairs)
        self.first = dr.prefix_sum(self.size)
        self.count = len(self.pairs) + 1
        self._row = dr.full(mi.UInt32, self.count - 1, pair_count)
        dr.scatter(self._row, dr.arange(mi.UInt32, self.count - 1), self.pairs)
        self._last = dr.opaque(mi.UInt32, self.count - 1)
        dr.eval(self.p, self.n, self._row)
        self._coarse: tuple[mi.UInt32, int] | None = None

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The row of a surface point on the side from which it is seen."""
        pair, inside = self._pairs.number(si.p, lit_normal(si), active)
        return dr.select(inside, dr.gather(mi.UInt32, self._row, pair, inside), self._last)

    def coarse(self) -> tuple[mi.UInt32, int]:
        """For each row, the index of the row of a grid with half the resolution that contains it;
        and the number of such coarse rows. The last row is a coarse row of its own."""
        if self._coarse is None:
            half = (self.resolution + 1) // 2
            x, y, z = voxel_coordinates(self.pairs // SIDES, dr.opaque(mi.UInt32, self.resolution))
            voxel = voxel_number(x // 2, y // 2, z // 2, dr.opaque(mi.UInt32, half))
            pairs = voxel * SIDES + self.pairs % SIDES
            found = dr.compress(counts_below(half**3 * SIDES, pairs) > 0)
            number = dr.empty(mi.UInt32, half**3 * SIDES)
            dr.scatter(number, dr.arange(mi.UInt32, len(found)), found)
            last = dr.opaque(mi.UInt32, len(found))
            index = joined([dr.gather(mi.UInt32, number, pairs), last])
            self._coarse = index, len(found) + 1
        return self._coarse


def voxel_edges(bbox: mi.ScalarBoundingBox3f, resolution: int) -> mi.Vector3f:
    """The edges of a voxel."""
    return mi.Vector3f((bbox.max - bbox.min) / resolution)


class RowCounts:
    """The number of rows that :class:`SurfaceRows` would have, as a function of the resolution.

    Parameters:
        bbox, p, n: See :class:`SurfaceRows`.
    """

    def __init__(self, bbox: mi.ScalarBoundingBox3f, p: mi.Point3f, n: mi.Normal3f) -> None:
        low, high = mi.Point3f(bbox.min), mi.Point3f(bbox.max)
        dr.make_opaque(low, high)
        self._relative = dr.clip((p - low) / (high - low), 0, ONE_MINUS_EPSILON)
        self._side = _side(n)
        dr.eval(self._relative, self._side)

    def __call__(self, resolution: int) -> int:
        scale = dr.opaque(mi.UInt32, resolution)
        cell = mi.Vector3u(self._relative * mi.Float(scale))
        pair = voxel_number(cell.x, cell.y, cell.z, scale) * SIDES + self._side
        return int(dr.count(counts_below(resolution**3 * SIDES, pair) > 0)[0]) + 1


def counts_below(size: int, index: mi.UInt32, active: mi.Bool | bool = True) -> mi.UInt32:
    """How often each number below ``size`` occurs."""
    counts = dr.zeros(mi.UInt32, size)
    # In place: copies for each thread would make the kernel depend on the size
    dr.scatter_add(counts, mi.UInt32(1), index, active, dr.ReduceMode.Direct)
    return counts
