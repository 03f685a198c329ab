"""Builds k-d trees over primary samples from the contributions of paths, all trees at once.

The target density of a tree is proportional to the mean contribution of the samples. (The root of
the mean square would give the least variance, but squares of contributions are too noisy to be
learned from few samples.) The shares of the two halves of a cell are estimated from the samples in
them, with a prior: equal shares or, where there is a tree for larger surroundings, the shares of
that tree in the same cell. A cell with too few samples to be split takes over the splits of that
tree.

Source: Guo, PhD thesis, section 2.3.4 (mid-point splits, axes in turn); the estimates are ours.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from ...util.arrays import joined
from ...util.discrete_sampling import first_above
from .sample_trees import LEAF

#: The node of a tree without a split.
UNIFORM = 0

#: The most splits from the root of a tree to a leaf.
DEPTH = 8

#: In samples of equal contribution (effective sample sizes): the least number in a cell that is
#: split, and the weight of the prior.
_SPLIT, _PRIOR = 4.0, 16.0

#: A subtree that changes the mean square of the density by less than this share becomes a leaf.
_LEAST_CHANGE = 0.05

#: Fixed point of contributions, their squares and weights. Sums of integers are exact, so that the
#: same samples give the same trees.
_UNITS = 2.0**20, 2.0**26, 2.0**20

#: Contributions are clipped to this many times their mean. So a sum of squares is at most this
#: times the number of samples, which is less than 2⁶⁴ units.
_LIMIT = 2.0**12


class Samples:
    """Primary samples and the contributions of their paths.

    Parameters:
        code: The cell of each primary sample; see :func:`cell_code`.
        value: Contribution of the path, divided by the density of the sample.
        weight: 1 / density of the sample.
    """

    def __init__(self, code: mi.UInt32, value: mi.Float, weight: mi.Float) -> None:
        self.code, self._value, self._weight = code, value, weight
        # In double precision, so that the order of the samples does not matter. Opaque: other
        # counts share the kernel
        mean = dr.sum(mi.Float64(value)) / dr.opaque(mi.Float64, len(value))
        self._scale = dr.rcp(dr.maximum(mean, 1e-30))

    def in_order(self, tree: mi.UInt32) -> SortedSamples:
        """The samples in the order of their trees, and of their cells in a tree."""
        key = (tree << DEPTH) | self.code
        order = dr.argsort(key)
        key = dr.gather(mi.UInt32, key, order)
        # One after the other: these are the largest arrays
        return SortedSamples(key, [dr.cumsum(x) for x in self._fixed(order)])

    def _fixed(self, order: mi.UInt32) -> Iterator[mi.UInt64]:
        """Values, squares and weights in units, in another order."""
        weight = dr.gather(mi.Float, self._weight, order)
        # The largest of n values is at most n times their mean
        value = mi.Float64(dr.gather(mi.Float, self._value, order)) * self._scale
        value = dr.minimum(value, _LIMIT)
        for x, unit in zip((value, dr.square(value), mi.Float64(weight)), _UNITS):
            yield mi.UInt64(x * unit)


class SortedSamples(Samples):
    """Samples in the order of :attr:`key`.

    Parameters:
        key: The number of the tree of each sample, followed by the bits of its cell.
        running: Running sums of values, squares and weights, in units.
    """

    def __init__(self, key: mi.UInt32, running: list[mi.UInt64]) -> None:
        self.key, self.running = key, running
        self.tree, self.code = key >> DEPTH, key & ((1 << DEPTH) - 1)

    def merged(self) -> SortedSamples:
        """One sample instead of all samples of the same tree and cell."""
        index, count = dr.arange(mi.UInt32, len(self.key)), dr.opaque(mi.UInt32, len(self.key))
        following = dr.gather(mi.UInt32, self.key, index + 1, index + 1 < count)
        last = dr.compress((index + 1 == count) | (self.key != following))
        key, running = dr.gather(mi.UInt32, self.key, last), [
            dr.gather(mi.UInt64, x, last) for x in self.running
        ]
        dr.eval(key, running)
        return SortedSamples(key, running)

    def _fixed(self, order):
        return (sums([x], order, order + 1)[0] for x in self.running)


def sums(running: list[mi.UInt64], begin: mi.UInt32, end: mi.UInt32) -> list[mi.UInt64]:
    """The sums over [begin, end), from running sums."""
    return [
        dr.gather(mi.UInt64, x, end - 1, end > 0) - dr.gather(mi.UInt64, x, begin - 1, begin > 0)
        for x in running
    ]


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


class TreeBuilder:
    """Builds trees, one forest after the other; later ones may refer to earlier ones.

    Attributes:
        probability, child, is_even: The nodes, as parameters of :class:`SampleTrees`.
    """

    def __init__(self) -> None:
        self.probability, self.child, self.is_even = mi.Float(LEAF), mi.UInt32(0), mi.Bool(True)
        # Mean square of the density below each node, if it is one on average
        self._square = mi.Float(1)

    @property
    def node_count(self) -> int:
        return len(self.child)

    def add(
        self,
        samples: Samples,
        tree: mi.UInt32,
        tree_count: int,
        expected: mi.UInt32 | None = None,
    ) -> int:
        """Adds ``tree_count`` trees.

        Parameters:
            samples: The samples from which the trees are built, and possibly others.
            tree: The tree to which each sample belongs; ``tree_count`` or more for none.
            expected: For each tree, the root of the earlier tree that is its prior.

        Returns:
            The node of the first tree; the nodes of the others follow.
        """
        most = dr.opaque(mi.UInt32, tree_count)
        return self.add_sorted(samples.in_order(dr.minimum(tree, most)), 0, tree_count, expected)

    def add_sorted(
        self,
        samples: SortedSamples,
        first: int,
        tree_count: int,
        expected: mi.UInt32 | None = None,
    ) -> int:
        """As :meth:`add`, for samples that have been sorted. The trees have the numbers
        from ``first`` on."""
        first_node, self._sorted = self.node_count, samples
        tree = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, tree_count)
        begin, end = self._lower_bound(tree << DEPTH), self._lower_bound((tree + 1) << DEPTH)
        twin = dr.full(mi.UInt32, UNIFORM, tree_count) if expected is None else expected
        value, square, _weight = self._sums(begin, end)
        levels = [_Level(begin, end, tree << DEPTH, twin, _evidence(value, square))]
        while len(levels) <= DEPTH:
            level = levels[-1]
            splits = dr.compress(level.evidence >= _SPLIT)
            if len(splits) == 0:
                break
            level.first_child = first_node + sum(x.count for x in levels)
            levels.append(self._split(level, splits, len(levels)))
        self._append(levels)
        return first_node

    def leaf(self, root: mi.UInt32, code: mi.UInt32) -> mi.UInt32:
        """The leaf, of the tree at ``root``, that contains a cell."""
        node = mi.UInt32(root)
        for depth in range(DEPTH):
            is_inner = dr.gather(mi.Float, self.probability, node) >= 0
            side = (code >> (DEPTH - 1 - depth)) & 1
            node = dr.select(is_inner, dr.gather(mi.UInt32, self.child, node) + side, node)
        return node

    def _split(self, level: _Level, splits: mi.UInt32, depth: int) -> _Level:
        """Splits some of the nodes of a level; left and right children alternate in the new one."""
        begin, end, code, twin = (
            dr.gather(mi.UInt32, x, splits)
            for x in (level.begin, level.end, level.code, level.twin)
        )
        middle_code = code | dr.opaque(mi.UInt32, 1 << (DEPTH - depth))
        middle = self._lower_bound(middle_code, begin, end)
        value_l, square_l, weight_l = self._sums(begin, middle)
        value_r, square_r, weight_r = self._sums(middle, end)
        evidence_l, evidence_r = _evidence(value_l, square_l), _evidence(value_r, square_r)
        evidence = dr.gather(mi.Float, level.evidence, splits)
        mean_l, mean_r = value_l / dr.maximum(weight_l, 1), value_r / dr.maximum(weight_r, 1)
        found = dr.select(mean_l + mean_r > 0, mean_l / (mean_l + mean_r), 0.5)
        expected = dr.gather(mi.Float, self.probability, twin)
        has_twins = expected >= 0
        expected = dr.select(has_twins, expected, 0.5)
        twins = dr.gather(mi.UInt32, self.child, twin, has_twins)
        level.splits = splits
        level.probability = (evidence * found + _PRIOR * expected) / (evidence + _PRIOR)
        twin_l, twin_r = (dr.select(has_twins, x, twin) for x in (twins, twins + 1))
        # Evaluated together: each of them alone would be a kernel of its own
        dr.eval(
            begin, middle, end, code, middle_code, twin_l, twin_r, evidence_l, evidence_r,
            level.probability,
        )
        return _Level(
            _alternate(begin, middle),
            _alternate(middle, end),
            _alternate(code, middle_code),
            _alternate(twin_l, twin_r),
            _alternate(evidence_l, evidence_r),
        )

    def _lower_bound(self, code, first=None, last=None) -> mi.UInt32:
        """The first sample whose code is not below ``code``."""
        key = self._sorted.key
        if first is None:
            first, last = mi.UInt32(0), dr.opaque(mi.UInt32, len(key))
        # Few numbers of steps, so that fewer kernels are compiled
        longest = 1 << 8 * -(-len(key).bit_length() // 8)
        return first_above(key, first, last, code, mi.Bool(True), longest, reaches=True)

    def _sums(self, begin: mi.UInt32, end: mi.UInt32) -> list[mi.Float]:
        """The sums of values, squares and weights of the samples [begin, end)."""
        found = sums(self._sorted.running, begin, end)
        return [mi.Float(mi.Float64(x) / unit) for x, unit in zip(found, _UNITS)]

    def _append(self, levels: list[_Level]) -> None:
        """Appends the nodes of the new trees, without the splits that hardly change the density."""
        columns, below = [], None
        for depth, level in reversed(list(enumerate(levels))):
            # A node that is not split takes over the splits of its twin
            probability = dr.gather(mi.Float, self.probability, level.twin)
            child = dr.gather(mi.UInt32, self.child, level.twin)
            square = dr.gather(mi.Float, self._square, level.twin)
            dr.eval(probability, child, square)
            if below is not None:
                left = 2 * dr.arange(mi.UInt32, len(level.splits))
                first_child = dr.opaque(mi.UInt32, level.first_child)
                p = level.probability
                new = 2 * (
                    dr.square(p) * dr.gather(mi.Float, below, left)
                    + dr.square(1 - p) * dr.gather(mi.Float, below, left + 1)
                )
                is_kept = new > 1 + _LEAST_CHANGE
                p, new = dr.select(is_kept, p, LEAF), dr.select(is_kept, new, 1)
                dr.scatter(probability, p, level.splits)
                dr.scatter(child, first_child + left, level.splits)
                dr.scatter(square, new, level.splits)
            dr.eval(probability, child, square)
            below = square
            is_even = dr.opaque(mi.Bool, depth % 2 == 0, level.count)
            columns.append((probability, child, is_even, square))
        old = self.probability, self.child, self.is_even, self._square
        self.probability, self.child, self.is_even, self._square = (
            joined([x, *reversed(new)]) for x, new in zip(old, zip(*columns))
        )


class _Level:
    """The nodes of one depth: the range of their samples, their codes, and their twins, which are
    the nodes of the priors for the same cells (or for cells around them)."""

    def __init__(self, begin, end, code, twin, evidence) -> None:
        self.begin, self.end, self.code, self.twin = begin, end, code, twin
        self.evidence = evidence
        # Opaque: levels without twins share the kernels of the others
        dr.make_opaque(twin)
        dr.eval(begin, end, code, twin, evidence)
        self.count = len(begin)
        self.first_child, self.splits, self.probability = 0, mi.UInt32(), mi.Float()


def _evidence(value: mi.Float, square: mi.Float) -> mi.Float:
    """The effective sample size: this number of samples of equal contribution is as uncertain."""
    return dr.select(square > 0, dr.square(value) / square, 0)


def _alternate(a: mi.UInt32, b: mi.UInt32) -> mi.UInt32:
    """a₀, b₀, a₁, b₁, …"""
    index = dr.arange(mi.UInt32, 2 * len(a))
    half, array = index >> 1, type(a)
    return dr.select((index & 1) == 1, dr.gather(array, b, half), dr.gather(array, a, half))
