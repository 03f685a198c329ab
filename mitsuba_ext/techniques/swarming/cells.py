"""Cells of the unit interval, square or cube, and densities over them that are drawn by descending
a binary tree.

The cells of a map are the leaves of a complete binary tree. Each of its levels halves the cell
along one axis, so that a one-dimensional map of 64 cells has six levels, and one of 32 x 32 cells
has ten, which take turns. To draw, a number descends along its axis: it goes left where it is below
the probability of the left half, and is stretched to [0, 1) again. Numbers that are stratified stay
so, and the same cells serve counting, estimating and drawing. The cells of a node are consecutive:
its probability is the difference of two entries of a cumulative table.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from .nodes import sums_before

#: Fixed point of probabilities: their sum, with what rounding adds, stays below 2^32.
_ONE = 2.0**31


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
            self.bounds = from_numpy(mi.Float, bounds)

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
        """The coordinate along an axis, at this fraction of a cell."""
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
        mass: The probability of each cell, by table and cell. A cell of no width has none.

    Attributes:
        cells: The cells.
        cumulative: By table and cell, the probability of all cells up to this one, in fixed point:
            equal seeds draw equal numbers.
    """

    def __init__(self, cells: Cells, mass: mi.Float) -> None:
        self.cells = cells
        self.cumulative = sums_before(mi.UInt32(dr.fma(mass, _ONE, 0.5)), cells.count)
        dr.eval(self.cumulative)
        self._widths = from_numpy(mi.Float, cells.widths)

    @property
    def bytes(self) -> int:
        """Memory of the tables."""
        return 4 * len(self.cumulative)

    def sample(
        self, table: mi.UInt32, u: Sequence[mi.Float], active: mi.Bool | bool = True
    ) -> tuple[list[mi.Float], mi.Float, mi.UInt32]:
        """Warps uniform numbers to the density of a table.

        Returns:
            The numbers; their density, relative to uniform ones; their cell. Where not ``active``,
            the numbers are those that were given, of density 1.
        """
        cells, active = self.cells, mi.Bool(active)
        first, half = table * cells.count, cells.count
        total = dr.gather(mi.UInt32, self.cumulative, first + (cells.count - 1), active)
        cell, below, above = mi.UInt32(0), mi.UInt32(0), mi.UInt32(total)
        fraction, index = list(u), [mi.UInt32(0) for _ in range(cells.dimension)]
        for axis in cells.axes:
            half >>= 1
            middle = dr.gather(mi.UInt32, self.cumulative, first + cell + (half - 1), active)
            p = mi.Float(middle - below) / mi.Float(dr.maximum(above - below, 1))
            x = fraction[axis]
            is_left = x < p
            share = dr.select(is_left, p, 1 - p)
            # A half of no probability is not entered: x < 1, and not x < 0
            x = dr.select(is_left, x, x - p) / dr.maximum(share, 1e-20)
            fraction[axis] = dr.clip(x, 0, ONE_MINUS_EPSILON)
            bit = dr.select(is_left, mi.UInt32(0), 1)
            index[axis] = (index[axis] << 1) | bit
            cell += dr.select(is_left, mi.UInt32(0), half)
            below, above = dr.select(is_left, below, middle), dr.select(is_left, middle, above)
        drawn = [
            dr.select(active, cells.place(axis, index[axis], fraction[axis]), u[axis])
            for axis in range(cells.dimension)
        ]
        density = self._relative(above - below, total, cell, active)
        return drawn, dr.select(active, density, 1), cell

    def density(
        self, table: mi.UInt32, cell: mi.UInt32, active: mi.Bool | bool = True
    ) -> mi.Float:
        """The density of the numbers of a cell, relative to uniform ones."""
        first, active = table * self.cells.count, mi.Bool(active)
        total = dr.gather(mi.UInt32, self.cumulative, first + (self.cells.count - 1), active)
        above = dr.gather(mi.UInt32, self.cumulative, first + cell, active)
        below = dr.gather(mi.UInt32, self.cumulative, first + cell - 1, active & (cell > 0))
        return dr.select(active, self._relative(above - below, total, cell, active), 1)

    def _relative(self, mass, total, cell, active) -> mi.Float:
        width = dr.gather(mi.Float, self._widths, cell, active)
        # Cells without width have no mass
        return mi.Float(mass) / dr.maximum(mi.Float(total) * width, 1e-20)
