"""Trees for tiles of the film: the samples of a path's first bounces select the trees of the next.

Source: Guo, PhD thesis, sections 2.3.1 to 2.3.5. One difference: all splits of a bounce are above
those of the next, so that the density of the samples of the first bounces is known after each.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rendering.film_tiles import FilmTiles
from ...util.arrays import joined
from ...util.stored_arrays import StoredArrays
from .path_records import PathRecords
from .sample_trees import SampleTrees
from .tree_builder import DEPTH, UNIFORM, Samples, TreeBuilder

#: Edges, in tiles, of the larger tiles whose trees are the priors of the smaller ones.
_GROUPS = (8, 4, 2, 1)

#: The most directions that a tree chooses: a record's history has room for all cells but the last.
MOST_BOUNCES = 1 + 32 // DEPTH


class TileRegions:
    """Square tiles of the film. The tree of a tile first splits the sample of the first bounce.
    Below each leaf of these splits stands a tree for the sample of the second bounce, and so on.

    Parameters:
        width, height: Size of the film in pixels, with its border where that is sampled.
        tile: Edge of a tile in pixels.

    Attributes:
        count: Number of tiles.
    """

    def __init__(self, width: int, height: int, tile: int) -> None:
        self._tiles = FilmTiles(width, height, tile)
        self.count = self._tiles.count

    def state(self) -> dict[str, np.ndarray]:
        """The arrays that depend on the pilots: none."""
        return {}

    def restore(self, state: StoredArrays) -> None:
        """Restores the result of :meth:`state`: nothing to do."""

    @property
    def tree_count(self) -> int:
        """Number of trees of first bounces."""
        return self.count

    # ---- During the walk ----

    def begin(self, pixel: mi.UInt32) -> mi.UInt32:
        """The tree of the first bounce: the tile's."""
        return self._tiles.tile(pixel)

    def tree(self, state: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The tree of a vertex."""
        return state

    def after(
        self, state: mi.UInt32, trees: SampleTrees, leaf: mi.UInt32, active: mi.Bool
    ) -> mi.UInt32:
        """The tree of the next bounce: the one below the leaf that a sample was drawn from."""
        return dr.select(active, trees.value(leaf, active), state)

    # ---- What is learned ----

    def label(self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The tile under which a sample is recorded."""
        return self.begin(pixel)

    def build(self, records: PathRecords) -> tuple[TreeBuilder, mi.UInt32, mi.UInt32]:
        """Builds the trees.

        The prior of a tile's tree is the tree of the larger tile around it. The prior of a tree
        below a leaf is the tree of all samples of its bounce in the tile.

        Returns:
            The builder, the roots, and for each leaf the tree below it.
        """
        builder = TreeBuilder()
        # The tiles' trees are followed by one without splits, for leaves that no path has reached
        roots, below, tree_count = [], [dr.full(mi.UInt32, self.count, 1)], self.count + 1
        for bounce in range(records.bounces):
            chosen = dr.compress(records.bounce == bounce)
            if len(chosen) == 0:
                break
            code, value, weight, tile, history = (
                dr.gather(type(x), x, chosen)
                for x in (
                    records.code, records.value, records.weight, records.region, records.history
                )
            )
            samples = Samples(code, value, weight)
            tiles = self._add_tiles(builder, samples, tile)
            if bounce == 0:
                roots += [tiles, dr.full(mi.UInt32, UNIFORM, 1)]
                below.append(dr.full(mi.UInt32, self.count, builder.node_count - 1))
                continue
            all_roots, all_below = joined(roots), joined(below)
            tree = tile
            for earlier in range(bounce):
                cell = (history >> (DEPTH * (bounce - 1 - earlier))) & ((1 << DEPTH) - 1)
                leaf = builder.leaf(dr.gather(mi.UInt32, all_roots, tree), cell)
                tree = dr.gather(mi.UInt32, all_below, leaf)
            # Number the leaves that were reached
            is_reached = dr.zeros(mi.UInt32, len(all_below))
            dr.scatter(is_reached, mi.UInt32(1), leaf)
            leaves = dr.compress(is_reached > 0)
            number = dr.zeros(mi.UInt32, len(all_below))
            dr.scatter(number, dr.arange(mi.UInt32, len(leaves)), leaves)
            number = dr.gather(mi.UInt32, number, leaf)
            # Neighbouring tiles can share a leaf: either of them can give the prior
            expected = dr.zeros(mi.UInt32, len(leaves))
            dr.scatter_reduce(
                dr.ReduceOp.Max, expected, dr.gather(mi.UInt32, tiles, tile), number
            )
            first = builder.add(samples, number, len(leaves), expected)
            roots.append(dr.arange(mi.UInt32, len(leaves)) + dr.opaque(mi.UInt32, first))
            first_tree = dr.opaque(mi.UInt32, tree_count)
            dr.scatter(all_below, first_tree + dr.arange(mi.UInt32, len(leaves)), leaves)
            new_nodes = builder.node_count - len(all_below)
            below = [all_below, dr.full(mi.UInt32, self.count, new_nodes)]
            tree_count += len(leaves)
        return builder, joined(roots), joined(below)

    def _add_tiles(self, builder: TreeBuilder, samples: Samples, tile: mi.UInt32) -> mi.UInt32:
        """Adds the trees of all tiles, large tiles first; returns the roots of the small
        ones."""
        row, column = np.divmod(np.arange(self.count, dtype=np.uint32), self._tiles.columns)
        number, roots = np.zeros(self.count, np.uint32), None
        for group in _GROUPS:
            across = -(-self._tiles.columns // group)
            new = (row // group * across + column // group).astype(np.uint32)
            size = int(new[-1]) + 1
            if roots is not None:
                # The root of the larger tile around each of the new ones
                around = np.zeros(size, np.uint32)
                around[new] = number
                roots = dr.gather(mi.UInt32, roots, mi.UInt32(around))
            first = builder.add(samples, dr.gather(mi.UInt32, mi.UInt32(new), tile), size, roots)
            roots = dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, first)
            number = new
        return roots

    def __str__(self) -> str:
        return f"{self.count} tiles of the film"
