"""Grows k-d trees over primary samples from the contributions of paths, all trees at once.

The target density of a tree is proportional to the mean contribution of the samples. (The root of
the mean square would give the least variance, but squares of contributions are too noisy to be
learned from few samples.) The shares of the two halves of a cell are estimated from the samples in
them, with a prior: equal shares or, where there is a tree for larger surroundings, the shares of
that tree in the same cell, if it keeps a split there. A cell with too few samples to be split takes
over the splits of that tree.

Samples are sorted by tree and cell once. The sums over the samples of any node are then differences
of running sums. Nodes of the same depth are split together, in all trees. Then, from the leaves up,
splits that change little are removed.

Source: Guo, PhD thesis, section 2.3.4 (mid-point splits, axes in turn); the estimates are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...util.arrays import joined, put
from .cells import CELLS, DEPTH, UNITS, Cells
from .sample_trees import LEAF

#: In samples of equal contribution (effective sample sizes): the least number in a cell that is
#: split, and the weight of the prior.
_SPLIT, _PRIOR = 4.0, 16.0

#: A subtree that changes the mean square of the density by less than this share becomes a leaf.
_LEAST_CHANGE = 0.05

#: In place of the number of a node.
_NONE = 0xFFFFFFFF


@dataclass
class Nodes:
    """The nodes of trees. The first ones are the roots, in the order of the trees.

    Attributes:
        probability, child, is_even: The nodes, as parameters of :class:`SampleTrees`.
    """

    probability: mi.Float
    child: mi.UInt32
    is_even: mi.Bool

    @property
    def count(self) -> int:
        """Number of nodes."""
        return len(self.child)

    def followed_by(self, other: Nodes) -> Nodes:
        """These nodes, then the nodes of other trees."""
        child = other.child + dr.opaque(mi.UInt32, self.count)
        return joined([self, Nodes(other.probability, child, other.is_even)])

    def leaf(self, root: mi.UInt32, code: mi.UInt32) -> mi.UInt32:
        """The leaf, of the tree at ``root``, that contains a cell."""
        node = mi.UInt32(root)
        for depth in range(DEPTH):
            is_inner = dr.gather(mi.Float, self.probability, node) >= 0
            side = (code >> (DEPTH - 1 - depth)) & 1
            node = dr.select(is_inner, dr.gather(mi.UInt32, self.child, node) + side, node)
        return node


def grown(cells: Cells, prior: mi.UInt32, forests: int, whole: int = 0) -> Nodes:
    """Grows trees.

    Parameters:
        cells: The samples, by tree and cell.
        prior: For each tree, the tree that is its prior; its own number if there is none. The last
            tree has no samples.
        forests: The most trees of which each is the prior of the next one.
        whole: The number of trees that come first, with all their cells.
    """
    return _Growth(cells, prior, forests, whole).nodes()


class _Growth:
    """The trees while they grow: the nodes of a depth are split together, whatever their tree."""

    def __init__(self, cells: Cells, prior: mi.UInt32, forests: int, whole: int) -> None:
        self._cells, self._forests = cells, forests
        tree = dr.arange(mi.UInt32, len(prior))
        whole, last, size = (
            dr.opaque(mi.UInt32, x) for x in (whole, len(prior) - 1, len(cells.key))
        )
        self._first_whole = size
        is_whole, place = tree < whole, size + (tree << DEPTH)
        begin = cells.lower_bound(tree << DEPTH, mi.UInt32(0), size)
        dr.eval(begin)
        end = dr.gather(mi.UInt32, begin, dr.minimum(tree + 1, last))
        begin, end = dr.select(is_whole, place, begin), dr.select(is_whole, place + CELLS, end)
        value, square, _weight = self._sums(begin, end)
        roots = _Level(begin, end, tree << DEPTH, _evidence(value, square))
        roots.twin = dr.select(prior == tree, _NONE, prior)
        self._levels = [roots]
        while len(self._levels) <= DEPTH:
            level = self._levels[-1]
            is_split = level.evidence >= _SPLIT
            dr.eval(level.twin, is_split)
            splits = dr.compress(is_split)
            if len(splits) == 0:
                break
            self._levels.append(self._split(level, splits, len(self._levels)))

    def _split(self, level: _Level, splits: mi.UInt32, depth: int) -> _Level:
        """Splits some of the nodes of a level; left and right children alternate in the new one."""
        begin, end, key = (
            dr.gather(mi.UInt32, x, splits) for x in (level.begin, level.end, level.key)
        )
        middle_key = key | dr.opaque(mi.UInt32, 1 << (DEPTH - depth))
        # Where all cells are stored, the middle is known
        is_whole = begin >= self._first_whole
        middle = self._cells.lower_bound(middle_key, begin, dr.select(is_whole, begin, end))
        middle = dr.select(is_whole, (begin + end) >> 1, middle)
        value_l, square_l, weight_l = self._sums(begin, middle)
        value_r, square_r, weight_r = self._sums(middle, end)
        mean_l, mean_r = value_l / dr.maximum(weight_l, 1), value_r / dr.maximum(weight_r, 1)
        found = dr.select(mean_l + mean_r > 0, mean_l / (mean_l + mean_r), 0.5)
        prior = level.source(dr.gather(mi.UInt32, level.twin, splits))
        left, count = 2 * dr.arange(mi.UInt32, len(splits)), 2 * len(splits)
        evidence = dr.gather(mi.Float, level.evidence, splits)
        share = mi.Point2f(found * evidence, _PRIOR) / (evidence + _PRIOR)
        kinds = mi.UInt32, mi.UInt32, mi.UInt32, mi.Float
        new = _Level(*(dr.empty(kind, count) for kind in kinds))
        around = dr.empty(mi.UInt32, count)
        evidence_l, evidence_r = _evidence(value_l, square_l), _evidence(value_r, square_r)
        level.split(splits, left, share, prior)
        for target, of_left, of_right in (
            (new.begin, begin, middle), (new.end, middle, end), (new.key, key, middle_key),
            (new.evidence, evidence_l, evidence_r), (around, prior, prior),
        ):  # fmt: skip
            put(target, of_left, left)
            put(target, of_right, left + 1)
        dr.eval(level.links, level.shares, new.begin, new.end, new.key, new.evidence, around)
        has_twin = around != _NONE
        side = dr.arange(mi.UInt32, new.count) & 1
        twin = level.link(around, has_twin).x + side
        new.twin = dr.select(has_twin, twin, _NONE)
        return new

    def nodes(self) -> Nodes:
        """The nodes, without subtrees that change little."""
        starts = [0]
        for level in self._levels:
            starts.append(starts[-1] + level.count)
        nodes = Nodes(
            dr.full(mi.Float, LEAF, starts[-1]),
            dr.zeros(mi.UInt32, starts[-1]),
            dr.zeros(mi.Bool, starts[-1]),
        )
        # Opaque, also where no tree is split
        dr.make_opaque(nodes)
        parities = [dr.opaque(mi.Bool, is_even) for is_even in (True, False)]
        first_below = dr.opaque(mi.UInt32, starts[-2])
        # Mean square of the density below each node, if it is one on average
        below = None
        for depth, level in reversed(list(enumerate(self._levels[:-1]))):
            if below is None:
                below = dr.full(mi.Float, 1, self._levels[depth + 1].count)
                dr.make_opaque(below)
            node = dr.arange(mi.UInt32, level.count)
            # A node that is not split takes over the split of its twin
            p, new, left = self._settled(level, level.source(node), below)
            is_kept = new > 1 + _LEAST_CHANGE
            first = dr.opaque(mi.UInt32, starts[depth])
            place = node + first
            dr.scatter(nodes.probability, p, place, is_kept)
            dr.scatter(nodes.child, left + first_below, place, is_kept)
            dr.scatter(nodes.is_even, parities[depth % 2], place)
            below, first_below = dr.select(is_kept, new, 1), first
            dr.eval(below, nodes)
        return nodes

    def _settled(
        self, level: _Level, node: mi.UInt32, below: mi.Float
    ) -> tuple[mi.Float, mi.Float, mi.UInt32]:
        """The probability of the left half, the mean square of the density, and the left child of
        nodes that are split. The mean square is 1 where ``node`` is ``_NONE``.

        Parameters:
            below: The mean square below each node of the next depth.
        """
        # The node, its prior, the prior of its prior, and so on
        links, shares = [], []
        for _ in range(self._forests):
            active = node != _NONE
            link = level.link(node, active)
            links.append((active, link.x))
            shares.append(dr.gather(mi.Point2f, level.shares, node, active))
            node = dr.select(active, link.y, _NONE)
        p = mi.Float(0.5)
        for (active, left), share in zip(reversed(links), reversed(shares)):
            p = dr.fma(share.y, p, share.x)
            # The mean squares of both halves
            halves = dr.gather(mi.Point2f, below, left >> 1, active)
            new = 2 * (dr.square(p) * halves.x + dr.square(1 - p) * halves.y)
            new = dr.select(active, new, 1)
            # A prior without this split expects equal shares
            own, p = p, dr.select(new > 1 + _LEAST_CHANGE, p, 0.5)
        return own, new, left

    def _sums(self, begin: mi.UInt32, end: mi.UInt32) -> list[mi.Float]:
        """The sums of values, squares and weights of the cells [begin, end)."""
        found = self._cells.between(begin, end)
        return [mi.Float(mi.Float64(x) / unit) for x, unit in zip(found, UNITS)]


class _Level:
    """The nodes of one depth, in the order of their trees: the ranges of their cells, their keys,
    their effective sample sizes, and their twins: the nodes of the priors for the same cells."""

    def __init__(self, begin, end, key, evidence) -> None:
        self.begin, self.end, self.key, self.evidence = begin, end, key, evidence
        dr.eval(begin, end, key, evidence)
        self.count = len(begin)
        self.twin = mi.UInt32()

    def split(self, splits, first, share, prior) -> None:
        """Splits nodes: sets their left child, the share of the left half among the samples and
        the weight of the prior, and the node that is the prior."""
        # The other nodes are never read
        self.links = dr.empty(mi.UInt32, 2 * self.count)
        self.shares = dr.empty(mi.Float, 2 * self.count)
        for index, (link, x) in enumerate(zip((first, prior), share)):
            put(self.links, link, 2 * splits + index)
            put(self.shares, x, 2 * splits + index)

    def link(self, node: mi.UInt32, active: mi.Bool) -> mi.Vector2u:
        """The left child of a node that is split, and the node that is its prior."""
        return dr.gather(mi.Vector2u, self.links, node, active)

    @dr.syntax
    def source(self, node: mi.UInt32) -> mi.UInt32:
        """The node whose split a node takes: itself if it is split, else its twin, the twin of its
        twin, and so on. ``_NONE`` if none of them is split."""
        node = mi.UInt32(node)
        active = node != _NONE
        while active:
            is_split = dr.gather(mi.Float, self.evidence, node) >= _SPLIT
            node = dr.select(is_split, node, dr.gather(mi.UInt32, self.twin, node))
            active = ~is_split & (node != _NONE)
        return node


def _evidence(value: mi.Float, square: mi.Float) -> mi.Float:
    """The effective sample size: this number of samples of equal contribution is as uncertain."""
    return dr.select(square > 0, dr.square(value) / square, 0)
