"""Cells of the unit interval, square or cube, and densities over them that are drawn by descending
a binary tree.

The cells of a map are the leaves of a complete binary tree. Each of its levels halves the cell
along one axis, so that a one-dimensional map of 64 cells has six levels, and one of 32 x 32 cells
has ten, which take turns. To draw, a number descends along its axis: it goes left where it is below
the probability of the left half, and is stretched to [0, 1) again. Numbers that are stratified stay
so, and the same cells serve counting, estimating and drawing.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...discrete_sampling import ONE_MINUS_EPSILON


class Cells:
    """The cells of a map.

    Parameters:
        axes: The axis that each level of the tree halves, from the root.
        bounds: Where the cells along axis 0 begin and end, increasing from 0 to 1; evenly spaced by
            default. Two may coincide: nothing is drawn from a cell without width.

    Attributes:
        dimension: Numbers that a sample has.
        count: Number of cells.
        widths: The volume of each cell: the probability that uniform numbers fall into it.
    """

    def __init__(self, axes: Sequence[int], bounds: np.ndarray | None = None) -> None:
        self.axes = tuple(axes)
        self.dimension, self.count = max(self.axes) + 1, 1 << len(self.axes)
        self._bits = [self.axes.count(axis) for axis in range(self.dimension)]
        self.bounds: mi.Float | None = None
        index = np.zeros(self.count, np.int64)
        for level, axis in enumerate(self.axes):
            if axis == 0:
                index = 2 * index + (np.arange(self.count) >> (len(self.axes) - 1 - level) & 1)
        if bounds is None:
            self.widths = np.full(self.count, 1 / self.count)
        else:
            bounds = np.asarray(bounds, np.float32)
            widths = np.diff(bounds.astype(np.float64))[index]
            self.widths = widths / widths.sum()
            self.bounds = mi.Float(bounds)

    @classmethod
    def line(cls, bits: int) -> Cells:
        """2^bits cells of the unit interval."""
        return cls([0] * bits)

    @classmethod
    def square(cls, bits: int) -> Cells:
        """2^bits x 2^bits cells of the unit square."""
        return cls([0, 1] * bits)

    def find(self, u: Sequence[mi.Float]) -> mi.UInt32:
        """The cell in which a point lies."""
        index = [self._index(axis, u[axis]) for axis in range(self.dimension)]
        left, cell = list(self._bits), mi.UInt32(0)
        for axis in self.axes:
            left[axis] -= 1
            cell = (cell << 1) | ((index[axis] >> left[axis]) & 1)
        return cell

    def _index(self, axis: int, u: mi.Float) -> mi.UInt32:
        """The number of the cell along one axis."""
        count = 1 << self._bits[axis]
        if axis > 0 or self.bounds is None:
            return dr.minimum(mi.UInt32(u * count), count - 1)
        index = mi.UInt32(0)
        for bit in reversed(range(self._bits[axis])):
            above = index | (1 << bit)
            index = dr.select(u >= dr.gather(mi.Float, self.bounds, above), above, index)
        return index

    def place(self, axis: int, index: mi.UInt32, fraction: mi.Float) -> mi.Float:
        """The number along an axis, at this fraction of a cell."""
        if axis > 0 or self.bounds is None:
            u = (mi.Float(index) + fraction) * (0.5 ** self._bits[axis])
        else:
            begin, end = (dr.gather(mi.Float, self.bounds, index + i) for i in (0, 1))
            u = dr.lerp(begin, end, fraction)
        return dr.minimum(u, ONE_MINUS_EPSILON)


class CellDensities:
    """Densities over the same cells, one for each table.

    Parameters:
        cells: The cells.
        mass: The probability of each cell, [table, cell]. A cell of no width has none.

    Attributes:
        cells: The cells.
        splits: The probability of the left half at each node of each tree: node 1 is the root, and
            2 n and 2 n + 1 are the halves of n. Entry 0 of a table is not used.
    """

    def __init__(self, cells: Cells, mass: np.ndarray) -> None:
        self.cells = cells
        self.splits = mi.Float(splits_of(mass).ravel())
        self._widths = mi.Float(cells.widths.astype(np.float32))

    @property
    def bytes(self) -> int:
        """Memory of the tables."""
        return 4 * len(self.splits)

    def sample(
        self, table: mi.UInt32, u: Sequence[mi.Float], active: mi.Bool | bool = True
    ) -> tuple[list[mi.Float], mi.Float, mi.UInt32]:
        """Turns uniform numbers into those of a table.

        Returns:
            The numbers; their density, relative to uniform ones; their cell. Where not ``active``,
            the numbers are those that were given, of density 1.
        """
        cells, active = self.cells, mi.Bool(active)
        first, node, mass = table * cells.count, mi.UInt32(1), mi.Float(1)
        fraction, index = list(u), [mi.UInt32(0) for _ in range(cells.dimension)]
        for axis in cells.axes:
            p = dr.gather(mi.Float, self.splits, first + node, active)
            x = fraction[axis]
            is_left = x < p
            share = dr.select(is_left, p, 1 - p)
            # A half of no probability is not entered: x < 1, and not x < 0
            x = dr.select(is_left, x, x - p) / dr.maximum(share, 1e-20)
            fraction[axis] = dr.clip(x, 0, ONE_MINUS_EPSILON)
            mass *= share
            bit = dr.select(is_left, mi.UInt32(0), 1)
            node, index[axis] = (node << 1) | bit, (index[axis] << 1) | bit
        cell = node - cells.count
        drawn = [
            dr.select(active, cells.place(axis, index[axis], fraction[axis]), u[axis])
            for axis in range(cells.dimension)
        ]
        density = mass / dr.gather(mi.Float, self._widths, cell, active)
        return drawn, dr.select(active, density, 1), cell

    def density(
        self, table: mi.UInt32, cell: mi.UInt32, active: mi.Bool | bool = True
    ) -> mi.Float:
        """The density of the numbers of a cell, relative to uniform ones."""
        cells, mass = self.cells, mi.Float(1)
        first, leaf, depth = table * cells.count, cell + cells.count, len(cells.axes)
        for level in range(depth):
            p = dr.gather(mi.Float, self.splits, first + (leaf >> (depth - level)), active)
            is_right = ((leaf >> (depth - 1 - level)) & 1) == 1
            mass *= dr.select(is_right, 1 - p, p)
        return mass / dr.gather(mi.Float, self._widths, cell, active)


def splits_of(mass: np.ndarray) -> np.ndarray:
    """``CellDensities.splits`` of probabilities, [table, cell]."""
    splits = np.ones(mass.shape, np.float32)
    while mass.shape[1] > 1:
        left = mass[:, 0::2]
        mass = left + mass[:, 1::2]
        # What is never reached may be anything
        splits[:, mass.shape[1] : 2 * mass.shape[1]] = left / np.maximum(mass, 1e-30)
    return splits
