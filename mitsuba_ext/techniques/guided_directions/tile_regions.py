"""Trees for tiles of the film: the samples of a path's first bounces select the trees of the next.

Source: Guo, PhD thesis, sections 2.3.1 to 2.3.5. One difference: all splits of a bounce are above
those of the next, so that the density of the samples of the first bounces is known after each.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rendering.film_tiles import FilmTiles
from ...util.arrays import from_numpy, joined
from ...util.stored_arrays import StoredArrays
from .cells import DEPTH, Cells
from .path_records import PathRecords
from .sample_trees import SampleTrees
from .tree_builder import Nodes, grown

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

    gives_directions = False

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

    def build(self, records: PathRecords) -> tuple[Nodes, mi.UInt32, mi.UInt32]:
        """Builds the trees.

        The prior of a tile's tree is the tree of the larger tile around it. The prior of a tree
        below a leaf is the tree of all samples of its bounce in the tile.

        Returns:
            The nodes, the roots, and for each leaf the tree below it.
        """
        # A bounce after the first has trees for all tiles, followed by the trees below leaves
        around, levels = self._larger_tiles()
        first_tile, first_below = levels[-1].start, levels[-1].stop
        nodes = None
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
            tile_tree = tile + dr.opaque(mi.UInt32, first_tile)
            parent = from_numpy(mi.UInt32, around)
            if bounce == 0:
                # The tiles' trees are followed by one without splits, for leaves that no path has
                # reached
                cells = Cells.of(code, value, weight, tile_tree, parent, levels)
                prior = from_numpy(mi.UInt32, np.append(around, first_below))
                nodes = grown(cells, prior, len(levels), first_tile)
                roots = dr.arange(mi.UInt32, self.count + 1) + dr.opaque(mi.UInt32, first_tile)
                below = dr.full(mi.UInt32, self.count, nodes.count)
                continue
            tree = tile
            for earlier in range(bounce):
                cell = (history >> (DEPTH * (bounce - 1 - earlier))) & ((1 << DEPTH) - 1)
                leaf = nodes.leaf(dr.gather(mi.UInt32, roots, tree), cell)
                tree = dr.gather(mi.UInt32, below, leaf)
            # Number the leaves that were reached
            is_reached = dr.zeros(mi.UInt32, nodes.count)
            dr.scatter(is_reached, mi.UInt32(1), leaf)
            leaves = dr.compress(is_reached > 0)
            new = dr.arange(mi.UInt32, len(leaves))
            number = dr.zeros(mi.UInt32, nodes.count)
            dr.scatter(number, new, leaves)
            number = dr.gather(mi.UInt32, number, leaf)
            # Neighbouring tiles can share a leaf: either of them can give the prior
            expected = dr.zeros(mi.UInt32, len(leaves))
            dr.scatter_reduce(dr.ReduceOp.Max, expected, tile_tree, number)
            # A sample belongs to two trees
            code, value, weight = (joined([x, x]) for x in (code, value, weight))
            tree = joined([tile_tree, number + dr.opaque(mi.UInt32, first_below)])
            cells = Cells.of(code, value, weight, tree, parent, levels)
            last = dr.opaque(mi.UInt32, first_below + len(leaves), 1)
            prior = joined([parent, expected, last])
            grown_nodes = grown(cells, prior, len(levels) + 1, first_tile)
            dr.scatter(below, new + dr.opaque(mi.UInt32, len(roots)), leaves)
            below = joined([below, dr.full(mi.UInt32, self.count, grown_nodes.count)])
            first_root = dr.opaque(mi.UInt32, nodes.count + first_below)
            roots = joined([roots, new + first_root])
            nodes = nodes.followed_by(grown_nodes)
        return nodes, roots, below

    def _larger_tiles(self) -> tuple[np.ndarray, list[slice]]:
        """Numbers the tiles of all sizes, large ones first.

        Returns:
            For each tile, the larger tile around it (itself if there is none), and the tiles of
            each size.
        """
        row, column = np.divmod(np.arange(self.count, dtype=np.uint32), self._tiles.columns)
        around, levels, larger = [], [], None
        for group in _GROUPS:
            across = -(-self._tiles.columns // group)
            start = levels[-1].stop if levels else 0
            number = start + row // group * across + column // group
            levels.append(slice(start, int(number[-1]) + 1))
            parent = np.arange(start, levels[-1].stop)
            if larger is not None:
                parent[number - start] = larger
            around.append(parent)
            larger = number
        return np.concatenate(around), levels

    def __str__(self) -> str:
        return f"{self.count} tiles of the film"
