"""k-d trees over the unit square, from which pairs of primary samples are drawn.

Source: Guo, PhD thesis, sections 2.3.3 (structure) and 2.3.5 (sampling, Eqs. 2.7 to 2.11).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy, put
from ...util.stored_arrays import StoredArrays

#: The value that marks a leaf, in place of a probability.
LEAF = -1.0

#: Bits of a probability in a packed node. The density is computed from the rounded probabilities.
_BITS = 9
_ONE = 1 << _BITS

_ALMOST_ONE = 1 - 2.0**-24

#: Of stored trees: the most words of all nodes (256 MiB), and the most packed nodes from a root to
#: a leaf.
_MOST_WORDS, _DEEPEST = 1 << 26, 64


class SampleTrees:
    """Many k-d trees in flat arrays. Cells are split at their middle, the first axis first, then
    the axes in turn. A tree is a piecewise constant density, which is mixed with the uniform one,
    so that the density of a sample is at least 1 − ``share``.

    On the way down, the two coordinates of a sample are rescaled at each split, and no other random
    numbers are drawn. So strata of a sampler remain strata, and a tree that is a single leaf
    returns the sample unchanged.

    A split along the first axis and the two below it are packed into a node of eight bytes: three
    probabilities, which of the four children are leaves, and where the children are stored.

    Parameters:
        probability: The probability of each node's left child; ``LEAF`` for a leaf. Shape [nodes].
        child: The left child's number; the right one follows it. Shape [nodes].
        is_even: Whether the node is split along the first axis. Shape [nodes].
        root: The first node of each tree; it is split along the first axis, or a leaf. [trees].
        share: The share of the samples that follow the tree, in [0, 1]; the others are uniform.
            Shape [trees].
        value: For each leaf, the number that :meth:`value` returns; shape [nodes].
    """

    def __init__(
        self,
        probability: mi.Float,
        child: mi.UInt32,
        is_even: mi.Bool,
        root: mi.UInt32,
        share: mi.Float,
        value: mi.UInt32 | None = None,
    ) -> None:
        # A node's children take a block of four
        inner = dr.compress(is_even & (probability >= 0))
        if len(inner) == 0:
            inner = mi.UInt32(0)  # a leaf, whose block is never read
        block = dr.zeros(mi.UInt32, len(probability))
        # Opaque: trees of other sizes share the kernels
        first = dr.opaque(mi.UInt32, len(root))
        dr.scatter(block, first + 4 * dr.arange(mi.UInt32, len(inner)), inner)
        slots = len(root) + 4 * len(inner)
        node, slot = dr.empty(mi.UInt32, slots), first + 4 * dr.arange(mi.UInt32, len(inner))
        for index, grandchild in enumerate(_pack(probability, child, inner)[1]):
            put(node, grandchild, slot + index)
        put(node, root, dr.arange(mi.UInt32, len(root)))
        dr.eval(node, block)

        bits, _ = _pack(probability, child, node)
        packed = mi.Point2u(bits, dr.gather(mi.UInt32, block, node))
        self._nodes = dr.empty(mi.Float, 2 * slots)
        slot = dr.arange(mi.UInt32, slots)
        dr.scatter(self._nodes, dr.reinterpret_array(mi.Point2f, packed), slot)
        self._values = mi.UInt32() if value is None else dr.gather(mi.UInt32, value, node)
        # A tree without splits is skipped
        is_leaf = dr.gather(mi.Float, probability, root) < 0
        self.share = dr.select(is_leaf, 0, share)
        dr.eval(self._nodes, self.share, self._values)

    def state(self) -> dict[str, np.ndarray]:
        """The trees as arrays."""
        return {
            "nodes": self._nodes.numpy().view(np.uint32),
            "values": self._values.numpy(),
            "share": self.share.numpy(),
        }

    @classmethod
    def of_state(cls, state: StoredArrays) -> SampleTrees:
        """The trees from the arrays of :meth:`state`.

        Raises:
            DamagedError: They are no trees: a child is missing, or leads back to its parent.
        """
        nodes = state.take("nodes", "u", (None,), most=0xFFFFFFFF, longest=_MOST_WORDS)
        slots, odd = divmod(len(nodes), 2)
        state.require(odd == 0, "half a node")
        share = state.take("share", "f", (None,), 0, 1, slots)
        has_values = "values" in state and state.shape("values") != (0,)
        values = state.take("values", "u", (slots if has_values else 0,), most=len(share) - 1)
        state.require(_end_in_leaves(nodes.reshape(-1, 2)), '"nodes" are no trees')
        return cls._of(nodes, values, share)

    @classmethod
    def _of(cls, nodes: np.ndarray, values: np.ndarray, share: np.ndarray) -> SampleTrees:
        trees = cls.__new__(cls)
        # As integers: bit patterns of nodes may look like NaNs
        trees._nodes = dr.reinterpret_array(mi.Float, from_numpy(mi.UInt32, nodes))
        trees._values, trees.share = from_numpy(mi.UInt32, values), from_numpy(mi.Float, share)
        dr.eval(trees._nodes, trees._values, trees.share)
        return trees

    @classmethod
    def uniform(cls, count: int) -> SampleTrees:
        """So many trees without splits."""
        nodes, values = np.zeros(2 * count, np.uint32), np.zeros(0, np.uint32)
        return cls._of(nodes, values, np.zeros(count, np.float32))

    @property
    def count(self) -> int:
        """Number of trees."""
        return len(self.share)

    @property
    def bytes(self) -> int:
        """Bytes of memory that the trees take."""
        return 4 * (len(self._nodes) + len(self.share) + len(self._values))

    def sample(
        self, tree: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float, mi.UInt32]:
        """Warps uniform numbers to the density of a tree.

        Returns:
            The sample in [0, 1)², its density, and the number of its leaf. In inactive lanes they
            are ``u``, 1 and the tree's number.
        """
        share, by_tree, u = self.choose(tree, u, active)
        point, density, leaf = self.descend(tree, u, by_tree, active & (share > 0))
        return point, dr.fma(share, density, 1 - share), leaf

    def choose(
        self, tree: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Bool, mi.Point2f]:
        """The share of the samples that follow a tree, whether uniform numbers ``u`` choose to
        follow it, and the uniform numbers that are left of them. In inactive lanes they are 0,
        false and ``u``."""
        share = dr.gather(mi.Float, self.share, tree, active)
        by_tree = u.x < share
        # The number that chose between the two densities is rescaled to [0, 1)
        x = dr.select(by_tree, u.x / share, (u.x - share) / (1 - share))
        x = dr.select(share > 0, dr.minimum(x, _ALMOST_ONE), u.x)
        return share, by_tree, mi.Point2f(x, u.y)

    def density(
        self, tree: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Float, mi.UInt32]:
        """The density of a sample, and the number of its leaf."""
        share = dr.gather(mi.Float, self.share, tree, active)
        _point, density, leaf = self.descend(tree, u, mi.Bool(False), active & (share > 0))
        return dr.fma(share, density, 1 - share), leaf

    def value(self, leaf: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The number that the caller gave to the leaf."""
        return dr.gather(mi.UInt32, self._values, leaf, active)

    @dr.syntax
    def descend(
        self, root: mi.UInt32, u: mi.Point2f, by_tree: mi.Bool, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float, mi.UInt32]:
        """Goes down to a leaf: by the probabilities where ``by_tree``, else to the leaf that
        contains ``u``.

        Returns:
            A point in the leaf (``u`` itself if not ``by_tree``), the density there of samples that
            follow the tree, and the number of the leaf.
        """
        x, y = mi.Float(u.x), mi.Float(u.y)       # Coordinates of the sample within its cell
        column, row = mi.UInt32(0), mi.UInt32(0)  # Number of the cell among cells of its size
        edge = mi.Float(1)                        # Edge of the cell
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
        # Rounding must not move a sample into the next cell, or to 1
        last = 1 - (1 - _ALMOST_ONE) / edge
        x, y = dr.minimum(x, last), dr.minimum(y, last)
        point = mi.Point2f((mi.Float(column) + x) * edge, (mi.Float(row) + y) * edge)
        return point, density, node


