"""Trees for regions of surfaces and, apart from them, for regions of participating media.

The trees of surfaces are over the primary samples of BSDFs, whose directions depend little on where
a path comes from. Phase functions scatter relative to the direction of the path, so that a primary
sample would stand for other directions in each path. The trees of media are therefore over
directions in space. Since a phase function turns uniform primary samples into directions of the
density ``p``, a direction that is drawn with the density ``q`` is a primary sample of the density
``q / p``: weights, estimates of gains and MIS weights are the same as on surfaces.

Sources: S. Herholz et al., *Volume Path Guiding Based on Zero-Variance Random Walk Theory*, ACM
Transactions on Graphics 38(3), 2019, section 5.2 (directions, by regions of space; there with
lobes, and multiplied by the phase function).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.regions.nested_regions import NestedRegions
from ...util.arrays import joined
from ...util.stored_arrays import StoredArrays
from .path_records import PathRecords, Samples
from .sample_trees import LEAF, SampleTrees
from .surface_regions import SurfaceRegions
from .tree_builder import Nodes

#: In the names of stored arrays.
_MEDIA = "media_"


class RegionsWithMedia:
    """Regions of surfaces, followed by regions of media.

    Parameters:
        p, n: Vertices where paths scatter, and normals on the side that is lit, which are zero in
            media.
        least: The least number of these vertices in a region.
        most: The most regions.
    """

    gives_directions = True

    def __init__(
        self, p: mi.Point3f, n: mi.Normal3f, least: float, most: int = 1 << 30
    ) -> None:
        in_medium, most = dr.all(n == 0), max(1, most // 2)
        self._surfaces, self._media = (
            SurfaceRegions(*_chosen(p, n, chosen), least, most)
            for chosen in (~in_medium, in_medium)
        )
        self._number()

    def _number(self) -> None:
        self._first = dr.opaque(mi.UInt32, self._surfaces.tree_count)

    def state(self) -> dict[str, np.ndarray]:
        """What the walk needs of the regions, as arrays."""
        media = {_MEDIA + name: array for name, array in self._media.state().items()}
        return {**self._surfaces.state(), **media}

    def restore(self, state: StoredArrays) -> None:
        """Restores the regions from the arrays of :meth:`state`."""
        self._surfaces.restore(state)
        self._media.restore(state.part(_MEDIA))
        self._number()

    @property
    def tree_count(self) -> int:
        """Number of trees."""
        return self._surfaces.tree_count + self._media.tree_count

    # ---- During the walk ----

    def begin(self, pixel: mi.UInt32 | None) -> None:
        """There is no state."""
        return None

    def tree(self, state: None, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The tree of the smallest region that contains a vertex."""
        return self.label(si, None, active)

    def after(self, state: None, trees: SampleTrees, leaf: mi.UInt32, active: mi.Bool) -> None:
        """The state after a sample was drawn from a leaf."""
        return state

    # ---- What is learned ----

    def label(self, si: mi.SurfaceInteraction3f, pixel, active: mi.Bool) -> mi.UInt32:
        """The region under which a sample is recorded."""
        in_medium = active & si.is_valid() & (si.shape == None)  # noqa: E711
        on_surface = self._surfaces.label(si, pixel, active & ~in_medium)
        region = self._media.number(si.p, mi.Normal3f(0), in_medium) + self._first
        return dr.select(in_medium, region, on_surface)

    @property
    def media(self) -> NestedRegions:
        """The regions of media; their numbers follow those of surfaces."""
        return self._media.regions

    def of_media(self, p: mi.Point3f) -> mi.UInt32:
        """The region of media that contains a point."""
        return self._media.number(p, mi.Normal3f(0), mi.Bool(True)) + self._first

    def build(self, records: PathRecords) -> tuple[Nodes, mi.UInt32, None]:
        """See :meth:`SurfaceRegions.build`."""
        on_surfaces, in_media = self._divided(records)
        nodes, root = _built(self._surfaces, on_surfaces)
        others, other = _built(self._media, in_media)
        root = joined([root, other + dr.opaque(mi.UInt32, nodes.count)])
        return nodes.followed_by(others), root, None

    def incident_radiance(self, records: PathRecords) -> mi.Float:
        """See :meth:`SurfaceRegions.incident_radiance`."""
        divided = zip((self._surfaces, self._media), self._divided(records))
        return joined([
            regions.incident_radiance(samples) if len(samples.region)
            else dr.full(mi.Float, -1, regions.tree_count)
            for regions, samples in divided
        ])  # fmt: skip

    def _divided(self, records: PathRecords) -> tuple[Samples, Samples]:
        """The samples on surfaces and in media; the weights of the latter are 1 / density of their
        directions."""
        on_surfaces = records.chosen(records.region < self._first)
        in_media = records.chosen(records.region >= self._first)
        if len(in_media.region):  # Dr.Jit subtracts nothing from an empty array
            in_media.region -= self._first
            in_media.weight *= in_media.measure
        return on_surfaces, in_media

    def __str__(self) -> str:
        return f"{self._surfaces} and {self._media.count} of media"


def _chosen(
    p: mi.Point3f, n: mi.Normal3f, chosen: mi.Bool
) -> tuple[mi.Point3f, mi.Normal3f]:
    """The chosen vertices; any one if there is none, which makes a region of everything."""
    index = dr.compress(chosen)
    if len(index) == 0:
        return mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1)
    return dr.gather(mi.Point3f, p, index), dr.gather(mi.Normal3f, n, index)


def _built(regions: SurfaceRegions, samples: Samples) -> tuple[Nodes, mi.UInt32]:
    """Nodes, and the roots of the trees; leaves only if there are no samples."""
    if len(samples.region):
        return regions.build(samples)[:2]
    count = regions.tree_count
    leaf = dr.full(mi.Float, LEAF, count)
    nodes = Nodes(leaf, dr.zeros(mi.UInt32, count), dr.full(mi.Bool, True, count))
    return nodes, dr.arange(mi.UInt32, count)
