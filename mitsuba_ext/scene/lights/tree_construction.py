"""Builds light trees: binary trees over lights whose nodes know where their lights are, how far they
are spread, and in which directions they shine.

A node is divided in the middle of the longest edge of the box around its lights. The trees are
built level by level, with operations on whole arrays. (Splits that minimise the surface area
orientation heuristic of the source give estimates whose variance differs by less than a tenth.)

Source: A. Conty Estevez, C. Kulla, *Importance Sampling of Many Lights with Adaptive Tree
Splitting*, HPG 2018, section 4 (bounds and cones).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

#: Numbers of a node: centre and spread, axis and strength.
NODE_WORDS = 8

#: Below this level, nodes are divided into halves of equal numbers: lights whose distances range
#: over many orders of magnitude would make deep trees.
_MIDDLE_LEVELS = 32

#: Added to the angles of cones, for rounding.
_ANGLE_MARGIN = 1e-3

#: Shorter mean directions of emission are no axis of a cone.
_LEAST_AXIS = 1e-3


@dataclass
class Lights:
    """What lights look like from afar. Each array has one row for each light.

    Attributes:
        center: Mean position; shape [lights, 3].
        spread: Root mean square distance of the light's points from the centre.
        reach: The largest such distance.
        axis: Mean normal of the light's surface. Lights that shine in all directions have 0. Shape
            [lights, 3].
        angle: No light leaves at a larger angle to the axis. π if the axis is 0.
        strength: The power, for diffuse lights: irradiance at the distance 1 in the direction of
            the normal, times π. Positive.
    """

    center: np.ndarray
    spread: np.ndarray
    reach: np.ndarray
    axis: np.ndarray
    angle: np.ndarray
    strength: np.ndarray

    def __len__(self) -> int:
        return len(self.strength)

    def at(self, index: np.ndarray) -> Lights:
        """The lights with these numbers."""
        return Lights(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass
class Trees:
    """Binary trees over disjoint sets of lights. Siblings have the numbers 2k and 2k + 1; the roots
    come first, and their even siblings are empty.

    Attributes:
        nodes: The words of each node (:func:`_packed`); shape [nodes, ``NODE_WORDS``].
        link: The number of the first of a node's two children, which is even; of a leaf, 1 + twice
            the number of its light.
        parent: The parent of each pair of siblings; 0 for roots.
        leaf: The node of each light; shape [lights].
        depth: The number of levels below the roots.
    """

    nodes: np.ndarray
    link: np.ndarray
    parent: np.ndarray
    leaf: np.ndarray
    depth: int


def build_trees(
    lights: Lights, owner: np.ndarray | None = None, sets: int = 1, apart: np.ndarray | None = None
) -> Trees:
    """Builds a tree for each set of lights.

    Parameters:
        owner: The set of each light. By default, there is one.
        sets: The number of sets. The tree of an empty set has one leaf, whose strength is 0.
        apart: Lights to be separated from the others at the root.
    """
    count = len(lights)
    owner = np.zeros(count, int) if owner is None else owner
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=sets)
    room = sets + max(0, count - np.count_nonzero(counts))
    rows = np.zeros((2 * room, NODE_WORDS), np.float32)
    link, parent = np.ones(2 * room, np.uint32), np.zeros(room, np.uint32)
    leaf = np.zeros(count, np.uint32)
    node = 2 * np.flatnonzero(counts) + 1
    counts, pairs, depth = counts[counts > 0], sets, 0
    while len(order):
        start = np.cumsum(counts) - counts
        rows[node] = _packed(_summary(lights, order, start, counts))
        is_leaf = counts == 1
        light = order[start[is_leaf]]
        link[node[is_leaf]], leaf[light] = 2 * light + 1, node[is_leaf]

        # Divide the others
        order = order[np.repeat(~is_leaf, counts)]
        counts, node = counts[~is_leaf], node[~is_leaf]
        if len(counts) == 0:
            break
        is_right = _division(lights.center[order], counts, depth < _MIDDLE_LEVELS)
        if depth == 0 and apart is not None:
            is_right = apart[order] if 0 < apart.sum() < count else is_right
        segment = np.repeat(np.arange(len(counts)), counts)
        order = order[np.argsort(2 * segment + is_right, kind="stable")]
        right = np.bincount(segment, is_right, len(counts)).astype(int)
        first = 2 * (pairs + np.arange(len(counts)))
        link[node], parent[first // 2] = first, node
        pairs, depth = pairs + len(counts), depth + 1
        node = np.stack([first, first + 1], axis=1).ravel()
        counts = np.stack([counts - right, right], axis=1).ravel()
    return Trees(rows, link, parent, leaf, depth)


def _division(center: np.ndarray, counts: np.ndarray, in_the_middle: bool) -> np.ndarray:
    """Whether each light goes to the right child of its node. ``counts``: lights of the nodes."""
    start = np.cumsum(counts) - counts
    segment = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(center)) - start[segment]
    halves = 2 * place >= counts[segment]
    if not in_the_middle:
        return halves
    low, high = (f.reduceat(center, start, axis=0) for f in (np.minimum, np.maximum))
    axis = (high - low).argmax(axis=1)
    rows = np.arange(len(counts))
    middle = 0.5 * (low[rows, axis] + high[rows, axis])
    is_right = center[np.arange(len(center)), axis[segment]] > middle[segment]
    right = np.bincount(segment, is_right, len(counts))
    # All in one place
    is_whole = (right == 0) | (right == counts)
    return np.where(is_whole[segment], halves, is_right)


def _summary(
    lights: Lights, order: np.ndarray, start: np.ndarray, counts: np.ndarray
) -> Lights:
    """What nodes look like from afar. ``order``: their lights, node by node."""
    segment = np.repeat(np.arange(len(counts)), counts)

    def total(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, start, axis=0)

    strength = total(lights.strength[order])
    share = lights.strength[order] / strength[segment]
    center = total(share[:, None] * lights.center[order])
    distance = np.linalg.norm(lights.center[order] - center[segment], axis=1)
    spread = np.sqrt(total(share * (distance**2 + lights.spread[order] ** 2)))
    reach = np.maximum.reduceat(distance + lights.reach[order], start)

    own = lights.axis[order]
    axis = total(share[:, None] * own)
    length, own_length = (np.linalg.norm(a, axis=1) for a in (axis, own))
    cosine = (own * axis[segment]).sum(axis=1)
    cosine /= np.maximum(own_length * length[segment], 1e-300)
    angles = np.arccos(np.clip(cosine, -1, 1)) + lights.angle[order]
    angles[own_length < _LEAST_AXIS] = np.pi
    angle = np.maximum.reduceat(angles, start) + _ANGLE_MARGIN
    angle[length < _LEAST_AXIS] = np.pi
    return Lights(center, spread, reach, axis, np.minimum(angle, np.pi), strength)


def _packed(nodes: Lights) -> np.ndarray:
    """The words of nodes: centre, spread, axis, strength. The last eight bits of the spread hold
    spread / reach, in steps of 1 / 255; the last eight bits of the strength hold the cosine of the
    angle, from −1, in steps of 2 / 255. Both are rounded down, so that a node never seems darker
    than it is."""
    spread, strength = (_cut(x) for x in (nodes.spread, nodes.strength))
    ratio = 255 * spread.astype(np.float64) / np.maximum(nodes.reach, 1e-300)
    cosine = 127.5 * (1 + np.cos(nodes.angle))
    columns = [*nodes.center.T, _with_bits(spread, ratio), *nodes.axis.T]
    return np.stack([*columns, _with_bits(strength, cosine)], axis=1).astype(np.float32)


def _cut(values: np.ndarray) -> np.ndarray:
    """Single precision numbers whose last eight bits are 0."""
    return (values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFFFF00)).view(np.float32)


def _with_bits(values: np.ndarray, bits: np.ndarray) -> np.ndarray:
    bits = np.floor(np.clip(bits, 0, 255)).astype(np.uint32)
    return (values.view(np.uint32) | bits).view(np.float32)
