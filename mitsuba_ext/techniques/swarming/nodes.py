"""Nodes of many equal binary trees over cells, evaluated all at once.

The cells of a node are consecutive, so that its sum is the difference of two prefix sums.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def sums_before(values: mi.Float | mi.UInt32, cells: int) -> mi.Float | mi.UInt32:
    """By table and cell, the sum over all cells up to and including this one."""
    return dr.block_prefix_reduce(dr.ReduceOp.Add, values, cells, exclusive=False)


class Nodes:
    """One lane for each inner node of each tree: in the tree of a table, node 1 is the root, and
    2 n and 2 n + 1 are the halves of n. Lane 0 of a table is no node.

    Parameters:
        tables: Number of trees.
        cells: Leaves of each, a power of two.

    Attributes:
        cells: See above.
        table: The table of each lane.
        exist: Whether the lane is a node.
    """

    def __init__(self, tables: int, cells: int) -> None:
        self._tables, self.cells = tables, cells
        self._depth = cells.bit_length() - 1
        lane = dr.arange(mi.UInt32, tables * cells)
        self.table = lane // cells
        node = lane & (cells - 1)
        self.exist = node > 0
        node = dr.maximum(node, 1)
        self._base = self.table * cells
        shift = self._depth - (31 - dr.lzcnt(node))
        self._begin = (node << shift) - cells
        self._half = 1 << (shift - 1)

    def left_share(self, before: mi.Float) -> tuple[mi.Float, mi.Float]:
        """The share of the left half in the sum of each node (1/2 where it is 0), and this sum.

        Parameters:
            before: :func:`sums_before` of the values of cells.
        """
        begin, middle, end = (
            _sum_at(before, self._base, self._begin + k * self._half) for k in range(3)
        )
        # Sums of floats need not increase
        both = dr.maximum(end - begin, 0)
        share = dr.clip((middle - begin) / dr.select(both > 0, both, 1), 0, 1)
        return dr.select(both > 0, share, 0.5), both

    def masses(self, left: mi.Float) -> mi.Float:
        """By table and cell, the product of the shares on the way from the root to the cell;
        ``left`` is the one of the left half of each node."""
        dr.eval(left)
        lane = dr.arange(mi.UInt32, self._tables * self.cells)
        leaf = (lane & (self.cells - 1)) + self.cells
        base, mass = lane & ~mi.UInt32(self.cells - 1), mi.Float(1)
        for level in range(self._depth):
            p = dr.gather(mi.Float, left, base + (leaf >> (self._depth - level)))
            is_right = ((leaf >> (self._depth - 1 - level)) & 1) == 1
            mass *= dr.select(is_right, 1 - p, p)
        return mass


def _sum_at(before: mi.Float, base: mi.UInt32, cell: mi.UInt32) -> mi.Float:
    """The sum over the cells of a table before this one."""
    return dr.gather(mi.Float, before, base + cell - 1, cell > 0)
