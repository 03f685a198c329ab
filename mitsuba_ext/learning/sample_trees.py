"""k-d trees over the unit square, from which pairs of primary samples are drawn.

Source: Guo, PhD thesis, sections 2.3.3 (structure) and 2.3.5 (sampling, Eqs. 2.7 to 2.11).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: What a leaf has in the place of a probability.
LEAF = -1.0

#: Bits of a probability in a packed node. The density is that of the rounded probabilities.
_BITS = 9
_ONE = 1 << _BITS

_ALMOST_ONE = 1 - 2.0**-24


class SampleTrees:
    """Many k-d trees in flat arrays. Cells are split at their middle, the first axis first, then
    the axes in turn. A tree stands for a piecewise constant density, which is mixed with a
    constant one: whatever the tree says, the density is at least 1 − ``share``.

    The two coordinates of a sample are stretched on the way down, and no other random numbers are
    drawn: strata of a sampler remain strata, and a tree that is a single leaf changes nothing.

    A split along the first axis and the two below it are packed into a node of eight bytes: three
    probabilities, which of the four children are leaves, and where these stand.

    Parameters:
        probability: Of each binary node's left child; ``LEAF`` for a leaf. Shape [nodes].
        child: The left child's number; the right one follows it. Shape [nodes].
        is_even: Is the node split along the first axis? Shape [nodes].
        root: The first node of each tree; it is split along the first axis, or a leaf. [trees].
        share: The share of the samples that a tree decides, in [0, 1]; shape [trees].

    Attributes:
        leaf_count (int): An upper bound of the numbers that name leaves.
    """

    def __init__(
        self,
        probability: mi.Float,
        child: mi.UInt32,
        is_even: mi.Bool,
        root: mi.UInt32,
        share: mi.Float,
    ) -> None:
        # A node's children take a block of four
        inner = dr.compress(is_even & (probability >= 0))
        block = dr.zeros(mi.UInt32, len(probability))
        # Opaque: trees of other sizes share the kernels
        first = dr.opaque(mi.UInt32, len(root))
        dr.scatter(block, first + 4 * dr.arange(mi.UInt32, len(inner)), inner)
        bits, grandchildren = _pack(probability, child)
        dr.eval(block, bits, grandchildren)

        self.leaf_count = len(root) + 4 * len(inner)
        nodes = dr.zeros(mi.Float, 2 * self.leaf_count)
        _write(nodes, dr.arange(mi.UInt32, len(root)), bits, block, root, mi.Bool(True))
        for index, (node, exists) in enumerate(grandchildren):
            slot = dr.gather(mi.UInt32, block, inner) + index
            node, exists = dr.gather(mi.UInt32, node, inner), dr.gather(mi.Bool, exists, inner)
            _write(nodes, slot, bits, block, node, exists)
        is_leaf = dr.gather(mi.Float, probability, root) < 0
        self._nodes = nodes
        # Nothing is read of a tree without a split
        self._share = dr.select(is_leaf, 0, share)
        dr.eval(self._nodes, self._share)

    @property
    def bytes(self) -> int:
        """Memory that the trees take."""
        return 4 * (len(self._nodes) + len(self._share))

    def sample(
        self, tree: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float, mi.UInt32]:
        """Warps uniform numbers.

        Returns:
            The sample in [0, 1)², its density, and the number of its leaf. In inactive lanes they
            are ``u``, 1 and the tree's number.
        """
        share = dr.gather(mi.Float, self._share, tree, active)
        by_tree = u.x < share
        # The number that chose between the two densities is as good as new in its part
        x = dr.select(by_tree, u.x / share, (u.x - share) / (1 - share))
        active = active & (share > 0)
        x = dr.select(active, dr.minimum(x, _ALMOST_ONE), u.x)
        point, density, leaf = self._descend(tree, mi.Point2f(x, u.y), by_tree, active)
        return point, dr.fma(share, density - 1, 1), leaf

    def density(
        self, tree: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Float, mi.UInt32]:
        """The density of a sample, and the number of its leaf."""
        share = dr.gather(mi.Float, self._share, tree, active)
        _point, density, leaf = self._descend(tree, u, mi.Bool(False), active & (share > 0))
        return dr.fma(share, density - 1, 1), leaf

    @dr.syntax
    def _descend(
        self, root: mi.UInt32, u: mi.Point2f, by_tree: mi.Bool, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float, mi.UInt32]:
        """Goes down to a leaf: by the probabilities, or to the one in which ``u`` lies."""
        x, y = mi.Float(u.x), mi.Float(u.y)     # Where the sample lies in its cell,
        column, row = mi.UInt32(0), mi.UInt32(0)  # which of the cells of this size that is,
        edge = mi.Float(1)                      # and how long its edges are
        density = mi.Float(1)
        node = mi.UInt32(root)
        active = mi.Bool(active)
        while active:
            packed = dr.reinterpret_array(
                mi.Point2u, dr.gather(mi.Point2f, self._nodes, node, active)
            )
            x, is_right, p = _choose(x, packed.x, by_tree)
            y, is_upper, q = _choose(
                y, packed.x >> dr.select(is_right, mi.UInt32(2 * _BITS), _BITS), by_tree
            )
            density *= 4 * p * q
            side = dr.select(is_right, mi.UInt32(2), 0) + dr.select(is_upper, mi.UInt32(1), 0)
            column = 2 * column + (side >> 1)
            row = 2 * row + (side & 1)
            edge *= 0.5
            node = packed.y + side
            active &= ((packed.x >> (3 * _BITS + side)) & 1) == 0
        point = mi.Point2f((mi.Float(column) + x) * edge, (mi.Float(row) + y) * edge)
        return point, density, node


def _choose(x: mi.Float, bits: mi.UInt32, by_tree: mi.Bool) -> tuple[mi.Float, mi.Bool, mi.Float]:
    """Chooses a half: where ``x`` lies in it, whether it is the upper one, and the probability of
    the tree for it."""
    p = mi.Float(bits & (_ONE - 1)) * (1 / _ONE)
    threshold = dr.select(by_tree, p, 0.5)
    is_upper = x >= threshold
    x = dr.select(is_upper, (x - threshold) / (1 - threshold), x / threshold)
    return dr.minimum(x, _ALMOST_ONE), is_upper, dr.select(is_upper, 1 - p, p)


def _pack(probability: mi.Float, child: mi.UInt32) -> tuple[mi.UInt32, list]:
    """The first word of each node, as if it were split along the first axis; and its four
    grandchildren: number, and whether it has splits."""
    is_inner = probability >= 0
    bits = _rounded(probability)
    grandchildren = []
    for side in range(2):
        node = child + side
        p = dr.gather(mi.Float, probability, node, is_inner)
        is_split = is_inner & (p >= 0)
        bits |= _rounded(dr.select(is_split, p, 0.5)) << (_BITS * (1 + side))
        first = dr.gather(mi.UInt32, child, node, is_split)
        for upper in range(2):
            grandchild = first + upper
            has_splits = is_split & (
                dr.gather(mi.Float, probability, grandchild, is_split) >= 0
            )
            leaf_bit = 1 << (3 * _BITS + 2 * side + upper)
            bits |= dr.select(has_splits, mi.UInt32(0), leaf_bit)
            grandchildren.append((grandchild, has_splits))
    return bits, grandchildren


def _rounded(probability: mi.Float) -> mi.UInt32:
    return mi.UInt32(dr.clip(probability * _ONE + 0.5, 0, _ONE - 1))


def _write(nodes: mi.Float, slot: mi.UInt32, bits, block, node, exists) -> None:
    """Writes packed nodes into their slots."""
    value = mi.Point2u(
        dr.gather(mi.UInt32, bits, node, exists), dr.gather(mi.UInt32, block, node, exists)
    )
    dr.scatter(nodes, dr.reinterpret_array(mi.Point2f, value), slot, exists)
