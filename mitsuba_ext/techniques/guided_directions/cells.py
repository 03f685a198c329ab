"""Sums over primary samples, by tree and cell of the unit square."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...util.arrays import put

#: The most splits from the root of a tree to a leaf.
DEPTH = 8

#: The number of the smallest cells.
CELLS = 1 << DEPTH

#: Fixed point of contributions, their squares and weights. Sums of integers are exact, so that the
#: same samples give the same trees.
UNITS = 2.0**20, 2.0**26, 2.0**20

#: Contributions are clipped to this many times their mean. So a sum of squares is at most this
#: times the number of samples, which is less than 2⁶⁴ units.
_LIMIT = 2.0**12


@dataclass
class Cells:
    """Running sums over the cells of some trees, from which the sums over a tree's cells follow.

    Attributes:
        key: Of each cell that has a sample: the number of its tree, followed by the bits of the
            cell; in increasing order.
        value, square, weight: Of contributions, of their squares and of weights, in units: first in
            the order of ``key``, then for all cells of the first trees.
    """

    key: mi.UInt32
    value: mi.UInt64
    square: mi.UInt64
    weight: mi.UInt64

    @property
    def sums(self) -> list[mi.UInt64]:
        """The three running sums."""
        return [self.value, self.square, self.weight]

    @classmethod
    def of(
        cls,
        code: mi.UInt32,
        value: mi.Float,
        weight: mi.Float,
        tree: mi.UInt32,
        parent: mi.UInt32 | None = None,
        levels: Sequence[slice] = (slice(0, 0),),
    ) -> Cells:
        """The cells of primary samples, in their trees and in the trees of their surroundings.

        Parameters:
            code: The cell of each primary sample; see :func:`cell_code`.
            value: Contribution of the path, divided by the density of the sample.
            weight: 1 / density of the sample.
            tree: The smallest tree to which the sample belongs.
            parent: For each tree of a level, the tree of its surroundings, of an earlier level.
            levels: The trees of each level; other trees have no surroundings. All cells are stored
                for all levels except the last one, where few cells of a tree have a sample.
        """
        cells = _cells_of(code, value, weight, tree, levels[-1].start << DEPTH)
        if levels[-1].start > 0:
            cells._surround(parent, levels)
        return cells

    @dr.syntax
    def lower_bound(self, key: mi.UInt32, first: mi.UInt32, last: mi.UInt32) -> mi.UInt32:
        """The first cell of [first, last) whose key is not below ``key``."""
        first, last = mi.UInt32(first), mi.UInt32(last)
        while first < last:
            middle = (first + last) >> 1
            is_below = dr.gather(mi.UInt32, self.key, middle) < key
            first = dr.select(is_below, middle + 1, first)
            last = dr.select(is_below, last, middle)
        return first

    def between(self, begin: mi.UInt32, end: mi.UInt32) -> list[mi.UInt64]:
        """The sums over [begin, end)."""
        return [
            dr.gather(mi.UInt64, x, end - 1, end > 0)
            - dr.gather(mi.UInt64, x, begin - 1, begin > 0)
            for x in self.sums
        ]

    def _surround(self, parent: mi.UInt32, levels: Sequence[slice]) -> None:
        """Sets the running sums of surroundings, from small ones to large ones."""
        rows, trees = (dr.opaque(mi.UInt32, x) for x in (levels[-1].start, levels[-1].stop))
        count = levels[-1].start << DEPTH
        table = [dr.zeros(mi.UInt64, count) for _ in range(3)]

        def around(key: mi.UInt32, active: mi.Bool | bool = True) -> mi.UInt32:
            tree = dr.gather(mi.UInt32, parent, key >> DEPTH, active)
            return (tree << DEPTH) | (key & (CELLS - 1))

        def add(key: mi.UInt32, sums: list[mi.UInt64], active: mi.Bool) -> None:
            for target, x in zip(table, sums):
                dr.scatter_add(target, x, key, active & (x > 0), mode=dr.ReduceMode.Direct)
            dr.eval(table)

        cell, tree = dr.arange(mi.UInt32, len(self.key)), self.key >> DEPTH
        active, sums = tree < trees, self.between(cell, cell + 1)
        add(dr.select(tree < rows, self.key, around(self.key, active)), sums, active)
        for level in reversed(levels[1:-1]):
            if level.start == level.stop:
                continue
            key = dr.arange(mi.UInt32, (level.stop - level.start) << DEPTH)
            key += dr.opaque(mi.UInt32, level.start << DEPTH)
            sums = [dr.gather(mi.UInt64, x, key) for x in table]
            # Read before the table changes
            dr.eval(sums)
            add(around(key), sums, mi.Bool(True))
        del sums
        running = [dr.cumsum(table.pop(0)) for _ in range(3)]
        size = dr.opaque(mi.UInt32, len(self.key))
        before = [dr.gather(mi.UInt64, x, size - 1) for x in self.sums]
        # Read before the sums change: Dr.Jit would copy them
        dr.eval(before)
        place = size + dr.arange(mi.UInt32, count)
        for target, x, y in zip(self.sums, before, running):
            put(target, x + y, place)
        dr.eval(self)


def _cells_of(code, value, weight, tree, more: int) -> Cells:
    """The cells that have samples, with room for the sums of ``more`` cells."""
    # In double precision, so that the order of the samples does not matter. Opaque: other
    # counts share the kernel
    count = dr.opaque(mi.UInt32, len(value))
    scale = dr.rcp(dr.maximum(dr.sum(mi.Float64(value)) / mi.Float64(count), 1e-30))
    key = (tree << DEPTH) | code
    order = dr.argsort(key)
    key = dr.gather(mi.UInt32, key, order)
    # The largest of n values is at most n times their mean
    value = dr.minimum(mi.Float64(dr.gather(mi.Float, value, order)) * scale, _LIMIT)
    weight = mi.Float64(dr.gather(mi.Float, weight, order))
    fixed = [mi.UInt64(x * y) for x, y in zip((value, dr.square(value), weight), UNITS)]
    # The last sample of each cell
    index = dr.arange(mi.UInt32, len(key))
    following = dr.gather(mi.UInt32, key, index + 1, index + 1 < count)
    is_last = (index + 1 == count) | (key != following)
    # Evaluated together: each of them alone would be a kernel of its own
    dr.eval(key, fixed, is_last)
    running = [dr.cumsum(x) for x in fixed]
    last = dr.compress(is_last)
    size, cell = len(last) + more, dr.arange(mi.UInt32, len(last))
    sums = [dr.empty(mi.UInt64, size) for _ in range(3)]
    for target, x in zip(sums, running):
        put(target, dr.gather(mi.UInt64, x, last), cell)
    cells = Cells(dr.gather(mi.UInt32, key, last), *sums)
    dr.eval(cells)
    return cells


def cell_code(u: mi.Point2f) -> mi.UInt32:
    """The number of the smallest cell that contains a sample of [0, 1)². Its first (highest) bit is
    the side of the first split, and so on."""
    cell = mi.Vector2u(u * (1 << DEPTH // 2))
    code = mi.UInt32(0)
    for level in range(DEPTH):
        axis, bit = level % 2, DEPTH // 2 - 1 - level // 2
        code = (code << 1) | ((cell[axis] >> bit) & 1)
    return code


def cell_centre(code: mi.UInt32) -> mi.Point2f:
    """The middle of a cell."""
    u = mi.Point2f(2.0 ** -(DEPTH // 2 + 1))
    for level in range(DEPTH):
        bit = (code >> (DEPTH - 1 - level)) & 1
        u[level % 2] += dr.select(bit == 1, 0.5 ** (level // 2 + 1), 0.0)
    return u