def _end_in_leaves(nodes: np.ndarray) -> bool:
    """Whether all ways down packed nodes end in a leaf. Leaves have a slot, too: their values are
    looked up there. (A tree without splits names the slots 0 to 3.)"""
    side = np.arange(4, dtype=np.uint32)
    is_leaf = (nodes[:, :1] >> (3 * _BITS + side)) & 1 == 1
    child = nodes[:, 1:].astype(np.int64) + side
    if not len(nodes) or child.max() >= max(len(nodes), len(side)):
        return False
    child = np.where(is_leaf, 0, child)
    ends = is_leaf.all(axis=1)
    for _level in range(_DEEPEST):
        if ends.all():
            return True
        ends = (is_leaf | ends[child]).all(axis=1)
    return False


def _choose(x: mi.Float, bits: mi.UInt32, by_tree: mi.Bool) -> tuple[mi.Float, mi.Bool, mi.Float]:
    """Chooses a half of a cell.

    Returns:
        ``x`` rescaled to the half, whether it is the upper half, and its probability in the tree.
    """
    p = mi.Float(bits & (_ONE - 1)) * (1 / _ONE)
    threshold = dr.select(by_tree, p, 0.5)
    is_upper = x >= threshold
    x = dr.select(is_upper, (x - threshold) / (1 - threshold), x / threshold)
    return dr.minimum(x, _ALMOST_ONE), is_upper, dr.select(is_upper, 1 - p, p)


def _pack(
    probability: mi.Float, child: mi.UInt32, place: mi.UInt32
) -> tuple[mi.UInt32, list[mi.UInt32]]:
    """The first word of packed nodes, for nodes that are split along the first axis, and the four
    nodes two levels below each (a child twice, where that child is not split)."""
    p = dr.gather(mi.Float, probability, place)
    is_inner, first_child = p >= 0, dr.gather(mi.UInt32, child, place)
    bits = _rounded(p)
    grandchildren = []
    for side in range(2):
        node = dr.select(is_inner, first_child + side, 0)
        p = dr.gather(mi.Float, probability, node)
        is_split = is_inner & (p >= 0)
        bits |= _rounded(dr.select(is_split, p, 0.5)) << (_BITS * (1 + side))
        first = dr.gather(mi.UInt32, child, node)
        for upper in range(2):
            grandchild = dr.select(is_split, first + upper, node)
            is_leaf = ~is_split | (dr.gather(mi.Float, probability, grandchild) < 0)
            leaf_bit = 1 << (3 * _BITS + 2 * side + upper)
            bits |= dr.select(is_leaf, mi.UInt32(leaf_bit), 0)
            grandchildren.append(grandchild)
    return bits, grandchildren


def _rounded(probability: mi.Float) -> mi.UInt32:
    return mi.UInt32(dr.clip(probability * _ONE + 0.5, 0, _ONE - 1))
