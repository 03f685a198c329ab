"""The rows of tables that are learned for surfaces: a voxel, and the side from which it is lit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .surface_sides import lit_normal

#: The six directions of the axes.
_SIDES = 6

#: The table of rows takes so much for each voxel of the region.
BYTES_PER_VOXEL = 4 * _SIDES


class SurfaceRows:
    """Numbers the pairs of a voxel and a side that vertices were found in.

    The side is the axis, positive or negative, that is nearest to the normal: the two faces of a
    wall that is thinner than a voxel, and the floor and the wall in a corner, see different lights.

    Parameters:
        bbox: What is divided into voxels.
        resolution: Voxels along each axis.
        p, n: Vertices, and normals on the side that is lit. At least one lies in ``bbox``.

    Attributes:
        count (int): Number of rows; the last one stands for all other points.
        slots (mi.UInt32): What the other rows are, as 6 · voxel + side; shape [count − 1].
        first, size (mi.UInt32): Where in ``p`` and ``n`` the vertices of a row are; [count − 1].
        p, n: The vertices inside of ``bbox``, row by row.
    """

    def __init__(
        self, bbox: mi.ScalarBoundingBox3f, resolution: int, p: mi.Point3f, n: mi.Normal3f
    ) -> None:
        self.bbox, self.resolution = bbox, resolution
        self._origin = mi.Point3f(bbox.min)
        self._scale = 1 / voxel_edges(bbox, resolution)
        # Opaque: other scenes and sensors share the kernels
        self._size = mi.Int32(resolution)
        dr.make_opaque(self._origin, self._scale, self._size)
        slot, inside = self._slot(p, n, mi.Bool(True))
        slot = np.where(inside.numpy(), slot.numpy(), resolution**3 * _SIDES)
        order = np.argsort(slot, kind="stable")[: int(inside.numpy().sum())]
        order = mi.UInt32(order.astype(np.uint32))
        self.p, self.n = dr.gather(mi.Point3f, p, order), dr.gather(mi.Normal3f, n, order)
        slots, first, size = np.unique(slot[order], return_index=True, return_counts=True)
        self.slots, self.first, self.size = (
            mi.UInt32(x.astype(np.uint32)) for x in (slots, first, size)
        )
        self.count = len(slots) + 1
        self._row = dr.full(mi.UInt32, self.count - 1, resolution**3 * _SIDES)
        dr.scatter(self._row, dr.arange(mi.UInt32, self.count - 1), self.slots)
        self._last = dr.opaque(mi.UInt32, self.count - 1)
        dr.eval(self.p, self.n, self._row)

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The row of a surface point, on the side that it is seen from."""
        slot, inside = self._slot(si.p, lit_normal(si), active)
        return dr.select(inside, dr.gather(mi.UInt32, self._row, slot, inside), self._last)

    def coarse(self) -> tuple[mi.UInt32, int]:
        """For each row but the last, the number of the row of a grid of half the resolution that it
        is a part of, and how many such rows there are."""
        r, half = self.resolution, (self.resolution + 1) // 2
        voxel, side = self.slots // _SIDES, self.slots % _SIDES
        x, y, z = voxel % r // 2, voxel // r % r // 2, voxel // (r * r) // 2
        slots = ((x + half * (y + half * z)) * _SIDES + side).numpy()
        numbers, index = np.unique(slots, return_inverse=True)
        return mi.UInt32(index.astype(np.uint32)), len(numbers)

    def _slot(self, p, n, active) -> tuple[mi.UInt32, mi.Bool]:
        cell = mi.Vector3i(dr.floor((p - self._origin) * self._scale))
        inside = active & dr.all((cell >= 0) & (cell < self._size))
        voxel = mi.UInt32(cell.x + self._size * (cell.y + self._size * cell.z))
        a = dr.abs(n)
        x_longest = (a.x >= a.y) & (a.x >= a.z)
        y_longest = a.y >= a.z
        axis = dr.select(x_longest, mi.UInt32(0), dr.select(y_longest, mi.UInt32(1), mi.UInt32(2)))
        component = dr.select(x_longest, n.x, dr.select(y_longest, n.y, n.z))
        return voxel * _SIDES + 2 * axis + dr.select(component < 0, mi.UInt32(1), 0), inside


def voxel_edges(bbox: mi.ScalarBoundingBox3f, resolution: int) -> mi.Vector3f:
    """The edges of a voxel."""
    return mi.Vector3f((bbox.max - bbox.min) / resolution)


class RowCounts:
    """How many rows there would be, by the resolution. Parameters are those of the rows."""

    def __init__(self, bbox: mi.ScalarBoundingBox3f, p: mi.Point3f, n: mi.Normal3f) -> None:
        low, high = np.array(bbox.min), np.array(bbox.max)
        self._relative = np.clip((p.numpy().T - low) / (high - low), 0, 1 - 1e-7)
        normal = n.numpy().T
        axis = np.abs(normal).argmax(axis=1)
        self._side = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0)

    def __call__(self, resolution: int) -> int:
        cell = (self._relative * resolution).astype(np.int64)
        slot = cell @ np.array([1, resolution, resolution**2]) * _SIDES + self._side
        return len(np.unique(slot)) + 1
