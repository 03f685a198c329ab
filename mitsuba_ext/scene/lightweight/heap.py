"""The shape of a treelet: an essentially complete tree with four children for each node, indexed
like a heap, so that neither nodes nor leaves need pointers (Cline 2007, section 3.3.1).

Node ``q`` has the children ``4q + 1`` to ``4q + 4``. Leaves follow the last inner node. In the
order of their indices, they hold four triangles each; the last ones hold fewer or none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: The numbers of children of a node and of triangles of a leaf (Cline 2007, section 3.4.3).
ARITY, LEAF_SIZE = 4, 4


@dataclass(frozen=True)
class NodeRun:
    """Neighbouring nodes of one level whose children hold equal numbers of triangles.

    Attributes:
        start: The first triangle of the first node, from left to right.
        nodes: The number of nodes.
        children: The number of triangles in each child of a node.
    """

    start: int
    nodes: int
    children: tuple[int, int, int, int]


class Heap:
    """The tree over a given number of triangles.

    Parameters:
        triangles: The number of triangles, at least one.

    Attributes:
        inner: The number of inner nodes, which is the index of the first leaf.
        counts: The number of triangles below each node. Shape (nodes,).
        levels: The inner nodes of each level, from the root down.
    """

    def __init__(self, triangles: int) -> None:
        leaves = -(-triangles // LEAF_SIZE)
        self.inner = max(1, -(-(leaves - 1) // (ARITY - 1)))
        slots = (ARITY - 1) * self.inner + 1
        self.counts = np.empty(self.inner + slots, dtype=np.int32)
        self.counts[self.inner :] = np.clip(
            triangles - LEAF_SIZE * np.arange(slots), 0, LEAF_SIZE
        )
        self.levels: list[range] = []
        first = 0
        while first < self.inner:
            self.levels.append(range(first, min(self.inner, ARITY * first + 1)))
            first = ARITY * first + 1
        for level in reversed(self.levels):
            self.counts[level.start : level.stop] = self.of_children(level).sum(axis=1)

    def of_children(self, level: range) -> np.ndarray:
        """The number of triangles in each child of a level's nodes. Shape (nodes, 4)."""
        return self.counts[ARITY * level.start + 1 : ARITY * level.stop + 1].reshape(-1, ARITY)

    def runs(self, level: range) -> list[NodeRun]:
        """The nodes of a level in at most three runs: the tree below a node ends on the bottom row,
        on both of the last rows, or one row above."""
        children = self.of_children(level)
        changes = np.flatnonzero(np.any(children[1:] != children[:-1], axis=1)) + 1
        edges = [0, *changes.tolist(), len(children)]
        starts = np.concatenate([[0], np.cumsum(children.sum(axis=1))])
        return [
            NodeRun(int(starts[a]), b - a, tuple(map(int, children[a])))
            for a, b in zip(edges[:-1], edges[1:])
        ]

    def leaves_from_left(self) -> np.ndarray:
        """The leaves from left to right: the leaves of the bottom row come first."""
        bottom = self._bottom
        return np.concatenate([
            np.arange(bottom, len(self.counts), dtype=np.int32),
            np.arange(self.inner, bottom, dtype=np.int32),
        ])  # fmt: skip

    def by_leaf(self, triangles: np.ndarray) -> np.ndarray:
        """Sorts values of triangles by the indices of their leaves.

        Parameters:
            triangles: A value for each triangle, from left to right. Shape (…, triangles).
        """
        on_bottom = int(self.counts[self._bottom :].sum())
        return np.concatenate([triangles[..., on_bottom:], triangles[..., :on_bottom]], axis=-1)

    @property
    def _bottom(self) -> int:
        """The first leaf of the bottom row."""
        return max(ARITY * self.levels[-1].start + 1, self.inner)


#: The maximum number of triangles in a treelet. The source proposes "a few thousand triangles"
#: (section 3.4.2). With smaller treelets, more splits adapt to the triangles. With 256, rays take
#: 1.15 times as long, and nodes take 2.8 instead of 3.3 bytes per triangle.
CAPACITY = 64

#: The number of bits of a node's index in its treelet.
HEAP_BITS = int(len(Heap(CAPACITY).counts) - 1).bit_length()
