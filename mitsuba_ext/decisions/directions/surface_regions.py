"""Trees for regions of surfaces: the geometry decides which paths learn from each other."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...regions.surface_sides import lit_normal, region
from .path_records import PathRecords
from .sample_trees import SampleTrees
from .tree_builder import UNIFORM, Samples, TreeBuilder

#: Voxels along each axis, level by level: each of them divides those of the one before.
_GRIDS = (4, 8, 16, 32)

#: The six directions of the axes.
_SIDES = 6

#: So many samples count for what was found in larger surroundings.
_PRIOR = 32


class SurfaceRegions:
    """Voxels of the region in which paths scatter, and the sides of their surfaces.

    The number 0 stands for everything; large voxels come after it, and smaller ones inside of them
    after these, each where paths meet it often enough. The last number stands for mirrors and
    glass, whose directions do not depend on the sample: it has a tree without splits. All bounces
    of a path use the trees of the places where they happen.

    Parameters:
        p, n: Where paths scatter, and normals on the side that is lit; not empty.
        least: How many of these a region has, at least.

    Attributes:
        count: Number of regions that learn.
    """

    def __init__(self, p: mi.Point3f, n: mi.Normal3f, least: float) -> None:
        bbox = region(p)
        finest = _GRIDS[-1]
        # Opaque: other scenes and sensors share the kernels
        self._origin = mi.Point3f(bbox.min)
        self._scale = finest / mi.Vector3f(bbox.max - bbox.min)
        dr.make_opaque(self._origin, self._scale)
        cell, side, inside = self._locate(p, n, mi.Bool(True))
        inside = inside.numpy()
        cell, side = cell.numpy().T[inside], side.numpy()[inside]

        table = np.zeros((1, 1, 1, _SIDES), np.uint32)
        self._levels, parents, self.count = [slice(0, 1)], [np.zeros(1, np.uint32)], 1
        for grid in _GRIDS:
            for axis in range(3):
                table = table.repeat(grid // table.shape[axis], axis)
            x, y, z = (cell * grid // finest).T
            seen, times = np.unique(
                np.ravel_multi_index((z, y, x, side), table.shape), return_counts=True
            )
            seen = seen[times >= least]
            parents.append(table.flat[seen])
            table.flat[seen] = self.count + np.arange(len(seen))
            self._levels.append(slice(self.count, self.count + len(seen)))
            self.count += len(seen)
        self._parent = np.concatenate(parents)
        self._table = mi.UInt32(table.ravel())
        self._specular = dr.opaque(mi.UInt32, self.count)
        dr.eval(self._table)

    # ---- During the walk ----

    def begin(self, pixel: mi.UInt32 | None) -> tuple:
        """There is no state."""
        return ()

    def tree(self, state: tuple, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The tree of a vertex: that of the smallest region it belongs to."""
        return self.label(si, None, active)

    def after(
        self, state: tuple, trees: SampleTrees, leaf: mi.UInt32, active: mi.Bool
    ) -> tuple:
        """The state after a sample was drawn from a leaf."""
        return state

    # ---- What is learned ----

    def label(self, si: mi.SurfaceInteraction3f, pixel, active: mi.Bool) -> mi.UInt32:
        """The region by which a sample is recorded."""
        cell, side, inside = self._locate(si.p, lit_normal(si), active)
        slot = (cell.x + _GRIDS[-1] * (cell.y + _GRIDS[-1] * cell.z)) * _SIDES + side
        region = dr.gather(mi.UInt32, self._table, mi.UInt32(slot), inside)
        is_smooth = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        return dr.select(is_smooth, region, self._specular)

    def build(self, records: PathRecords) -> tuple[TreeBuilder, mi.UInt32, None]:
        """The trees and their roots. A region expects what the one around it found."""
        samples = Samples(records.code, records.value, records.weight)
        samples, region = samples.merged(records.region)
        builder = TreeBuilder()
        roots = np.full(self.count + 1, UNIFORM, np.uint32)
        for level, regions in enumerate(self._levels):
            size = regions.stop - regions.start
            if size == 0:
                continue
            tree = dr.gather(mi.UInt32, mi.UInt32(self._numbers(level)), region)
            expected = mi.UInt32(roots[self._parent[regions]]) if level > 0 else None
            first = builder.add(samples, tree, size, expected)
            roots[regions] = first + np.arange(size)
        return builder, mi.UInt32(roots), None

    def incident_radiance(self, records: PathRecords) -> mi.Float:
        """The mean radiance that bounces find in each region, where a region expects what the one
        around it found; −1 for mirrors and glass. Shape [regions]."""
        region = records.region.numpy()
        # In double precision, one after the other: equal seeds make equal sums
        value, throughput, count = (
            np.bincount(region, x, self.count + 1)
            for x in (records.value.numpy(), records.throughput.numpy(), np.ones(len(region)))
        )
        for regions in reversed(self._levels[1:]):
            for x in (value, throughput, count):
                np.add.at(x, self._parent[regions], x[regions])
        radiance = np.full(self.count + 1, -1.0)
        for level, regions in enumerate(self._levels):
            prior, expected = 0.0, 0.0
            if level > 0:
                prior = _PRIOR * throughput[regions] / np.maximum(count[regions], 1)
                expected = radiance[self._parent[regions]]
            radiance[regions] = (value[regions] + prior * expected) / np.maximum(
                throughput[regions] + prior, 1e-30
            )
        return mi.Float(np.minimum(radiance, 1e30).astype(np.float32))

    def _numbers(self, level: int) -> np.ndarray:
        """For each region, which one of a level's it lies in; too large a number for none."""
        numbers = np.full(self.count + 1, self.count, np.uint32)
        regions = self._levels[level]
        numbers[regions] = np.arange(regions.stop - regions.start)
        for smaller in self._levels[level + 1 :]:
            numbers[smaller] = numbers[self._parent[smaller]]
        return numbers

    def _locate(self, p, n, active) -> tuple[mi.Vector3i, mi.Int32, mi.Bool]:
        cell = mi.Vector3i(dr.floor((p - self._origin) * self._scale))
        inside = active & dr.all((cell >= 0) & (cell < _GRIDS[-1]))
        a = dr.abs(n)
        x_longest, y_longest = (a.x >= a.y) & (a.x >= a.z), a.y >= a.z
        axis = dr.select(x_longest, mi.Int32(0), dr.select(y_longest, mi.Int32(1), mi.Int32(2)))
        component = dr.select(x_longest, n.x, dr.select(y_longest, n.y, n.z))
        return cell, 2 * axis + dr.select(component < 0, mi.Int32(1), 0), inside

    def __str__(self) -> str:
        return f"{self.count} regions of surfaces"
