"""Divides a mesh into treelets.

The source splits all nodes into fixed counts, which the shape of its tree requires. If a whole
scene is one mesh, walls then share nodes with small objects, and rays take two to three times as
long. Here, the upper splits are therefore free: each takes the position and the axis with the
smallest expected cost by the surface areas of the halves [1], among positions between whole leaves.

[1] Wald. On fast Construction of SAH-based Bounding Volume Hierarchies. IEEE Symposium on
Interactive Ray Tracing, 2007.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np

from .boxes import area, around
from .heap import CAPACITY, LEAF_SIZE
from .sorting import separated, sorted_rows

#: The number of triangles of a larger part that are sampled to choose its split.
_SAMPLE = 1024

#: The number of triangles that a thread splits at a time.
_CHUNK = 1 << 16

#: The maximum depth of free splits. Deeper parts are split in the middle to bound the depth.
_FREE_ROUNDS = 40


@dataclass
class TreeletDivision:
    """A binary tree of parts; the parts that are not split are treelets.

    Attributes:
        start: The first triangle of each part, from left to right. Shape (parts,).
        size: The number of triangles of each part.
        left: The index of its first half, which the second half follows; -1 for a treelet.
        rounds: The parts of each depth.
    """

    start: np.ndarray
    size: np.ndarray
    left: np.ndarray
    rounds: list[range] = field(default_factory=list)

    def boxes(self, boxes: np.ndarray) -> np.ndarray:
        """The boxes of all parts. Shape (6, parts).

        Parameters:
            boxes: The boxes of the triangles from left to right. Shape (6, triangles).
        """
        treelets = np.flatnonzero(self.left < 0)
        treelets = treelets[np.argsort(self.start[treelets])]
        result = np.empty((6, len(self.start)), dtype=np.float32)
        for row, values in enumerate(boxes):
            union = np.minimum if row < 3 else np.maximum
            result[row, treelets] = union.reduceat(values, self.start[treelets])
            for parts in reversed(self.rounds):
                part = np.array(parts)[self.left[parts.start : parts.stop] >= 0]
                halves = self.left[part]
                result[row, part] = union(result[row, halves], result[row, halves + 1])
        return result


def divide(boxes: np.ndarray, order: np.ndarray, pool: Executor) -> TreeletDivision:
    """Divides triangles into treelets of at most ``CAPACITY``.

    Parameters:
        boxes: Lower and upper corners of the triangles' boxes, as rows. Shape (6, triangles),
            float32. They are sorted in place, from left to right.
        order: The indices of the triangles; sorted in the same way.
    """
    division = TreeletDivision(np.array([0]), np.array([boxes.shape[1]]), np.array([-1]))
    first = 0
    while first < len(division.start):
        parts = range(first, len(division.start))
        division.rounds.append(parts)
        large = first + np.flatnonzero(division.size[first:] > CAPACITY)
        first = parts.stop
        start, size = division.start[large], division.size[large]
        cuts = np.empty(len(large), dtype=np.int64)
        is_free = len(division.rounds) <= _FREE_ROUNDS

        def split(group, start=start, size=size, cuts=cuts, is_free=is_free):
            cuts[group] = _split(boxes, order, start[group], size[group], is_free)

        list(pool.map(split, _groups(size)))
        division.left[large] = first + 2 * np.arange(len(large))
        halves = np.stack([start, start + cuts], axis=1), np.stack([cuts, size - cuts], axis=1)
        division.start = np.concatenate([division.start, halves[0].ravel()])
        division.size = np.concatenate([division.size, halves[1].ravel()])
        division.left = np.concatenate([division.left, np.full(2 * len(large), -1)])
    return division


def _groups(size: np.ndarray) -> Iterator[np.ndarray]:
    """Groups of parts that are split together: large parts alone, others by similar size."""
    for part in np.flatnonzero(size > _SAMPLE):
        yield np.array([part])
    widths = np.where(size > _SAMPLE, 0, _width(size))
    for width in np.unique(widths[widths > 0]):
        parts, step = np.flatnonzero(widths == width), max(1, _CHUNK // int(width))
        for k in range(0, len(parts), step):
            yield parts[k : k + step]


def _width(size: np.ndarray) -> np.ndarray:
    """The smallest power of two that is at least ``size``."""
    return 1 << np.ceil(np.log2(size)).astype(np.int64)


def _split(
    boxes: np.ndarray, order: np.ndarray, start: np.ndarray, size: np.ndarray, is_free: bool
) -> np.ndarray:
    """Splits parts. Returns the sizes of their left halves."""
    if size[0] > _SAMPLE:
        return _split_large(boxes, order, int(start[0]), int(size[0]), is_free)
    columns = np.arange(_width(size).max())
    exists = columns < size[:, None]
    places = np.where(exists, start[:, None] + columns, 0)
    parts = boxes[:, places]
    parts[:3, ~exists], parts[3:, ~exists] = np.inf, -np.inf
    axes, cuts, orders = _cheapest(parts, size, is_free)
    by_centre = places.ravel()[orders[axes, np.arange(len(axes))]]
    # Sorted rows keep missing entries at their ends
    source, target = by_centre[exists], places[exists]
    for row in (*boxes, order):
        row[target] = row[source]
    return cuts


def _split_large(boxes: np.ndarray, order: np.ndarray, start: int, size: int, is_free: bool):
    part = slice(start, start + size)
    sample = boxes[:, start + np.arange(_SAMPLE) * size // _SAMPLE]
    (axis,), (cut,), _ = _cheapest(sample[:, None], np.array([_SAMPLE]), is_free)
    cut = round(int(cut) * size / _SAMPLE / LEAF_SIZE) * LEAF_SIZE
    by_centre = separated((boxes[axis, part] + boxes[3 + axis, part])[None], cut)
    for row in (*boxes, order):
        row[part] = row[part][by_centre]
    return cut


def _cheapest(
    boxes: np.ndarray, size: np.ndarray, is_free: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best splits of rows of triangles.

    Parameters:
        boxes: Shape (6, rows, width), a multiple of the size of a leaf; empty boxes at the ends.
        size: The number of triangles in each row, more than in a leaf.

    Returns:
        The axis of each row, the number of triangles on the left, and for each axis the order in
        which they are sorted along it, as indices of the flattened rows. Shapes (rows,), (rows,),
        (3, rows, width).
    """
    rows, width = boxes.shape[1:]
    left = np.arange(LEAF_SIZE, width, LEAF_SIZE)
    right = size[:, None] - left
    allowed = right > 0
    if not is_free:
        allowed &= left == size[:, None] // (2 * LEAF_SIZE) * LEAF_SIZE
    orders = np.empty((3, rows, width), dtype=np.int64)
    costs = np.empty((3, rows, len(left)), dtype=np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # empty boxes
        for k in range(3):
            centre = boxes[k] + boxes[3 + k]
            centre[np.isnan(centre)] = np.inf  # behind all others
            by_centre = sorted_rows(centre)
            orders[k] = by_centre.reshape(rows, width)
            sorted_boxes = boxes.reshape(6, -1)[:, by_centre]
            leaves = around(sorted_boxes.reshape(6, rows, -1, LEAF_SIZE))
            costs[k] = left * area(_first(leaves))[:, :-1]
            costs[k] += right * area(_first(leaves[..., ::-1]))[:, -2::-1]
        # If many triangles coincide, all splits cost the same, and the middle is best
        costs *= 1 + 1e-3 * np.abs(right - left) / size[:, None].astype(np.float32)
    # In huge meshes, areas can overflow
    costs = np.where(allowed, np.fmin(costs, np.finfo(np.float32).max), np.inf)
    best = costs.transpose(1, 0, 2).reshape(rows, -1).argmin(axis=1)
    return best // len(left), left[best % len(left)], orders


def _first(boxes: np.ndarray) -> np.ndarray:
    """The bounding boxes of the first one, two, three, … boxes of each row."""
    low, high = (
        union.accumulate(corners, axis=2)
        for union, corners in ((np.minimum, boxes[:3]), (np.maximum, boxes[3:]))
    )
    return np.concatenate([low, high])
