"""The upper part of a tree: nodes with four children, each another such node or a treelet.

Nodes and treelets are numbered together: the children of a node are neighbours.
"""

from __future__ import annotations

import numpy as np

from .boxes import area
from .division import TreeletDivision
from .heap import ARITY


class Top:
    """The tree over the parts of a division.

    Parameters:
        division: The division.
        boxes: The boxes of its parts. Shape (6, parts).

    Attributes:
        parts: The part of each node or treelet. Shape (numbers,).
        first: The first child of each node; -1 for a treelet.
        children: The parts of the children of each node; -1 beyond the last. Shape (nodes, 4).
        waiting: The maximum number of others on the stack while a node or treelet is visited.
    """

    def __init__(self, division: TreeletDivision, boxes: np.ndarray) -> None:
        areas = area(boxes)
        parts, first, waiting, children = [np.array([0])], [], [np.array([0])], []
        numbers = 1
        while len(parts[-1]):
            row = parts[-1]
            is_node = division.left[row] >= 0
            below = _children(division, areas, row[is_node])
            counts = (below >= 0).sum(axis=1)
            of_row = np.full(len(row), -1)
            of_row[is_node] = numbers + np.cumsum(counts) - counts
            numbers += int(counts.sum())
            first.append(of_row)
            children.append(below)
            parts.append(below[below >= 0])
            waiting.append(np.repeat(waiting[-1][is_node] + counts - 1, counts))
        self.parts, self.first = np.concatenate(parts), np.concatenate(first)
        self.children, self.waiting = np.concatenate(children), np.concatenate(waiting)


def _children(division: TreeletDivision, areas: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Shape (parts, 4): the halves of each part; twice, the largest that can be split is split."""
    children = np.full((len(parts), ARITY), -1)
    children[:, 0], children[:, 1] = division.left[parts], division.left[parts] + 1
    rows = np.arange(len(parts))
    for last in range(2, ARITY):
        can_split = (children >= 0) & (division.left[children] >= 0)
        chosen = np.where(can_split, areas[children], -1).argmax(axis=1)
        is_split = can_split[rows, chosen]
        left = division.left[children[rows, chosen]]
        children[rows[is_split], chosen[is_split]] = left[is_split]
        children[rows[is_split], last] = left[is_split] + 1
    return children
