"""Trees for tiles of the film: what a path's first samples are decides about the later ones.

Source: Guo, PhD thesis, sections 2.3.1 to 2.3.5. That all splits of a bounce stand above those of
the next is ours: the factors of the bounces used so far are then the density of their samples.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .path_records import PathRecords
from .sample_trees import SampleTrees
from .tree_builder import DEPTH, Samples, TreeBuilder

#: Tiles along each axis that the next larger one has, and how many steps up there are.
_GROUP, _STEPS = 2, 3

#: Bounces of a tree, at most: so many cells fit into a record's history.
MOST_BOUNCES = 1 + 32 // DEPTH


class TileRegions:
    """Square tiles of the film. The tree of a tile has the first bounce's samples on top; below
    each of their leaves stands a tree for the samples of the second, and so on.

    Parameters:
        width, height: Of the film, with its border where that is sampled.
        tile: Edge of a tile in pixels.

    Attributes:
        count: Number of trees.
    """

    def __init__(self, width: int, height: int, tile: int) -> None:
        self._tile = tile
        sizes = [tile * _GROUP**step for step in reversed(range(_STEPS + 1))]
        shapes = [(-(-height // size), -(-width // size)) for size in sizes]
        self._shapes = shapes
        rows, columns = shapes[-1]
        self._tile_count = rows * columns
        self._width, self._size, self._columns = (
            dr.opaque(mi.UInt32, x) for x in (width, tile, columns)
        )
        self._next = mi.UInt32(0)
        self.count = self._tile_count

    # ---- During the walk ----

    def begin(self, pixel: mi.UInt32) -> mi.UInt32:
        """The tree of the first bounce: the tile's."""
        y = pixel // self._width
        return y // self._size * self._columns + (pixel - y * self._width) // self._size

    def tree(self, state: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The tree of a vertex."""
        return state

    def after(self, state: mi.UInt32, leaf: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The tree of the next bounce: the one below the leaf that a sample was drawn from."""
        return dr.select(active, dr.gather(mi.UInt32, self._next, leaf, active), state)

    # ---- What is learned ----

    def label(self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32, active) -> mi.UInt32:
        """The tile by which a sample is recorded."""
        return self.begin(pixel)

    def build(self, records: PathRecords) -> tuple[TreeBuilder, mi.UInt32]:
        """Trees of all tiles, and their roots. A tile expects what larger ones around it found, a
        tree below a leaf what the whole tile found."""
        builder = TreeBuilder()
        roots, leaf_trees = [], []
        leaf = None  # of each sample's predecessor
        for bounce in range(records.bounces):
            chosen = dr.compress(records.bounce == bounce)
            if len(chosen) == 0:
                break
            code, value, weight, tile = (
                dr.gather(type(x), x, chosen)
                for x in (records.code, records.value, records.weight, records.region)
            )
            samples = Samples(code, value, weight)
            first = self._tiles(builder, samples, tile)
            ...
        return builder, roots
