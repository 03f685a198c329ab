"""The rows of tables that are learned for surfaces: pairs of a voxel and a lit side."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .surface_sides import lit_normal
from .voxel_sides import SIDES, VoxelSides, sides, voxel_coordinates, voxel_number

#: The size of the table of rows, in bytes per voxel of the region.
BYTES_PER_VOXEL = 4 * SIDES


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
        pair, inside = (x.numpy() for x in self._pairs.number(p, n, mi.Bool(True)))
        pair_count = resolution**3 * SIDES
        pair = np.where(inside, pair, pair_count)
        # Vertices outside come last, and are left out
        order = np.argsort(pair, kind="stable")[: int(inside.sum())]
        order = from_numpy(mi.UInt32, order)
        self.p, self.n = dr.gather(mi.Point3f, p, order), dr.gather(mi.Normal3f, n, order)
        pairs, first, size = np.unique(pair[order], return_index=True, return_counts=True)
        self.pairs, self.first, self.size = (
            from_numpy(mi.UInt32, x) for x in (pairs, first, size)
        )
        self.count = len(pairs) + 1
        self._row = dr.full(mi.UInt32, self.count - 1, pair_count)
        dr.scatter(self._row, dr.arange(mi.UInt32, self.count - 1), self.pairs)
        self._last = dr.opaque(mi.UInt32, self.count - 1)
        dr.eval(self.p, self.n, self._row)

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The row of a surface point on the side from which it is seen."""
        pair, inside = self._pairs.number(si.p, lit_normal(si), active)
        return dr.select(inside, dr.gather(mi.UInt32, self._row, pair, inside), self._last)

    def coarse(self) -> tuple[mi.UInt32, int]:
        """For each row except the last, the index of the row of a grid with half the resolution
        that contains it; and the number of such coarse rows."""
        half = (self.resolution + 1) // 2
        x, y, z = voxel_coordinates(self.pairs // SIDES, self.resolution)
        voxel = voxel_number(x // 2, y // 2, z // 2, half)
        pairs = (voxel * SIDES + self.pairs % SIDES).numpy()
        numbers, index = np.unique(pairs, return_inverse=True)
        return from_numpy(mi.UInt32, index), len(numbers)


def voxel_edges(bbox: mi.ScalarBoundingBox3f, resolution: int) -> mi.Vector3f:
    """The edges of a voxel."""
    return mi.Vector3f((bbox.max - bbox.min) / resolution)


class RowCounts:
    """The number of rows that :class:`SurfaceRows` would have, as a function of the resolution.

    Parameters:
        bbox, p, n: See :class:`SurfaceRows`.
    """

    def __init__(self, bbox: mi.ScalarBoundingBox3f, p: mi.Point3f, n: mi.Normal3f) -> None:
        low, high = np.array(bbox.min), np.array(bbox.max)
        self._relative = np.clip((p.numpy().T - low) / (high - low), 0, 1 - 1e-7)
        self._side = sides(n.numpy().T)

    def __call__(self, resolution: int) -> int:
        x, y, z = (self._relative * resolution).astype(np.int64).T
        return len(np.unique(voxel_number(x, y, z, resolution) * SIDES + self._side)) + 1
