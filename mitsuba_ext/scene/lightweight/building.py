"""Builds the tree over the triangles of a mesh: a top tree over treelets (Cline 2007, sections
3.3.2 and 3.4.2).

Treelets are heaps. Each of their nodes is split in two twice. The shape of the heap determines the
counts of both halves; the axis along which the triangles are separated is free. The source takes
the longest axis. Here, it is the axis with the smallest expected cost, by the surface areas of the
halves.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from .boxes import area, around
from .division import divide
from .heap import ARITY, LEAF_SIZE, Heap
from .sorting import separated
from .top import Top

#: The number of triangles that a thread sorts at a time.
_CHUNK = 1 << 16

#: The bits for the number of a treelet's inner nodes; nodes of the top tree have ``TOP``.
INNER_BITS = 5
TOP = (1 << INNER_BITS) - 1

#: The bounding box of no triangles.
_EMPTY = np.array([np.inf] * 3 + [-np.inf] * 3, dtype=np.float32)[:, None, None]


@dataclass
class Hierarchy:
    """A tree over triangles.

    Attributes:
        children: The boxes of the four children of each inner node, lower and upper corners as
            rows; the corners of empty boxes are swapped. Shape (6, nodes, 4), float32.
        headers: For each treelet, the index of its first inner node times 32 plus the number of its
            inner nodes, and the index of its first leaf. For each node of the top tree, its index
            times 32 plus ``TOP``, and the index of its first child. Shape (numbers, 2), uint32.
        order: The triangles, sorted by treelet and leaf. Shape (triangles,), uint32.
        stack_size: The maximum number of children that wait while a ray traverses the tree.
    """

    children: np.ndarray
    headers: np.ndarray
    order: np.ndarray
    stack_size: int


def build(boxes: np.ndarray) -> Hierarchy:
    """Builds the tree.

    Parameters:
        boxes: Lower and upper corners of the triangles' boxes, as rows. Shape (6, triangles),
            float32. They are sorted in place, from left to right.
    """
    order = np.arange(boxes.shape[1], dtype=np.uint32)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        division = divide(boxes, order, pool)
        of_parts = division.boxes(boxes)
        top = Top(division, of_parts)
        start, size = division.start[top.parts], division.size[top.parts]
        is_treelet = top.first < 0
        heaps = {n: Heap(n) for n in np.unique(size[is_treelet]).tolist()}
        of_numbers = [heaps[n] if t else None for n, t in zip(size.tolist(), is_treelet)]
        inner = np.array([heap.inner if heap else 1 for heap in of_numbers])
        levels = np.array([len(heap.levels) if heap else 0 for heap in of_numbers])
        node = np.cumsum(inner) - inner
        children = np.empty((6, int(inner.sum()), ARITY), dtype=np.float32)
        exists = top.children >= 0
        children[:, node[~is_treelet]] = np.where(exists, of_parts[:, top.children], _EMPTY)

        def sort(treelets: np.ndarray) -> None:
            heap = heaps[int(size[treelets[0]])]
            _sort_treelets(boxes, order, children, heap, start[treelets], node[treelets])

        list(pool.map(sort, _groups(size, is_treelet)))
    first = np.where(is_treelet, start // LEAF_SIZE, top.first)
    headers = np.stack([node << INNER_BITS | np.where(is_treelet, inner, TOP), first], axis=1)
    stack_size = int((top.waiting + (ARITY - 1) * levels).max())
    return Hierarchy(children, headers.astype(np.uint32), order, stack_size)


def _groups(size: np.ndarray, is_treelet: np.ndarray) -> Iterator[np.ndarray]:
    """The indices of treelets of one size that are sorted together."""
    for n in np.unique(size[is_treelet]):
        treelets, step = np.flatnonzero(is_treelet & (size == n)), max(1, _CHUNK // int(n))
        for k in range(0, len(treelets), step):
            yield treelets[k : k + step]


def _sort_treelets(
    boxes: np.ndarray, order: np.ndarray, children: np.ndarray, heap: Heap,
    start: np.ndarray, node: np.ndarray,
) -> None:  # fmt: skip
    """Sorts the triangles of treelets of one size, and writes the boxes of their nodes.

    Parameters:
        start: The first triangle of each treelet.
        node: The first inner node of each treelet.
    """
    places = start[:, None] + np.arange(heap.counts[0])
    mine, triangles = boxes[:, places], order[places]
    for level in heap.levels:
        for run in heap.runs(level):
            a, b, c, d = run.children
            _separate(mine, triangles, run.start, run.nodes, a + b + c + d, a + b)
            if (a, b) == (c, d):
                _separate(mine, triangles, run.start, 2 * run.nodes, a + b, a)
            else:  # this node is alone in its run
                _separate(mine, triangles, run.start, 1, a + b, a)
                _separate(mine, triangles, run.start + a + b, 1, c + d, c)
    order[places] = heap.by_leaf(triangles)
    nodes = node[:, None] + np.arange(heap.inner)
    below = _boxes_of_nodes(mine, heap)[:, :, 1:]
    children[:, nodes] = below.reshape(6, len(start), heap.inner, ARITY)


def _separate(
    boxes: np.ndarray, order: np.ndarray, start: int, nodes: int, size: int, left: int
) -> None:
    """Splits neighbouring nodes of equal size in each treelet."""
    if not 0 < left < size:
        return
    part = slice(start, start + nodes * size)
    mine = boxes[:, :, part].reshape(6, -1, size)
    by_centre = separated(_centres(mine, left), left)
    boxes[:, :, part] = mine.reshape(6, -1)[:, by_centre].reshape(6, len(order), -1)
    order[:, part] = order[:, part].ravel()[by_centre].reshape(len(order), -1)


def _centres(boxes: np.ndarray, left: int) -> np.ndarray:
    """Twice the centres along the axis of each node. Shape (nodes, size)."""
    costs = np.empty((3, boxes.shape[1]), dtype=np.float32)
    with np.errstate(over="ignore"):  # huge meshes
        for k in range(3):
            by_centre = separated(boxes[k] + boxes[3 + k], left)
            halves = boxes.reshape(6, -1)[:, by_centre].reshape(boxes.shape)
            costs[k] = left * area(around(halves[:, :, :left]))
            costs[k] += (boxes.shape[2] - left) * area(around(halves[:, :, left:]))
    axis, rows = costs.argmin(axis=0), np.arange(boxes.shape[1])
    return boxes[axis, rows] + boxes[3 + axis, rows]


def _boxes_of_nodes(boxes: np.ndarray, heap: Heap) -> np.ndarray:
    """The boxes of the nodes of treelets. Shape (6, treelets, nodes).

    Parameters:
        boxes: The boxes of their triangles from left to right. Shape (6, treelets, triangles).
    """
    result = np.empty((*boxes.shape[:2], len(heap.counts)), dtype=np.float32)
    result[:3], result[3:] = np.inf, -np.inf
    leaves = heap.leaves_from_left()
    leaves = leaves[heap.counts[leaves] > 0]
    starts = np.concatenate([[0], np.cumsum(heap.counts[leaves[:-1]])])
    for rows, union in ((slice(0, 3), np.minimum), (slice(3, 6), np.maximum)):
        result[rows, :, leaves] = union.reduceat(boxes[rows], starts, axis=2)
    for level in reversed(heap.levels):
        below = result[:, :, ARITY * level.start + 1 : ARITY * level.stop + 1]
        result[:, :, level.start : level.stop] = around(below.reshape(*below.shape[:2], -1, ARITY))
    return result
