"""Regions of surfaces that are smaller where there are more points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy, joined
from ...util.stored_arrays import StoredArrays
from .surface_voxels import SIDES, VoxelSides, counts_below, region, voxel_coordinates

#: The number of voxels along each axis at each level; they divide the previous level's voxels.
_GRIDS = (4, 8, 16, 32)


class NestedRegions:
    """Regions are pairs of a voxel, in the bounding box of the given points, and a side of its
    surfaces.

    Region 0 is the whole scene. Regions of large voxels follow, then regions of the smaller voxels
    inside them; a region exists only if it contains enough points. A point belongs to the smallest
    region that contains it.

    Parameters:
        p, n: Points, and normals on the lit side; not empty.
        least: The minimum number of these points in a region.
        most: The maximum number of regions; if there would be more, ``least`` is raised.

    Attributes:
        count (int): Number of regions.
        origin (np.ndarray), size (np.ndarray): The bounding box that is divided into voxels.
        levels (list[slice]): The regions of each level.
        parent (np.ndarray): For each region, the containing region of the previous or an earlier
            level; shape [regions].
    """

    def __init__(
        self, p: mi.Point3f, n: mi.Normal3f, least: float = 1, most: int = 1 << 30
    ) -> None:
        bbox = region(p)
        finest = _GRIDS[-1]
        scale = finest / mi.Vector3f(bbox.max - bbox.min)
        self._origin, self._scale = np.array(bbox.min), np.array(scale).ravel()
        self._pairs = VoxelSides(mi.Point3f(bbox.min), scale, finest)
        points = counts_below(finest**3 * SIDES, *self._pairs.number(p, n, mi.Bool(True)))
        pair = dr.compress(points > 0)
        points = dr.gather(mi.UInt32, points, pair)
        # Of the points, only these numbers are copied to the host
        pair, points = joined([pair, points]).numpy().reshape(2, -1)
        voxel, side = np.divmod(pair, SIDES)
        cell = np.stack(voxel_coordinates(voxel, finest))

        divisions = []
        for grid in _GRIDS:
            x, y, z = cell * grid // finest
            place = np.ravel_multi_index((z, y, x, side), (grid, grid, grid, SIDES))
            seen, which = np.unique(place, return_inverse=True)
            divisions.append((seen, np.bincount(which, points, len(seen))))
        times = np.sort(np.concatenate([times for _seen, times in divisions]))
        if len(times) >= most:
            least = max(least, times[len(times) - most] + 1)

        table = np.zeros((1, 1, 1, SIDES), np.uint32)
        self.levels, parents, self.count = [slice(0, 1)], [np.zeros(1, np.uint32)], 1
        for grid, (seen, times) in zip(_GRIDS, divisions):
            for axis in range(3):
                table = table.repeat(grid // table.shape[axis], axis)
            seen = seen[times >= least]
            parents.append(table.flat[seen])
            table.flat[seen] = self.count + np.arange(len(seen))
            self.levels.append(slice(self.count, self.count + len(seen)))
            self.count += len(seen)
        self.parent = np.concatenate(parents)
        self._table = from_numpy(mi.UInt32, table)
        dr.eval(self._table)

    def state(self) -> dict[str, np.ndarray]:
        """The data that :meth:`number` needs, as arrays."""
        return {
            "origin": self._origin,
            "scale": self._scale,
            "table": self._table.numpy(),
            "count": np.array(self.count),
        }

    @classmethod
    def of_state(cls, state: StoredArrays) -> NestedRegions:
        """Regions from a :meth:`state`, with only :meth:`number` and ``count``.

        Raises:
            DamagedError: The state is not a state of regions.
        """
        regions, pairs = cls.__new__(cls), _GRIDS[-1] ** 3 * SIDES
        regions._origin = state.take("origin", "f", (3,))
        regions._scale = state.take("scale", "f", (3,), least=0)
        # At most one region for each pair of each grid, and the whole scene
        regions.count = state.number("count", "iu", 1, 1 + sum(n**3 * SIDES for n in _GRIDS))
        table = state.take("table", "u", (pairs,), most=regions.count - 1)
        regions._pairs = VoxelSides(
            mi.Point3f(regions._origin), mi.Vector3f(regions._scale), _GRIDS[-1]
        )
        regions._table = from_numpy(mi.UInt32, table)
        dr.eval(regions._table)
        return regions

    @property
    def origin(self) -> np.ndarray:
        return self._origin

    @property
    def size(self) -> np.ndarray:
        return _GRIDS[-1] / self._scale

    def number(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> mi.UInt32:
        """The smallest region that contains a point with the normal ``n`` on its lit side."""
        pair, inside = self._pairs.number(p, n, active)
        return dr.gather(mi.UInt32, self._table, pair, inside)
