"""Trees for regions of surfaces: paths that scatter in the same region share a tree."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.regions.nested_regions import NestedRegions
from ...scene.regions.surface_voxels import lit_normal
from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays
from .cells import Cells
from .path_records import Samples
from .sample_trees import SampleTrees
from .tree_builder import Nodes, grown

#: About the most bytes of a region while trees are built: all cells are stored for the regions in
#: which there are smaller ones.
BYTES_PER_REGION = 1 << 14

#: The weight, in samples, of the surrounding region as the prior of a region's mean radiance.
_PRIOR = 32

#: Units of sums over the records of a region, per mean of all records.
_UNITS = 2.0**20


class SurfaceRegions:
    """A tree for each of some regions of surfaces (:class:`NestedRegions`).

    The last number stands for mirrors and glass, whose directions do not depend on the sample: its
    tree has no splits. At each bounce, a path uses the tree of the region in which it scatters.

    Parameters:
        p, n: Vertices where paths scatter, and normals on the side that is lit; not empty.
        least: The least number of these vertices in a region.
        most: The most regions.

    Attributes:
        regions: The regions that learn.
        count: Their number.
        gives_directions: Whether samples in media are points of directions
            (:class:`~mitsuba_ext.transport.path_decisions.DirectionSamples`).
    """

    gives_directions = False

    def __init__(
        self, p: mi.Point3f, n: mi.Normal3f, least: float, most: int = 1 << 30
    ) -> None:
        self._set(NestedRegions(p, n, least, most))

    def _set(self, regions: NestedRegions) -> None:
        self.regions, self.count = regions, regions.count
        self._specular = dr.opaque(mi.UInt32, self.count)

    def state(self) -> dict[str, np.ndarray]:
        """What the walk needs of the regions, as arrays."""
        return self.regions.state()

    def restore(self, state: StoredArrays) -> None:
        """Restores the regions from the arrays of :meth:`state`."""
        self._set(NestedRegions.of_state(state))

    @property
    def tree_count(self) -> int:
        """Number of trees: one more than there are regions, for mirrors and glass."""
        return self.count + 1

    # ---- During the walk ----

    def begin(self, pixel: mi.UInt32 | None) -> None:
        """There is no state."""
        return None

    def tree(self, state: None, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The tree of the smallest region that contains a vertex."""
        return self.label(si, None, active)

    def after(
        self, state: tuple, trees: SampleTrees, leaf: mi.UInt32, active: mi.Bool
    ) -> tuple:
        """The state after a sample was drawn from a leaf."""
        return state

    # ---- What is learned ----

    def label(self, si: mi.SurfaceInteraction3f, pixel, active: mi.Bool) -> mi.UInt32:
        """The region under which a sample is recorded."""
        region = self.number(si.p, lit_normal(si), active)
        is_smooth = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        return dr.select(is_smooth, region, self._specular)

    def number(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> mi.UInt32:
        """The smallest region that contains a point with the normal ``n`` on its lit side."""
        return self.regions.number(p, n, active)

    def build(self, records: Samples) -> tuple[Nodes, mi.UInt32, None]:
        """Builds the trees.

        Returns:
            The nodes, the root of each region's tree, and ``None``: leaves do not lead to other
            trees. The tree of the surrounding region is the prior of a region's tree.
        """
        parent = self._parents()
        levels, tree = self.regions.levels, records.region
        cells = Cells.of(records.code, records.value, records.weight, tree, parent, levels)
        nodes = grown(cells, parent, len(levels), levels[-1].start)
        return nodes, dr.arange(mi.UInt32, self.count + 1), None

    def _parents(self) -> mi.UInt32:
        """For each region, the one around it; mirrors and glass have none."""
        return from_numpy(mi.UInt32, np.append(self.regions.parent, self.count))

    def incident_radiance(self, records: Samples) -> mi.Float:
        """The mean radiance that bounces find in each region; the surrounding region is the prior.
        −1 for mirrors and glass. Shape [regions]."""
        value, throughput, count = self._sums(records)
        for regions in reversed(self.regions.levels[1:]):
            for x in (value, throughput, count):
                np.add.at(x, self.regions.parent[regions], x[regions])
        radiance = np.full(self.count + 1, -1.0)
        for level, regions in enumerate(self.regions.levels):
            prior, expected = 0.0, 0.0
            if level > 0:
                prior = _PRIOR * throughput[regions] / np.maximum(count[regions], 1)
                expected = radiance[self.regions.parent[regions]]
            radiance[regions] = (value[regions] + prior * expected) / np.maximum(
                throughput[regions] + prior, 1e-30
            )
        return from_numpy(mi.Float, np.minimum(radiance, 1e30))

    def _sums(self, records: Samples) -> np.ndarray:
        """The sums of values and throughputs, and the number of records, in each region."""
        values = records.value, records.throughput
        # In units relative to the mean: sums of integers do not depend on their order
        count = dr.opaque(mi.Float64, len(records.region))
        means = [dr.maximum(dr.sum(mi.Float64(x)) / count, 1e-30) for x in values]
        units = [mi.UInt64(mi.Float64(x) / mean * _UNITS + 0.5) for x, mean in zip(values, means)]
        sums = dr.zeros(mi.UInt64, 3 * (self.count + 1))
        for index, x in enumerate((*units, mi.UInt64(1))):
            place = 3 * records.region + index
            dr.scatter_add(sums, x, place, x > 0, mode=dr.ReduceMode.Direct)
        dr.eval(sums, means)
        unit = [float(mean[0]) / _UNITS for mean in means]
        return sums.numpy().reshape(-1, 3).T * np.array([*unit, 1.0])[:, None]

    def __str__(self) -> str:
        return f"{self.count} regions of surfaces"
